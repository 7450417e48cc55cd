"""A motion capture behind its library: good ones, and each way in which one fails."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest

import perchctl
from perchctl.errors import ConnectionFailed, InvalidValue, PerchError, UsageError
from perchctl.positioning import PositionFeed, open_capture
from perchctl.positioning import capture as capture_module
from perchctl.positioning.capture import CaptureSetup, LateFrames, MotionCapture, capture_setup
from perchctl.profile import PositioningConfig
from perchctl.vehicle import ExternalPosition
from tests.helpers.capture import LIBRARY
from tests.helpers.live import Clock
from tests.helpers.waiting import until

ROOT = Path(perchctl.__file__).resolve().parents[1]


@pytest.fixture
def faulty(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., MotionCapture]]:
    """Opens the reader on the library that is faulty by the host's name."""
    (tmp_path / "motioncapture.py").write_text(LIBRARY)
    monkeypatch.syspath_prepend(str(tmp_path))
    paths = os.pathsep.join([str(tmp_path), *os.environ.get("PYTHONPATH", "").split(os.pathsep)])
    monkeypatch.setenv("PYTHONPATH", paths)
    opened: list[MotionCapture] = []

    def start(fault: str, system: str = "vicon", timeout_s: float = 10.0) -> MotionCapture:
        config = PositioningConfig(
            by="mocap", system=system, host=fault, body="cf", connect_timeout_s=timeout_s
        )
        opened.append(open_capture(config))
        return opened[-1]

    yield start
    for one in opened:
        one.close()


def problem(capture: MotionCapture) -> str:
    return capture.problem(time.monotonic()) or ""


def test_frames_come_with_the_time_of_their_arrival(faulty: Callable[..., MotionCapture]) -> None:
    capture = faulty("good")
    frame = None
    before_s = time.monotonic()

    def fresh() -> bool:
        nonlocal frame
        frame = capture.poll(time.monotonic()) or frame
        return frame is not None and frame.t_s > before_s

    until(fresh)
    assert frame is not None
    assert frame.t_s <= time.monotonic()
    assert set(frame.bodies) == {"cf", "cf2"}
    assert frame.bodies["cf"].quaternion == (1.0, 0.0, 0.0, 0.0)
    assert frame.bodies["cf"].position_m[0] > 1.0


@pytest.mark.parametrize(("fault", "words"), [
    ("refuses", "no motion capture at vicon:refuses: Error connecting QTM"),
    ("aborts", "its reader ended with code 134: what(): Network is unreachable"),
    ("hangs", "no frame within 0.3 s"),
    ("silent", "no frame within 0.3 s"),
])  # fmt: skip
def test_none_is_one_sentence_in_bounded_time(
    faulty: Callable[..., MotionCapture], fault: str, words: str
) -> None:
    with pytest.raises(ConnectionFailed) as caught:
        faulty(fault, timeout_s=0.3 if "0.3" in words else 10.0)
    assert words in str(caught.value)
    assert caught.value.exit_code == 10
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("why", ["libvrpn.so.7: cannot open", "No module named 'yaml_of_it'"])
def test_a_library_that_does_not_load_is_not_a_capture_that_is_gone(
    faulty: Callable[..., MotionCapture], tmp_path: Path, why: str
) -> None:
    (tmp_path / "motioncapture.py").write_text(f"raise ImportError({why!r})\n")
    with pytest.raises(UsageError) as caught:
        faulty("good")
    said = str(caught.value)
    assert f"the motioncapture library cannot be loaded: {why}; reinstall it with: " in said
    assert said.endswith("'perchctl[mocap]'")
    assert caught.value.exit_code == 2


def test_vrpn_answers_by_bodies_alone(faulty: Callable[..., MotionCapture]) -> None:
    """Its loop turns also where nobody serves."""
    with pytest.raises(ConnectionFailed, match="no frame within"):
        faulty("empty", system="vrpn", timeout_s=0.3)
    assert faulty("empty", system="vicon").problem(time.monotonic()) is None


@pytest.mark.parametrize(("fault", "words"), [
    ("dies", "vicon:dies: its reader ended with code 7: the camera burnt"),
    ("raises", "vicon:raises failed: subject table changed"),
    ("stalls", "vicon:stalls has sent no frame for 0."),
])  # fmt: skip
def test_what_ends_on_the_way_is_named_and_closing_ends_the_process(
    faulty: Callable[..., MotionCapture], fault: str, words: str
) -> None:
    capture = faulty(fault)
    until(lambda: f"motion capture at {words}" in problem(capture))
    capture.poll(time.monotonic())
    assert capture.poll(time.monotonic()) is None
    capture.close()
    capture.close()
    assert capture._child.poll() is not None
    assert not any(thread.is_alive() for thread in capture._threads)


