"""Cameras of this computer behind a stand-in for their driver: names, modes, controls."""

from __future__ import annotations

import contextlib
import errno
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import pytest
from typer.testing import CliRunner

from perchctl.camera import find_cameras
from perchctl.camera.device import (
    Asked,
    DeviceSource,
    asked_of,
    camera_number,
    finder_of,
    set_controls,
    set_up,
)
from perchctl.camera.v4l2 import (
    Call,
    controls_of,
    open_driver,
    value_of,
)
from perchctl.commands import app, check
from perchctl.commands.check import camera_lines, list_cameras
from perchctl.errors import InvalidValue, NotFound
from perchctl.profile import CameraConfig
from tests.helpers.v4l2 import READ_ONLY, FakeControl, FakeDevice
from tests.helpers.waiting import until

WAIT_S = 10.0
FIXED = {
    "exposure_time_absolute": 80,  # named first, and can only be set after the next
    "auto_exposure": "manual mode",
    "white_balance_automatic": 0,
}


class Opener:
    """A computer with these cameras."""

    def __init__(self, devices: dict[int, FakeDevice | OSError]) -> None:
        self.devices = devices

    @contextlib.contextmanager
    def __call__(self, number: int) -> Iterator[Call]:
        device = self.devices[number]
        if isinstance(device, OSError):
            raise device
        yield device.call


@pytest.fixture
def dev(tmp_path: Path) -> Callable[..., Path]:
    """A /dev with such nodes and such lasting names."""

    def make(*numbers: int, **by_id: int) -> Path:
        (tmp_path / "v4l" / "by-id").mkdir(parents=True)
        for number in numbers:
            (tmp_path / f"video{number}").touch()
        for name, number in by_id.items():
            (tmp_path / "v4l" / "by-id" / name).symlink_to(tmp_path / f"video{number}")
        return tmp_path

    return make


# --- which there are ------------------------------------------------------------------


def test_a_camera_is_named_by_number_name_part_of_it_or_path(dev: Callable[..., Path]) -> None:
    devices = dev(0, 1, 2, 10, usb_cam=0, usb_grabber=2)
    opener = Opener({
        0: FakeDevice("HD Webcam C525"), 1: FakeDevice("HD Webcam C525", pictures_node=False),
        2: FakeDevice("USB Video"), 10: FakeDevice("USB Video: deluxe"),
    })  # fmt: skip

    def number(text: str) -> int:
        return camera_number(text, opener, devices, devices)

    assert number("7") == 7, "a number is not looked up"
    assert number("HD Webcam C525") == number('"webcam"') == number(" c525 ") == 0
    assert number("USB Video") == 2, "the whole name, though another holds it"
    assert number("'deluxe'") == 10
    assert number("usb_grabber") == number(f"{devices}/v4l/by-id/usb_grabber") == 2
    assert number(f"{devices}/video10") == 10
    with pytest.raises(InvalidValue, match=r"camera:usb fits 3 cameras: .*C525.* at .*usb_cam"):
        number("usb")
    with pytest.raises(NotFound, match=r"camera:nix was not found; there are camera:0 \(HD W"):
        number("nix")
    for text in ("", '""', " ", "-1"):
        with pytest.raises(InvalidValue, match="as in camera:0 or camera:USB Video"):
            number(text)


def test_two_of_one_name_are_told_apart_by_their_path(dev: Callable[..., Path]) -> None:
    devices = dev(0, 2, port_1=0, port_2=2)
    opener = Opener({0: FakeDevice(), 2: FakeDevice()})
    with pytest.raises(InvalidValue, match=r"fits 2 cameras: .*port_1, .*port_2; give"):
        camera_number("USB Video", opener, devices, devices)
    assert camera_number("port_2", opener, devices, devices) == 2


def test_one_that_may_not_be_opened_has_its_name_from_the_system(dev: Callable[..., Path]) -> None:
    devices = dev(3)
    names = devices / "names"
    (names / "video3").mkdir(parents=True)
    (names / "video3" / "name").write_text("Locked\n")
    opener = Opener({3: OSError(errno.EACCES, "Permission denied")})
    (camera,) = find_cameras(opener, devices, names, asked=True)
    assert (camera.number, camera.name, camera.controls) == (3, "Locked", ())
    assert "Permission denied" in camera.problem
    assert camera_number("lock", opener, devices, names) == 3
    assert "Permission denied" in "\n".join(camera_lines(camera))


