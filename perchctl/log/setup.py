"""What a flight was set up with, in its log's header: enough to decide it again elsewhere.

The profile stands there with every key. The files that it names for the camera may be others
by the time of a replay, so what was in them stands there, too.
"""

from __future__ import annotations

import base64
import contextlib
import platform
import zlib
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from perchctl.calibration import profile_camera
from perchctl.errors import InvalidValue, PerchError
from perchctl.log.arithmetic import arithmetic_fingerprint
from perchctl.log.exact import from_exact, to_exact
from perchctl.profile import Profile, first_invalid_key, read_mask
from perchctl.vision import CameraModel


def camera_record(profile: Profile) -> dict[str, Any]:
    """``camera``, the calibration, and ``mask``, what the gear covers in it; of a file that
    cannot be read, nothing: that is the flight's to say."""
    with contextlib.suppress(PerchError):
        camera = profile_camera(profile.camera)
        record = {"camera": to_exact(camera)}
        if profile.camera.mask is not None:
            record["mask"] = _packed(read_mask(profile.camera.mask, camera.size_px))
        return record
    return {}


def computer_record() -> dict[str, Any]:
    """``computer``: what the last bits of a sum may depend on."""
    return {
        "computer": {
            "system": platform.system(),
            "machine": platform.machine(),
            "python": platform.python_version(),
            "numpy": np.__version__,
            "opencv": cv2.__version__,
            "arithmetic": arithmetic_fingerprint(),
        }
    }


def computer_differences(header: Mapping[str, Any]) -> str:
    """In what the flight's differed from this one, in words; empty where it did not, or where
    the log does not say."""
    was, here = header.get("computer"), computer_record()["computer"]
    if not isinstance(was, dict):
        return ""
    return ", ".join(
        f"{key} {was[key]} there and {here[key]} here"
        for key in here
        if key in was and was[key] != here[key]
    )


def flown_profile(header: Mapping[str, Any]) -> Profile:
    """The profile that was flown, but for passwords. Errors: InvalidValue."""
    try:
        return Profile.model_validate(header.get("profile"))
    except ValidationError as error:
        key, text = first_invalid_key(error)
        raise InvalidValue(
            f"the log's profile cannot be used by this version of perchctl: {key or 'profile'}: "
            f"{text}"
        ) from None


def flown_camera(header: Mapping[str, Any]) -> CameraModel | None:
    """The calibration that was flown; None in a log that has none. Errors: InvalidValue."""
    if header.get("camera") is None:
        return None
    try:
        return from_exact(CameraModel, header["camera"])
    except ValueError as error:
        raise InvalidValue(f"the log's header holds no calibration: camera: {error}") from None


def flown_mask(header: Mapping[str, Any], camera: CameraModel) -> NDArray[np.bool_] | None:
    """(height, width), True where the gear covers; None without a mask. Errors: InvalidValue."""
    text = header.get("mask")
    if text is None:
        return None
    width, height = camera.size_px
    try:
        # No more than the mask: what a damaged text unfolds to has no bound.
        packed = zlib.decompressobj().decompress(base64.b64decode(text), width * height // 8 + 1)
        bits = np.frombuffer(packed, dtype=np.uint8)
        return np.unpackbits(bits)[: width * height].reshape(height, width).astype(bool)
    except (ValueError, TypeError, zlib.error) as error:
        raise InvalidValue(f"the log's header holds no mask: mask: {error}") from None


def _packed(mask: NDArray[np.bool_]) -> str:
    return base64.b64encode(zlib.compress(np.packbits(mask).tobytes(), 9)).decode("ascii")