@pytest.mark.parametrize(("waits_s", "counts"), [
    ([0.01] * 3 + [0.12, *[1e-5] * 11] * 3 + [0.12], [0, 12, 12, 12]),
    ([0.2] * 4, [0, 1, 1, 1]),
    ([0.01] * 30 + [0.12] + [0.01] * 30 + [0.12], [0, 0]),
])  # fmt: skip
def test_the_frames_between_two_pauses_are_counted(
    waits_s: list[float], counts: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, sent = Clock(), list[object]()
    monkeypatch.setattr(capture_module, "time", SimpleNamespace(monotonic=clock))
    channel: Any = SimpleNamespace(send=sent.append)
    with pytest.raises(RuntimeError):
        capture_module._pass_on(Client(clock, waits_s), channel, False)
    assert [late.count for late in sent if isinstance(late, LateFrames)] == counts


@pytest.mark.parametrize(("fault", "words"), [
    ("bursts", r"vicon:bursts sends its frames late, in bursts \(12 at once after 0\.1\d s\), "
     "so they are not used; connect it by cable"),
    ("slow", r"vicon:slow sends a frame only every 0\.1\d s, so its frames are not used; set it"),
])  # fmt: skip
def test_frames_that_come_late_are_not_called_silence(
    faulty: Callable[..., MotionCapture], fault: str, words: str
) -> None:
    """They come, and each may be old; what helps is not what helps against silence."""
    with contextlib.suppress(ConnectionFailed):  # a burst that is slow by chance has a good frame
        capture = faulty(fault, timeout_s=1.0)
        until(lambda: re.search(words, problem(capture)))
        return
    with pytest.raises(ConnectionFailed, match=words):
        faulty(fault, timeout_s=1.0)


def test_one_pause_is_no_burst(faulty: Callable[..., MotionCapture]) -> None:
    capture = faulty("pauses")
    until(lambda: "has paused for 0.1" in problem(capture))
    until(lambda: problem(capture) == "")


def test_a_flood_of_frames_fills_nothing(faulty: Callable[..., MotionCapture]) -> None:
    capture = faulty("floods")
    first = capture._frames[0]
    until(lambda: capture._frames[0] is not first)
    assert len(capture.frames()) <= capture_module.KEPT
    seen, end_s = 0, time.monotonic() + 0.3
    while time.monotonic() < end_s:
        seen += len(capture.frames())
    assert seen < 0.3 * 600


def test_a_library_that_prints_without_end_is_read_away(
    faulty: Callable[..., MotionCapture], capfd: pytest.CaptureFixture[str]
) -> None:
    capture = faulty("prints")
    for _ in range(20):
        until(lambda: capture.poll(time.monotonic()))
    assert problem(capture) == ""
    assert len(capture._last_line) <= capture_module.LONGEST_LINE
    assert capfd.readouterr() == ("", "")


def test_bodies_that_come_one_by_one_do_not_hide_each_other(
    faulty: Callable[..., MotionCapture],
) -> None:
    capture = faulty("turns", system="vrpn")
    until(lambda: len(capture._frames) >= 9)
    frame = capture.poll(time.monotonic())
    assert frame is not None
    assert set(frame.bodies) == {"cf"}


@pytest.mark.long
@pytest.mark.parametrize("fault", ["stalls", "hangs"])
@pytest.mark.skipif(sys.platform == "win32", reason="kills by signal")
def test_it_ends_with_a_parent_that_was_killed(
    faulty: Callable[..., MotionCapture], fault: str
) -> None:
    code = (
        f"import sys, time; sys.path.append({str(ROOT)!r})\n"
        "from perchctl.positioning.capture import MotionCapture, capture_setup\n"
        "from perchctl.profile.positioning import PositioningConfig\n"
        f"config = PositioningConfig(by='mocap', host={fault!r}, body='cf', connect_timeout_s=1)\n"
        "class Told(MotionCapture):\n"
        "    def _words(self): print(self._child.pid, flush=True); time.sleep(60)\n"
        "one = Told(capture_setup(config), '', 'cf'); one._words()\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    parent.stdout.close()
    stat = Path(f"/proc/{pid}/stat")
    until(lambda: not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] == "Z")


def test_without_a_host_or_the_library_nothing_is_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InvalidValue, match=r"positioning: \{by: mocap, system: vicon, host:"):
        open_capture(PositioningConfig(by="mocap"))
    monkeypatch.setattr("perchctl.positioning.feed.find_spec", lambda name: None)
    with pytest.raises(UsageError) as caught:
        open_capture(PositioningConfig(by="mocap", host="lab"))
    assert f"{sys.executable} -m pip install 'perchctl[mocap]'" in str(caught.value)
    assert isinstance(caught.value, PerchError)


