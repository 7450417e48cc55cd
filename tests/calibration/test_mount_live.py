"""`perchctl calibrate mount` on a live camera and vehicle: read, guided, kept, never armed."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

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
from perchctl.calibration.mounting.capture import LEAST_RECORDING_S, MOST_S
from perchctl.calibration.mounting.recording import TargetPose
from perchctl.commands import calibrate_mount
from perchctl.errors import InvalidValue, NotFound, TimedOut
from perchctl.geometry import rotation_from_rpy
from perchctl.link import AttitudeLink
from perchctl.sim import Scenario, SimProcess
from perchctl.vision import Frame
from tests.helpers.calibrating import calibrate
from tests.helpers.mounting import hand, seen
from tests.helpers.relay import Relay

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
    monkeypatch.setattr("perchctl.commands.progress.guidance_display", press_after(30))
    at_its_end = SimpleNamespace(isatty=lambda: True)  # a terminal's input
    monkeypatch.setattr(calibrate_mount, "sys", SimpleNamespace(stdin=at_its_end))
    Path("mine.yaml").write_text("extends: crazyflie\n", encoding="utf-8")
    with closing(Relay(sim.uri)) as relay:
        words = ["-p", "mine.yaml", "-u", relay.uri, "--source", sim.stream_url, "--part", "carry"]
        said = calibrate("mount", *words)
        assert relay.up
        assert relay.commands() == []
        assert relay.writes() == []
    assert max(sim.truth()["motors"]) == 0
    assert said.exit_code == 130, said.stderr
    log = Path("calib/mounting_mine.jsonl")
    assert f"kept the recording {log};" in said.stderr
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


def test_turning_motors_end_it(
    sim: SimProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A vehicle in a hand must not have them on."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(AttitudeLink, "motors_running", True)
    words = ["-p", "crazyflie", "-u", sim.uri, "--source", sim.stream_url]
    said = calibrate("mount", *words)
    assert said.exit_code == 52
    assert "motors" in said.stderr
    assert not list(tmp_path.iterdir())


# --- the guided recording, without a clock -------------------------------------------------


class _Film:
    """A live source that runs by its own clock: one picture each 1/15 s, until `ends_s`, each
    given `times` times."""

    live, finished, size_px = True, False, (640, 480)

    def __init__(self, ends_s: float = np.inf, times: int = 1) -> None:
        self.now_s, self._ends_s, self._times, self._count = 0.0, ends_s, times, 0

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds

    def poll(self, now_s: float) -> Frame | None:
        if now_s > self._ends_s or now_s * 15.0 * self._times < self._count:
            return None
        self._count += 1
        again = self._count % self._times != 1 % self._times
        return Frame(self._count, now_s, np.zeros((480, 640), np.uint8), now_s, is_repeated=again)

    def problem(self, now_s: float) -> str | None:
        return "camera:0 is unplugged" if now_s > self._ends_s else None

    def describe(self) -> str:
        return "camera:0"

    def close(self) -> None:
        return None


class _Looks(PoseReader):
    """Gives the poses of a recording at their times, or none."""

    def __init__(self, poses: list[TargetPose], mirrored: bool = False) -> None:
        self._poses, self._is_mirrored = list(poses), mirrored
        self.mirrored, self.outlines, self.trouble = 0, (), ""

    def read_poses(self, frame: Frame) -> list[TargetPose]:
        self.mirrored += self._is_mirrored
        due = [] if frame.is_repeated else [pose for pose in self._poses if pose.t_s <= frame.t_s]
        del self._poses[: len(due)]
        return due


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
        recording, film, looks, moments.append, arrived, problem, lambda: film.now_s, film.sleep,
        lambda: film.now_s > until_s,
    )  # fmt: skip
    return moments


def test_it_ends_when_no_turn_is_missing_and_says_which_is_until_then() -> None:
    whole = seen(hand("carry", seconds=LEAST_RECORDING_S["carry"] + 3.0))
    film, recording = _Film(), MountingRecording("carry")
    moments = recorded(recording, film, _Looks(whole.poses), whole.attitudes)
    assert film.now_s == pytest.approx(LEAST_RECORDING_S["carry"], abs=0.5)
    assert moments[-1].advice.startswith("enough")
    assert ("missing", "nothing", None) in moments[-1].rows
    assert any("turn the vehicle about the vertical" in row[1] for m in moments for row in m.rows)
    assert recording.poses[:100] == whole.poses[:100]


def test_a_receivers_repetitions_are_no_pictures_without_the_target() -> None:
    recording = MountingRecording("pivot")
    film, poses = _Film(times=3), seen(hand("pivot")).poses
    moments = recorded(recording, film, _Looks(poses), until_s=4.0)
    assert len(moments) == pytest.approx(60, abs=3)
    (bar,) = [bar for name, _, bar in moments[-1].rows if name == "target"]
    assert bar is not None
    assert bar.end > 0.8
    film = _Film()
    moments = recorded(MountingRecording("pivot"), film, _Looks([]))
    assert moments[-1].advice == "no target in view"
    assert film.now_s == pytest.approx(MOST_S, abs=1.0), "nobody records for ever"


@pytest.mark.parametrize(
    ("film", "looks", "error", "said"),
    [
        (_Film(ends_s=3.0), _Looks([]), TimedOut, "camera:0 is unplugged"),
        (_Film(), _Looks([]), TimedOut, "lost the vehicle: no packet received"),
        (_Film(), _Looks([], mirrored=True), InvalidValue, r"mirrored.*camera\.mirrored"),
    ],
)
def test_what_ends_it_early_is_named_and_what_was_recorded_is_kept(
    film: _Film, looks: _Looks, error: type[Exception], said: str
) -> None:
    recording = MountingRecording("pivot")
    samples = seen(hand("pivot")).attitudes
    with pytest.raises(error, match=said):
        recorded(
            recording, film, looks, samples,
            lambda now_s: "no packet received for 2 s" if now_s > 4.5 and "lost" in said else None,
        )  # fmt: skip
    assert film.now_s < 7.0
    assert len(recording.attitudes) > 200


# --- the recording's file ------------------------------------------------------------------------


@pytest.fixture
def recordings() -> list[MountingRecording]:
    rng = np.random.default_rng(1)
    attitudes = [
        AttitudeSample(1.25, 0.1, -0.2, 3.0, rng.normal(size=3)),
        AttitudeSample(1.26, 0.1, -0.2, -3.1, np.array([0.02, 1.0, 2.0])),
    ]
    root, R = rng.normal(size=(6, 6)) * 1e-4, rotation_from_rpy(3.0, 0.4, -2.0)
    poses = [TargetPose(t_s, R, rng.normal(size=3), root @ root.T) for t_s in (1.3, 1.33)]
    return [
        MountingRecording("carry", attitudes, poses, 3),
        MountingRecording("pivot", [], poses[:1]),
    ]


@pytest.fixture
def path(tmp_path: Path, recordings: list[MountingRecording]) -> Path:
    MountingRecording.write(tmp_path / "mount.jsonl", recordings)
    return tmp_path / "mount.jsonl"


def test_what_is_written_is_read(path: Path, recordings: list[MountingRecording]) -> None:
    read = MountingRecording.read(path)
    assert [(r.part, r.mirrored_pictures) for r in read] == [("carry", 3), ("pivot", 0)]
    for one, other in zip(recordings, read, strict=True):
        pairs = zip((*one.attitudes, *one.poses), (*other.attitudes, *other.poses), strict=True)
        for a, b in pairs:
            for name, value in vars(a).items():
                np.testing.assert_allclose(getattr(b, name), value, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize(
    ("line", "found", "put"),
    [
        (1, '"carry"', '"walk"'),
        (1, '"part"', '"port"'),
        (2, '"gyro_radps"', '"gyro"'),
        (3, "0.02", "NaN"),
        (4, '"rotation_cam_target":[[', '"rotation_cam_target":[[2.5,'),
        (1, '"mirrored_pictures":3', '"mirrored_pictures":1e999'),
        (4, "{", "[" * 99999),
    ],
)
def test_a_wrong_line_is_named(path: Path, line: int, found: str, put: str) -> None:
    lines = path.read_text().splitlines()
    assert found in lines[line - 1]
    lines[line - 1] = lines[line - 1].replace(found, put, 1)
    path.write_text("\n".join(lines))
    with pytest.raises(InvalidValue, match=f"line {line} is not a line of a"):
        MountingRecording.read(path)


def test_what_is_no_file_or_empty_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").write_text("")
    (tmp_path / "flip").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(NotFound, match="does not exist"):
        MountingRecording.read(tmp_path / "none.jsonl")
    for name in (".", "empty", "flip"):
        with pytest.raises(InvalidValue, match=r"cannot be read: (Is a|it is no)|is empty"):
            MountingRecording.read(tmp_path / name)