def test_no_camera_at_all(dev: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(NotFound, match="this computer has no camera"):
        camera_number("USB", Opener({}), dev(), dev)  # type: ignore[arg-type]
    with pytest.raises(NotFound, match="this computer has no camera"):
        list_cameras(False, ())
    monkeypatch.setattr(check, "find_cameras", lambda asked: [])
    done = CliRunner().invoke(app, ["check", "--cameras", "--json"])
    assert done.exit_code == NotFound.exit_code
    said = json.loads(done.stdout)  # an object, as of every failure
    assert said["exit_code"] == NotFound.exit_code
    assert "has no camera" in said["error"]
    assert "has no camera" in done.stderr


def test_a_driver_that_is_not_there_is_an_os_error() -> None:
    with pytest.raises(OSError, match=r"video97|V4L2"), open_driver(97):
        pass


def test_a_camera_that_was_unplugged_is_found_by_path_or_name(dev: Callable[..., Path]) -> None:
    devices = dev(0, 1, 2, usb_grabber=1)
    own, twin, other = FakeDevice("USB Video"), FakeDevice("USB Video"), FakeDevice("Webcam")
    opener = Opener({0: other, 1: own, 2: twin})
    by_path = finder_of(1, opener, devices, devices)
    by_name = finder_of(2, opener, devices, devices)
    by_number = finder_of(7, opener, devices, devices)
    assert (by_path(), by_name(), by_number()) == (1, 2, 7)

    link = devices / "v4l" / "by-id" / "usb_grabber"
    link.unlink()
    for name in ("video1", "video2"):
        (devices / name).unlink()
    for find in (by_path, by_name):
        with pytest.raises(NotFound, match=r"USB Video.*not back"):
            find()

    (devices / "video5").touch()
    link.symlink_to(devices / "video5")
    opener.devices = {0: other, 5: own}
    assert by_path() == 5
    assert by_name() == 5, "the only one of its name"
    (devices / "video1").touch()
    opener.devices[1] = other
    assert by_path() == 5, "another camera has its number now"


def test_the_list_for_people_and_for_programs(
    dev: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    devices = dev(0, usb_grabber=0)
    known = find_cameras(Opener({0: FakeDevice()}), devices, devices, asked=True)
    assert list_cameras(False, known) == 0
    told = capsys.readouterr().out
    assert told.startswith("camera:0  USB Video\n")
    for part in ("usb_grabber", "auto_exposure = 3  (1 (Manual Mode), 3 (Aperture Priority Mode))",
                 "exposure_time_absolute = 157  (1 to 5000, held by an automatic one)",
                 "gain = 10  (0 to 100 in steps of 5)"):  # fmt: skip
        assert part in told
    assert list_cameras(True, known) == 0
    (record,) = json.loads(capsys.readouterr().out)
    assert record["source"] == "camera:0"
    controls = {control["name"]: value for control, value in record["controls"]}
    assert controls["exposure_time_absolute"] == 157


# --- controls -------------------------------------------------------------------------


def values(device: FakeDevice) -> dict[str, int]:
    return {n: value_of(device.call, k) for n, k in controls_of(device.call).items()}


def test_controls_are_set_the_automatic_ones_first_and_read_back() -> None:
    device = FakeDevice()
    set_controls(device.call, FIXED, "camera:0")
    got = values(device)
    assert {name: got[name] for name in FIXED} == {
        "exposure_time_absolute": 80, "auto_exposure": 1, "white_balance_automatic": 0,
    }  # fmt: skip
    assert device.log[-1] == "Exposure Time, Absolute = 80"


@pytest.mark.parametrize(("wanted", "sentence"), [
    ({"shutter": 1}, r"no control 'shutter' \(camera.controls\); it has brightness, white_bal"),
    ({"gain": 101}, r"camera.controls.gain: found 101; allowed are 0 to 100 in steps of 5"),
    ({"gain": 12}, r"found 12; allowed are 0 to 100 in steps of 5"),
    ({"gain": "high"}, r"found 'high'; allowed are 0 to 100"),
    ({"white_balance_automatic": 2}, r"allowed are 0 \(off\) or 1 \(on\)"),
    ({"auto_exposure": 2}, r"allowed are 1 \(Manual Mode\), 3 \(Aperture Priority Mode\)"),
    ({"exposure_time_absolute": 80}, r"could not be set to 80 .* while an automatic control"),
    ({"sensor": 1}, r"camera.controls.sensor can only be read"),
    ({"brightness": 5}, r"camera.controls.brightness was set to 5 and reads 0"),
])  # fmt: skip
def test_what_the_driver_does_not_take_is_one_sentence(
    wanted: dict[str, Any], sentence: str
) -> None:
    device = FakeDevice(stubborn=("Brightness",))
    device.controls.append(FakeControl(0x9E0901, "Sensor", 1, 0, 9, 1, flags=READ_ONLY))
    with pytest.raises(InvalidValue, match=f"^camera:0.*{sentence}"):
        set_controls(device.call, wanted, "camera:0")


def test_a_driver_without_controls_says_so() -> None:
    with pytest.raises(InvalidValue, match="its driver has none at all"):
        set_controls(FakeDevice(controls=[]).call, {"gain": 1}, "camera:0")


def test_a_driver_that_lists_for_ever_is_left() -> None:
    def stuck(request: int, data: bytearray) -> None:
        data[0:4] = (7).to_bytes(4, "little")

    assert len(controls_of(stuck)) <= 1


# --- the source -----------------------------------------------------------------------


def opened(device: FakeDevice, asked: Asked) -> DeviceSource:
    return DeviceSource(
        0, 0.05, asked, lambda: 100.0, lambda n, asked: device, device.opener, retry_s=0.0
    )


def test_controls_are_set_before_the_first_picture_and_again_where_streaming_resets_them() -> None:
    device = FakeDevice(resets={"Exposure Time, Absolute": 157})
    source = opened(device, Asked(controls=FIXED))
    try:
        assert source.wait_first(WAIT_S)
        first = device.log.index("read")
        assert "Exposure Time, Absolute = 80" in device.log[:first]
        assert values(device)["exposure_time_absolute"] == 157, "the driver has forgotten it"
        assert source.remarks() == []
        assert values(device)["exposure_time_absolute"] == 80
    finally:
        source.close()


def test_controls_are_set_again_when_a_camera_comes_back() -> None:
    device = FakeDevice()
    source = DeviceSource(
        0, 0.05, Asked(controls=FIXED), lambda: 100.0, lambda n, asked: device, device.opener,
        retry_s=0.0, reopen_every_s=0.0,
    )  # fmt: skip
    try:
        assert source.wait_first(WAIT_S)
        fresh = FakeDevice(resets={"Exposure Time, Absolute": 157})
        device.controls, device.resets = fresh.controls, fresh.resets
        assert values(device)["auto_exposure"] == 3
        device.unplugged = True
        until(lambda: device.released)
        device.unplugged = False
        until(lambda: not source._reopened and device.log[-1] == "read")
        until(lambda: {name: values(device)[name] for name in FIXED} == {
            "exposure_time_absolute": 80, "auto_exposure": 1, "white_balance_automatic": 0,
        })  # fmt: skip
    finally:
        source.close()


def test_what_cannot_be_set_ends_it_with_the_device_released() -> None:
    device = FakeDevice()
    with pytest.raises(InvalidValue, match="no control 'shutter'"):
        opened(device, Asked(controls={"shutter": 1}))
    assert device.released


@pytest.mark.parametrize(("device", "told"), [
    (FakeDevice(format="YUYV", rate_hz=15.0),
     ["MJPG .* gives YUYV", "720x576 px, the cal.* 640x480", "25 Hz .* gives 15 Hz"]),
    (FakeDevice(format="MJPG", rate_hz=25.1, size=(720, 576)), []),
    (FakeDevice(format="", rate_hz=0.0, size=(720, 576)), []),
])  # fmt: skip
def test_what_is_delivered_otherwise_is_told(device: FakeDevice, told: list[str]) -> None:
    """What OpenCV does not know is no news."""
    source = opened(device, Asked((720, 576), "MJPG", 25.0))
    try:
        assert source.wait_first(WAIT_S)
        remarks = source.remarks()
    finally:
        source.close()
    assert len(remarks) == len(told)
    for remark, words in zip(remarks, told, strict=True):
        assert re.search(f"^camera:0 was asked for {words}", remark)


def test_without_v4l2_the_pictures_come_and_only_controls_are_refused() -> None:
    @contextlib.contextmanager
    def nothing(number: int) -> Iterator[Call]:
        raise OSError(errno.ENOSYS, "this system has no V4L2")
        yield

    device = FakeDevice()
    source = DeviceSource(0, 0.0, Asked(), lambda: 1.0, lambda n, a: device, nothing)
    assert source.wait_first(WAIT_S)
    assert source.remarks() == []
    source.close()
    with pytest.raises(InvalidValue, match="no V4L2"):
        DeviceSource(0, 0.0, Asked(controls=FIXED), lambda: 1.0, lambda n, a: device, nothing)


def test_opencv_is_asked_for_format_then_size_then_rate() -> None:
    class Capture:
        def __init__(self) -> None:
            self.said: list[tuple[int, float]] = []

        def set(self, prop: int, value: float) -> None:
            self.said.append((prop, value))

    capture = Capture()
    config = CameraConfig(format="MJPG", rate_hz=25, controls={"gain": 5})
    asked = asked_of(config, (720, 576))
    assert asked == Asked((720, 576), "MJPG", 25.0, {"gain": 5})
    set_up(capture, asked)
    assert [prop for prop, _ in capture.said] == [
        cv2.CAP_PROP_FOURCC, cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT,
        cv2.CAP_PROP_FPS, cv2.CAP_PROP_BUFFERSIZE,
    ]  # fmt: skip
    assert int(capture.said[0][1]) == int.from_bytes(b"MJPG", "little")