@pytest.mark.parametrize(("system", "host", "options"), [
    ("qualisys", "lab:22223", {"hostname": "lab", "port": "22223"}),
    ("optitrack", "10.0.0.2:1511", {"hostname": "10.0.0.2", "port_command": "1511"}),
    ("vicon", "lab:801", {"hostname": "lab:801"}),
])  # fmt: skip
def test_a_port_goes_where_the_library_wants_it(
    system: str, host: str, options: dict[str, str]
) -> None:
    config = PositioningConfig.model_validate({"by": "mocap", "system": system, "host": host})
    assert capture_setup(config).options == options


def test_the_real_library_through_its_process() -> None:
    """Its own stand-in for a system repeats one pose to the last bit: what it delivers is read,
    and the feed takes it for what it looks like, a capture that stands still."""
    pytest.importorskip("motioncapture")
    places: list[ExternalPosition] = []
    config = PositioningConfig(by="mocap", host="here", body="cf", body_rpy_deg=(0.0, 0.0, 90.0))
    bodies = {"rigid_bodies": "cf(1,2,3,0.70710678,0,0,0.70710678);wand(0,0,1,1,0,0,0)"}
    capture = MotionCapture(CaptureSetup("mock", bodies), "motion capture mock", "cf")
    feed = PositionFeed(capture, places.append, config)
    try:
        feed.start(time.monotonic)
        until(lambda: "frozen" in (feed.status(time.monotonic()).problem or ""))
    finally:
        feed.close()
        capture.close()
    assert len(places) == 1
    assert places[0].position_m == pytest.approx((1.0, 2.0, 3.0))


def test_your_own_source_feeds_the_vehicle_its_positions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As every capture: turned into body axes, and refused once it stands still."""
    (tmp_path / "my_capture.py").write_text(
        "from perchctl import BodyPose, CaptureFrame\n"
        "class Source:\n"
        "    def __init__(self, clock, config): self.start_s = clock()\n"
        "    def poll(self, now_s):\n"
        "        x_m = min(now_s - self.start_s, 1.0)\n"
        "        pose = BodyPose((x_m, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))\n"
        "        return CaptureFrame(now_s, {'cf': pose})\n"
        "    def problem(self, now_s): return None\n"
        "    def close(self): pass\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    config = PositioningConfig(by="mocap", system="my_capture:Source", body="cf")
    places: list[ExternalPosition] = []
    feed = PositionFeed(open_capture(config, lambda: 5.0), places.append, config)
    for turn in range(101):
        feed.poll_and_send(5.0 + 0.01 * turn)
    assert feed.status(6.0).problem is None
    assert places[-1].position_m == pytest.approx((1.0, 2.0, 3.0), abs=0.05)
    for turn in range(101, 301):
        feed.poll_and_send(5.0 + 0.01 * turn)
    assert "frozen" in (feed.status(8.0).problem or "")
    assert places[-1].position_m[0] == pytest.approx(1.0, abs=0.02)


# --- The reader's process: it ends with its parent, and not before -----------------------------


@pytest.mark.long
def test_a_reader_outlives_the_time_in_which_it_was_set_up(
    faulty: Callable[..., MotionCapture],
) -> None:
    reader, end_s = faulty("good", timeout_s=1.0), time.monotonic() + 2.5
    until(lambda: (frame := reader.poll(time.monotonic())) and frame.t_s > end_s)


class Client:
    """Gives a frame after each of these waits, s, and then is gone."""

    rigidBodies: ClassVar[dict[str, object]] = {}

    def __init__(self, clock: Clock, waits_s: list[float]) -> None:
        self.clock, self.waits_s = clock, iter(waits_s)

    def waitForNextFrame(self) -> None:
        wait_s = next(self.waits_s, None)
        if wait_s is None:
            raise RuntimeError("gone")
        self.clock.t_s += wait_s


def test_what_waited_in_the_library_s_queue_is_not_passed_on_as_new(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """After a pause come the frames of the pause, one upon the other, the oldest first."""
    clock, sent = Clock(), list[tuple[float, object]]()
    monkeypatch.setattr(capture_module, "time", SimpleNamespace(monotonic=clock))
    steady, queued = [0.01] * 3, [0.5, 1e-5, 1e-5, 9e-4]
    channel: Any = SimpleNamespace(send=sent.append)
    with pytest.raises(RuntimeError):
        capture_module._pass_on(Client(clock, steady + queued + steady), channel, False)
    begun_s = 100.0 + sum(steady) + sum(queued)
    assert sent.pop(3) == LateFrames(0, pytest.approx(0.5))
    assert len(sent) == 2 * len(steady)
    assert not [t_s for t_s, _ in sent if 100.0 + sum(steady) + 1e-6 < t_s <= begun_s + 1e-6]
