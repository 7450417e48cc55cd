"""Cameras of this computer: their names, lasting paths and numbers; one that fails or is unplugged
behind a stand-in."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from perchctl.camera import open_camera
from perchctl.camera.device import (
    LOST_AFTER_FAILURES,
    DeviceSource,
    camera_number,
    configure_capture,
    open_video_capture,
)
from perchctl.camera.source import LiveSource
from perchctl.commands import check
from perchctl.errors import InvalidValue, NotFound, TimedOut
from perchctl.profile import CameraConfig
from tests.helpers.live import WAIT_S, Clock, begun, level, next_frame
from tests.helpers.waiting import until


@pytest.fixture
def plugged(tmp_path: Path) -> Callable[..., Path]:
    """A folder as /dev and as the system's list of names: cameras by number with their names, of
    which one that begins with / is no camera's first node, and lasting paths."""

    def make(cameras: dict[int, str], **by_id: int) -> Path:
        (tmp_path / "v4l" / "by-id").mkdir(parents=True, exist_ok=True)
        for number, name in cameras.items():
            node = tmp_path / f"video{number}"
            node.mkdir()
            (node / "name").write_text(f"{name.lstrip('/')}\n")
            (node / "index").write_text(f"{int(name.startswith('/'))}\n")
        for name, number in by_id.items():
            (tmp_path / "v4l" / "by-id" / name).symlink_to(tmp_path / f"video{number}")
        return tmp_path

    return make


def test_a_camera_is_named_by_number_name_part_of_it_or_path(plugged: Callable[..., Path]) -> None:
    devices = plugged(
        {0: "HD Webcam C525", 1: "/HD Webcam C525", 2: "USB Video", 10: "USB Video: deluxe"},
        usb_cam=0, usb_grabber=2,
    )  # fmt: skip

    def number(text: str) -> int:
        return camera_number(text, devices, devices)

    assert number("7") == 7, "a number is not looked up"
    assert number("HD Webcam C525") == number('"webcam"') == number(" c525 ") == 0
    assert number("'deluxe'") == 10
    assert number("usb_grabber") == number(f"{devices}/v4l/by-id/usb_grabber") == 2
    assert number(f"{devices}/video10") == 10
    for text, count in (("usb", 3), ("USB Video", 2), ("", 3)):
        with pytest.raises(InvalidValue, match=rf"camera:{text} matches {count} cameras: .*deluxe"):
            number(text)
    with pytest.raises(
        NotFound, match=r"camera:nix was not found; connected cameras: camera:0 \(HD W"
    ):
        number("nix")


def test_a_missing_device_says_what_there_is() -> None:
    assert not Path("/dev/video97").exists()
    with pytest.raises(NotFound, match=r"camera:97 was not found; (connected|this computer)"):
        open_video_capture("97", None, None)


def test_another_system_than_linux_is_asked_by_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Closed:
        isOpened = staticmethod(lambda: False)
        release = staticmethod(lambda: None)

    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: Closed())
    by_number = "lists cameras only on Linux.*such as camera:0"
    with pytest.raises(NotFound, match=f"camera:USB was not found; perchctl {by_number}"):
        camera_number("USB", tmp_path, tmp_path)
    monkeypatch.setattr("perchctl.camera.device.DEVICES", tmp_path)
    with pytest.raises(NotFound, match=by_number):
        list(check.camera_rows())
    with pytest.raises(NotFound, match=r"camera:97 cannot be opened; .*privacy settings"):
        open_video_capture("97", None, None)


def test_opencv_is_asked_for_format_then_size_then_rate() -> None:
    class Driver:
        def set(self, prop: int, value: float) -> None:
            asked.append((prop, value))

    asked: list[tuple[int, float]] = []
    configure_capture(Driver(), (720, 576), CameraConfig(format="MJPG", rate_hz=25))
    assert [prop for prop, _ in asked] == [
        cv2.CAP_PROP_FOURCC, cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT,
        cv2.CAP_PROP_FPS, cv2.CAP_PROP_BUFFERSIZE,
    ]  # fmt: skip
    assert int(asked[0][1]) == int.from_bytes(b"MJPG", "little")


# --- One that fails, and one that is unplugged --------------------------------------------


