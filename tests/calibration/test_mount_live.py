"""`perchctl calibrate mount` on a live camera and vehicle: read, guided, kept, never armed."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")


from perchctl.calibration import (
    AttitudeSample,
    GuidedFrame,
    MountingRecording,
    PoseReader,
    load_calibration,
    record_mounting,
)
from perchctl.calibration.mounting.capture import LEAST_S, MOST_S
from perchctl.calibration.mounting.recording import SeenPose
from perchctl.commands import calibrate_mount
from perchctl.errors import InvalidValue, TimedOut
from perchctl.link import MotionLink
from perchctl.sim import Scenario, SimProcess
from perchctl.vision import Frame
from tests.helpers.calibrating import calibrate
from tests.helpers.mounting import hand, seen
from tests.helpers.relay import relayed

RPY_RAD = (0.1, 0.2, 0.5)
STILL = Scenario(ceiling_z_m=1.4)


@pytest.fixture(scope="module")
def sim(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimProcess]:
    """A vehicle that a hand holds still, 0.8 m under the target."""
    camera = load_calibration("example_640x480.yaml")
    with pytest.MonkeyPatch.context() as patch, SimProcess.start(STILL, camera=camera) as process:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))
        process.set_pose((0.0, 0.0, 0.6), RPY_RAD, hold=True)
        process.reboot()  # its attitude is the hand's from the start, not drawn to it in seconds
        yield process


def press_after(poses: int) -> Callable[[object], contextlib.AbstractContextManager[object]]:
    """In the guide's place: Ctrl-C once so many poses are there."""

    @contextlib.contextmanager
    def pressing(_page: object) -> Iterator[Callable[[GuidedFrame], None]]:
        pressed: list[bool] = []

        def tell(moment: GuidedFrame) -> None:
            if int(dict(row[:2] for row in moment.rows)["pictures"]) >= poses and not pressed:
                pressed.append(True)
                os.kill(os.getpid(), signal.SIGINT)

        yield tell

    return pressing


