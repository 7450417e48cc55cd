"""``gst:PIPELINE``: what GStreamer makes of it, where this OpenCV was built with it."""

from __future__ import annotations

from typing import Any

import cv2
from cv2 import videoio_registry

from perchctl.camera.credentials import without_password
from perchctl.errors import InvalidValue, NotFound

READ_TIMEOUT_MS = 2000


def has_gstreamer() -> bool:
    return bool(videoio_registry.hasBackend(cv2.CAP_GSTREAMER))


def open_pipeline(text: str) -> Any:
    """An opened cv2.VideoCapture.

    Errors: InvalidValue, this OpenCV has no GStreamer; NotFound, the pipeline does not run.
    """
    if not has_gstreamer():
        raise InvalidValue(
            f"gst: needs an OpenCV that was built with GStreamer, and this one ({cv2.__version__}) "
            f"was not, as none from pip is; name the camera by rtsp://..., http://... or camera:N"
        )
    capture = cv2.VideoCapture(
        text,
        cv2.CAP_GSTREAMER,
        [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, 5000, cv2.CAP_PROP_READ_TIMEOUT_MSEC, READ_TIMEOUT_MS],
    )
    if not capture.isOpened():
        capture.release()
        raise NotFound(
            f"the pipeline gst:{without_password(text)} does not run; try it with gst-launch-1.0, "
            f"and let it end in appsink drop=true max-buffers=1 sync=false"
        )
    return capture