def grey(value: int) -> np.ndarray[Any, Any]:
    return np.full((48, 64), value, np.uint8)


class Capture:
    """Stands for cv2.VideoCapture; gives pictures, raises errors among them, and fails at the end
    and while it is unplugged."""

    def __init__(self, *pictures: np.ndarray[Any, Any] | Exception) -> None:
        self.pictures = [*pictures]
        self.unplugged = False
        self.released = threading.Event()
        self.reads = 0

    def read(self) -> tuple[bool, Any]:
        self.reads += 1
        if self.unplugged or not self.pictures:
            threading.Event().wait(0.01 * (not self.unplugged))
            return False, None
        image = self.pictures.pop(0)
        if isinstance(image, Exception):
            raise image
        return True, image

    def release(self) -> None:
        self.released.set()


class Bus:
    """Where a camera is plugged in and out; `attempts` counts those to open it."""

    def __init__(self, capture: Capture) -> None:
        self.capture: Capture | None = capture
        self.attempts = 0

    def open(self) -> Capture:
        self.attempts += 1
        if self.capture is None:
            raise NotFound("camera:2 was not found; this computer has no camera")
        return self.capture


def device(
    opened: list[LiveSource],
    opener: Callable[[], Capture],
    clock: Clock | None = None,
    reopen_every_s: float = 0.001,
) -> DeviceSource:
    source = DeviceSource("camera:2", 0.05, clock or Clock(), opener)
    return begun(source, opened, retry_s=0.0, reconnect_wait_s=reopen_every_s)


def test_a_device_delivers_grey_frames_drops_a_damaged_one_and_is_released(
    opened: list[LiveSource],
) -> None:
    colour = np.full((48, 64, 3), 160, np.uint8)
    capture = Capture(grey(60), cv2.error("damaged"), colour)
    source = device(opened, Bus(capture).open)
    until(lambda: source._slot.count == 2)
    frame = next_frame(source)
    assert (level(frame), frame.image.shape) == (160, (48, 64))
    assert frame.t_s == pytest.approx(99.95)
    assert source.describe() == "camera:2 (64x48 px)"
    assert source.problem(100.0) is None
    assert not capture.released.is_set()
    source.close()
    assert capture.released.wait(WAIT_S)


def test_a_device_that_never_gives_a_picture_fails(opened: list[LiveSource]) -> None:
    capture = Capture()
    capture.unplugged = True
    source = device(opened, Bus(capture).open)
    assert not source.wait_first_frame(WAIT_S)
    assert "stopped delivering" in str(source.problem(float("-inf")))
    assert capture.reads == LOST_AFTER_FAILURES
    assert capture.released.wait(WAIT_S)


def test_a_device_that_comes_back_is_opened_again(opened: list[LiveSource]) -> None:
    first, clock = Capture(grey(60)), Clock()
    bus = Bus(first)
    source = device(opened, bus.open, clock)
    assert level(next_frame(source)) == 60
    bus.capture, first.unplugged = None, True
    until(lambda: bus.attempts > 3)
    assert first.released.is_set()
    clock.t_s = 102.0
    assert "was not found" in str(source.problem(102.0))
    assert source.problem(float("-inf")) is None, "it is not the end"
    bus.capture = again = Capture(grey(160))
    frame = next_frame(source)
    assert (level(frame), frame.index, frame.t_arrival_s) == (160, 1, 102.0)
    assert source.problem(102.0) is None
    assert not again.released.is_set()


@pytest.mark.parametrize(("read", "words"), [
    (lambda: (False, None), "connected, but it sends no data: for a receiver: check"),
    (lambda: (True, "torn"), r"pictures arrive but are dropped \(\d+ so far\): decoding failed"),
])  # fmt: skip
def test_a_camera_without_a_picture_says_what_came(
    read: Callable[[], Any], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether it is a receiver is not known."""
    capture = SimpleNamespace(read=read, release=lambda: None)
    monkeypatch.setattr("perchctl.camera.open.open_video_capture", lambda *_: capture)
    with pytest.raises(TimedOut, match=f"camera:0: no first frame within 0.2 s: {words}"):
        open_camera("camera:0", Clock(), timeout_s=0.2)