def test_it_reads_and_commands_nothing_and_ctrl_c_keeps_the_recording(
    sim: SimProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(calibrate_mount, "guide", press_after(10))
    Path("mine.yaml").write_text("extends: crazyflie\n", encoding="utf-8")
    with relayed(sim.uri) as relay:
        words = ["-p", "mine.yaml", "-u", relay.uri, "--source", sim.stream_url, "--part", "carry"]
        said = calibrate("mount", *words)
        assert relay.up
        assert relay.commands() == []
        assert relay.writes() == []
    assert max(sim.truth()["motors"]) == 0
    assert said.exit_code == 130, said.stderr
    log = Path("calib/mounting_mine.jsonl")
    assert f"kept the recording: {log}" in said.stderr
    assert f"--from {log}" in said.stderr
    (recording,) = MountingRecording.read(log)
    assert len(recording.poses) >= 10
    newest = recording.attitudes[-1]
    rpy_rad = (newest.roll_rad, newest.pitch_rad, newest.yaw_rad)
    assert rpy_rad == pytest.approx(sim.truth()["rpy_rad"], abs=0.05)
    ages_s = np.diff([a.t_s for a in recording.attitudes])
    assert np.median(ages_s) == pytest.approx(0.01, abs=1e-4)
    assert abs(recording.poses[-1].t_s - newest.t_s) < 0.5  # one clock
    again = calibrate("mount", "-p", "mine.yaml", "--from", log)
    assert again.exit_code == 30
    assert "lacks motion" in again.stderr


@pytest.mark.long
def test_a_vehicle_that_does_not_answer(
    sim: SimProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mute:
        mute.bind(("127.0.0.1", 0))
        uri = f"udp://127.0.0.1:{mute.getsockname()[1]}"
        Path("mine.yaml").write_text(
            "extends: crazyflie\nlink: {connect_timeout_s: 0.5}\n", encoding="utf-8"
        )
        words = ["-p", "mine.yaml", "-u", uri, "--source", sim.stream_url]
        said = calibrate("mount", *words)
    assert said.exit_code == 10
    assert f"no Crazyflie at {uri}: no answer" in said.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["mine.yaml"]


def test_turning_motors_end_it(
    sim: SimProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A vehicle in a hand must not have them on."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(MotionLink, "motors_run", True)
    words = ["-p", "crazyflie", "-u", sim.uri, "--source", sim.stream_url]
    said = calibrate("mount", *words)
    assert said.exit_code == 52
    assert "motors" in said.stderr
    assert not list(tmp_path.iterdir())


# --- the guided recording, without a clock -------------------------------------------------


class _Film:
    """A live source that runs by `now`: one picture each 1/15 s, until `ends_s`."""

    live = True
    finished = False
    size_px = (640, 480)

    def __init__(self, ends_s: float = np.inf, flooding: bool = False) -> None:
        self.now_s, self._ends_s, self._count = 0.0, ends_s, 0
        self._flooding = flooding  # pictures faster than they are looked at

    def clock(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds

    def poll(self, now_s: float) -> Frame | None:
        if now_s > self._ends_s or (now_s * 15.0 < self._count and not self._flooding):
            return None
        self._count += 1
        self.now_s += 0.01 * self._flooding
        return Frame(self._count, now_s, np.zeros((480, 640), np.uint8), now_s)

    def problem(self, now_s: float) -> str | None:
        return "camera:0 is unplugged" if now_s > self._ends_s else None

    def describe(self) -> str:
        return "camera:0"

    def close(self) -> None:
        return None


class _Looks(PoseReader):
    """Gives the poses of a recording at their times, or none."""

    def __init__(self, poses: list[SeenPose], mirrored: bool = False) -> None:
        self._poses, self._is_mirrored = list(poses), mirrored
        self.mirrored, self.outlines, self.trouble = 0, (), ""

    def look(self, frame: Frame) -> list[SeenPose]:
        self.mirrored += self._is_mirrored
        found = [pose for pose in self._poses if pose.t_s <= frame.t_s]
        del self._poses[: len(found)]
        return found


def recorded(
    recording: MountingRecording,
    film: _Film,
    looks: _Looks,
    attitudes: list[AttitudeSample] | None = None,
    problem: Callable[[float], str | None] = lambda now_s: None,
    until_s: float = np.inf,
) -> list[GuidedFrame]:
    """Fill the recording from the film, by its own clock; the moments that were shown."""
    moments: list[GuidedFrame] = []
    left = list(attitudes or [])

    def arrived() -> list[AttitudeSample]:
        due = [a for a in left if a.t_s <= film.now_s]
        del left[: len(due)]
        return due

    record_mounting(
        recording, film, looks, moments.append, arrived, problem, film.clock, film.sleep,
        lambda: film.now_s > until_s,
    )  # fmt: skip
    return moments


def test_it_ends_when_no_turn_is_missing_and_says_which_is_until_then() -> None:
    whole = seen(hand("carry", seconds=LEAST_S["carry"] + 3.0))
    film, recording = _Film(), MountingRecording("carry")
    moments = recorded(recording, film, _Looks(whole.poses), whole.attitudes)
    assert film.now_s == pytest.approx(LEAST_S["carry"], abs=0.5)
    assert moments[-1].advice.startswith("enough")
    assert ("missing", "nothing", None) in moments[-1].rows
    assert any("turn it about the vertical" in row[1] for m in moments for row in m.rows)
    assert recording.poses[:100] == whole.poses[:100]


@pytest.mark.parametrize(
    ("mirrored", "words"), [(False, "no target in view"), (True, "camera.mirrored")]
)
def test_the_advice_names_what_is_in_the_way_first(mirrored: bool, words: str) -> None:
    looks = _Looks([], mirrored)
    moments = recorded(MountingRecording("pivot"), _Film(), looks, until_s=2.0)
    assert words in moments[-1].advice


class _Receiver(_Film):
    """Gives each picture three times, and from `stuck_s` on the last one again and again."""

    def __init__(self, stuck_s: float = np.inf) -> None:
        super().__init__()
        self._stuck_s = stuck_s

    def poll(self, now_s: float) -> Frame | None:
        frame = super().poll(now_s)
        again = self._count % 3 != 1 or now_s > self._stuck_s
        return frame if frame is None else replace(frame, repeated=again)


class _SeesEachNew(_Looks):
    def look(self, frame: Frame) -> list[SeenPose]:
        return [] if frame.repeated else [replace(self._poses[0], t_s=frame.t_s)]


def test_a_receivers_repetitions_are_no_pictures_without_the_target() -> None:
    looks, recording = _SeesEachNew(seen(hand("pivot")).poses), MountingRecording("pivot")
    moments = recorded(recording, _Receiver(), looks, until_s=4.0)
    assert {share for m in moments for name, _, share in m.rows if name == "target"} == {1.0}
    assert len(moments) == len(recording.poses) == pytest.approx(20, abs=2)
    film = _Receiver(stuck_s=1.0)
    recorded(MountingRecording("pivot"), film, looks)
    assert film.now_s == pytest.approx(MOST_S, abs=1.0), "nobody records for ever"


def test_a_mirrored_picture_ends_it_soon() -> None:
    film = _Film()
    with pytest.raises(InvalidValue, match=r"mirrored.*camera\.mirrored"):
        recorded(MountingRecording("carry"), film, _Looks([], mirrored=True))
    assert film.now_s < 5.0


@pytest.mark.parametrize(
    ("film", "problem", "said"),
    [
        (_Film(ends_s=3.0), None, "camera:0 is unplugged"),
        (_Film(flooding=True), "nothing heard for 2 s", "the vehicle is gone: nothing heard"),
    ],
)
def test_a_camera_or_a_vehicle_that_goes_ends_it_and_keeps_what_was(
    film: _Film, problem: str | None, said: str
) -> None:
    recording = MountingRecording("pivot")
    with pytest.raises(TimedOut, match=said):
        recorded(
            recording, film, _Looks(seen(hand("pivot")).poses),
            problem=lambda now_s: problem if now_s > 1.0 else None,
        )  # fmt: skip
    assert len(recording.poses) > 5
