"""The sensor's grid is what counts: an orientation noted for viewers turns no picture."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from perchctl.camera import Grey, RecordedSource, decode_picture, open_camera
from perchctl.profile import read_mask
from tests.helpers.live import Clock
from tests.helpers.orientation import TURNS, turn_video, turned_picture


def uneven_picture() -> Grey:
    """A picture that differs from each of its turns, smooth enough for JPEG."""
    y, x = np.mgrid[:48, :64]
    return np.asarray(40 + 2.5 * x + 0.8 * y, np.uint8)


def images_of(source: str) -> list[Grey]:
    opened = open_camera(source, Clock())
    assert isinstance(opened, RecordedSource)
    images = []
    while not opened.finished:
        frame = opened.poll(0.0)
        assert frame is not None
        images.append(frame.image)
    opened.close()
    return images


@pytest.mark.parametrize("form", ["JPEG", "PNG", "WEBP", "TIFF"])
@pytest.mark.parametrize("orientation", TURNS)
def test_a_picture_stays_on_the_sensor_s_grid(form: str, orientation: int, tmp_path: Path) -> None:
    image = uneven_picture()
    data = turned_picture(image, form, orientation)
    shown = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE))
    assert shown.shape != image.shape or np.abs(shown - image.astype(float)).max() > 20, "no turn"
    assert np.abs(decode_picture(data) - image.astype(float)).max() <= (3 if form == "JPEG" else 0)
    (tmp_path / f"a.{form.lower()}").write_bytes(data)
    (read,) = images_of(f"images:{tmp_path}")
    np.testing.assert_array_equal(read, decode_picture(data))


@pytest.mark.parametrize("order", [b"II*\0", b"MM\0*"])
@pytest.mark.parametrize("rest", [b"", b"\xff" * 4, b"\x08\0\0\0\x08\0\0\0", b"\0\0\0\x08\0\x09"])
def test_a_damaged_tiff_is_no_picture(order: bytes, rest: bytes) -> None:
    with pytest.raises(ValueError, match="cannot be read"):
        decode_picture(order + rest)


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_a_video_stays_on_the_sensor_s_grid(degrees: int, tmp_path: Path) -> None:
    file = tmp_path / "a.mp4"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), 25.0, (64, 48))
    for shift in (0, 3, 6):
        writer.write(cv2.cvtColor(uneven_picture() + np.uint8(shift), cv2.COLOR_GRAY2BGR))
    writer.release()
    plain = images_of(f"video:{file}")
    assert len(plain) == 3
    turn_video(file, degrees)
    ok, shown = cv2.VideoCapture(str(file), cv2.CAP_FFMPEG).read()
    assert ok
    assert shown.shape[:2] == ((48, 64) if degrees == 180 else (64, 48)), "the file is not turned"
    for image, before in zip(images_of(f"video:{file}"), plain, strict=True):
        np.testing.assert_array_equal(image, before)


def test_a_mask_lies_on_the_sensor_s_grid(tmp_path: Path) -> None:
    covered = np.zeros((48, 64), np.uint8)
    covered[:20, :30] = 255
    (tmp_path / "gear.png").write_bytes(turned_picture(covered, "PNG", 6))
    np.testing.assert_array_equal(read_mask(str(tmp_path / "gear.png"), (64, 48)), covered > 0)
