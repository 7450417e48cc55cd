"""`perchctl fit-weights`: sessions that collect, simulated, asked for, and by motion capture."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from perchctl.calibration import load_calibration
from perchctl.commands.fit_weights import _open_truth
from perchctl.errors import ConnectionFailed, InvalidValue, NotFound, UsageError
from perchctl.geometry import rot_z
from perchctl.positioning import BodyPose, CaptureFrame, capture
from perchctl.profile import PositioningConfig, find_calibration, load_profile
from perchctl.weights import SessionFile, truth
from perchctl.weights.collect import MarkerReader, fault_of
from perchctl.weights.data import HEADER, NEEDED, read_csv
from tests.helpers.fit_weights import run


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of four simulated positions; the last one was stopped in a line."""
    path = tmp_path_factory.mktemp("sim") / "session.csv"
    pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")
    options = ("collect", path, "--truth", "sim", "--frames", 12, "--positions", 4)
    done = run(*options)
    assert done.exit_code == 0, done.output
    return path


def test_the_simulated_experiment_is_continued_where_it_stopped(simulated: Path) -> None:
    whole = simulated.read_bytes()
    data = read_csv(simulated)
    assert np.unique(data.position).tolist() == [1, 2, 3, 4]
    assert len(data) == 48
    for pose in (data.large, data.small, data.joint):
        assert np.abs((pose - data.actual)[:, :3]).max() < 2e-3
    torn = simulated.with_name("torn.csv")
    torn.write_bytes(whole[: len(whole) - 700])  # within position 4
    done = run("collect", torn, "--truth", "sim", "--frames", 12, "--positions", 4)
    assert done.exit_code == 0, done.output
    assert "an unfinished end was taken off" in done.stderr
    assert torn.read_bytes() == whole


def test_a_file_that_is_no_session_is_left_alone(session: Path) -> None:
    before = session.read_bytes()
    done = run("collect", session, "--truth", "sim")
    assert done.exit_code == 30
    assert "nothing is appended" in done.stderr
    assert session.read_bytes() == before


def test_shaken_and_half_seen_positions_are_refused() -> None:
    from perchctl.weights import SimulatedStand

    profile = load_profile("sim")
    camera = load_calibration(find_calibration(profile.camera.calibration))
    stand = SimulatedStand(profile, camera, 2, 0, 4.0, 1.0)
    place = stand.place(1)
    reader = MarkerReader(profile, camera)
    good = [reader.read(frame) for frame in stand.frames(1, place, 6)]
    assert fault_of(good) is None
    moved = place.T_world_cam.copy()
    moved[0, 3] += 0.002
    other = type(place)(moved, place.actual)
    late = [reader.read(frame) for frame in stand.frames(1, other, 6)]
    assert "shaken" in (fault_of([*good, *late]) or "")
    blind = [type(s)(s.t_s, s.large, None, None, None) for s in good]
    assert "the small marker was found in 6 of 12" in (fault_of([*good, *blind]) or "")
    assert "only 2 frames" in (fault_of(good[:2]) or "")


def test_the_dialogue_asks_refuses_and_goes_on(tmp_path: Path) -> None:
    """Pictures of two places; the person mistypes, doubts, stops, and goes on."""
    from perchctl.weights import SimulatedStand

    profile = load_profile("sim")
    camera = load_calibration(find_calibration(profile.camera.calibration))
    stand = SimulatedStand(profile, camera, 2, 0, 4.0, 1.0)
    pictures, typed = tmp_path / "pictures", []
    pictures.mkdir()
    for position, name in ((1, "a"), (1, "b"), (2, "c")):
        place = stand.place(position)
        x, y, z = place.actual[:3] * 100
        typed.append(f"{x:.2f} {y:.2f} {z:.2f} {math.degrees(place.actual[3]):.1f}")
        for k, frame in enumerate(stand.frames(position, place, 10)):
            cv2.imwrite(str(pictures / f"{name}{k:02d}.png"), frame.image)
    path = tmp_path / "session.csv"
    # No pose; a wrong one, taken back; a right one; enough for today.
    answers = ["12 x", "0 0 60 0", "", "n", typed[1], "", "q"]
    words = ("collect", path, "--frames", 10, "--positions", 2, "--source", f"images:{pictures}")
    done = run(*words, stdin="\n".join(answers) + "\n")
    assert done.exit_code == 130, done.output
    assert "is not a pose: four numbers are needed" in done.stderr
    assert "does not fit what the camera sees" in done.stderr
    assert "stopped with 1 positions" in done.stderr
    assert len(read_csv(path)) == 10
    for old in pictures.glob("[ab]*"):
        old.unlink()
    done = run(*words, stdin=f"{typed[2]}\n\n")
    assert done.exit_code == 0, done.output
    assert "holds 1 positions already" in done.stderr
    assert np.unique(read_csv(path).position).tolist() == [1, 2]


def test_the_estimate_s_truth_is_learned_by_touching() -> None:
    gear = np.array([0.0, 0.0, 0.03])
    target = np.array([0.4, -0.3, 2.0])
    poses = [((*(target - gear),), 0.5), ((0.35, -0.25, 1.8), 0.7)]
    asked: list[str] = []

    def telemetry() -> list[SimpleNamespace]:
        position, yaw = poses[min(len(asked) // 2, 1)]
        return [SimpleNamespace(position_m=position, roll_rad=0.0, pitch_rad=0.0, yaw_rad=yaw)] * 9

    source = truth.EstimateTruth(telemetry, None, gear, wait=lambda s: None)  # type: ignore[arg-type]

    def ask(question: str) -> str:
        asked.append(question)
        return ""

    found = source.actual(ask)
    expected = rot_z(-0.7) @ (target - [0.35, -0.25, 1.8]) - gear
    assert found.pose[:3] == pytest.approx(expected)
    assert found.pose[3] == pytest.approx(-0.2)
    assert truth.moved(found, source.actual(ask)) is None


class Recorded:
    """A capture of three bodies with some noise, 100 frames a second of a clock of its own."""

    def __init__(self, noise_m: float = 1e-4) -> None:
        self.now_s, self.noise_m, self.trouble = 0.0, noise_m, ""

    def clock(self) -> float:
        return self.now_s

    def wait(self, duration_s: float) -> None:
        self.now_s += duration_s

    def frames(self) -> list[CaptureFrame]:
        self.now_s += 0.01
        noise_m = self.noise_m * math.sin(1e4 * self.now_s)
        turned = (math.cos(0.2), 0.0, 0.0, math.sin(0.2))
        bodies = {
            "cf": BodyPose((0.1 + noise_m, 0.2, 1.0), (1.0, 0.0, 0.0, 0.0)),
            "askew": BodyPose((0.1 + noise_m, 0.2, 1.0), turned),
            "target": BodyPose((0.1, 0.25 + noise_m, 1.2), turned),
        }
        return [CaptureFrame(self.now_s, bodies)]

    def problem(self, now_s: float) -> str | None:
        return self.trouble or None

    def close(self) -> None:
        return None


def test_motion_capture_gives_the_median_or_names_the_bodies() -> None:
    gear = np.array([0.0, 0.0, 0.03])

    def truth_of(
        capture: Recorded, body: str, mounted: PositioningConfig | None = None
    ) -> truth.MocapTruth:
        return truth.MocapTruth(
            capture, "vicon:host", body, "target", gear, mounted, capture.clock, capture.wait
        )

    found = truth_of(Recorded(), "cf").actual(lambda question: "")
    assert found.pose == pytest.approx([0.0, 0.05, 0.17, 0.4], abs=2e-4)
    mounted = PositioningConfig(by="mocap", body_rpy_deg=(0.0, 0.0, math.degrees(0.4)))
    found = truth_of(Recorded(), "askew", mounted).actual(lambda question: "")
    assert found.pose == pytest.approx([0.0, 0.05, 0.17, 0.4], abs=2e-4)
    with pytest.raises(NotFound, match="rigid body 'drone'; it sees askew, cf, target"):
        truth_of(Recorded(), "drone").actual(lambda question: "")
    with pytest.raises(NotFound, match="'cf' frozen"):
        truth_of(Recorded(noise_m=0.0), "cf").actual(lambda question: "")
    gone = Recorded()
    gone.trouble = "motion capture at vicon:host has ended"
    with pytest.raises(ConnectionFailed, match="has ended"):
        truth_of(gone, "drone").actual(lambda question: "")


def test_motion_capture_is_asked_for_with_its_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    profile = load_profile("sim")
    for mocap in (None, "vicon", "vicon: "):
        with pytest.raises(UsageError, match="--mocap TYPE:HOST"):
            _open_truth("mocap", profile, mocap=mocap)
    monkeypatch.setattr(capture, "find_spec", lambda name: object())
    with pytest.raises(InvalidValue, match="'nokov' is unknown; allowed are vicon, optitrack"):
        _open_truth("mocap", profile, mocap="nokov:h")
    monkeypatch.setattr(capture, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match="needs the library motioncapture"):
        _open_truth("mocap", profile, mocap="vicon:h")


OWN = PositioningConfig(by="mocap", system="qualisys", host="lab:22223", body="cf2")


@pytest.mark.parametrize(
    ("options", "positioning", "expected"),
    [
        ({}, OWN, ("qualisys:lab:22223", "cf2")),
        ({"mocap": "vicon:h"}, OWN, ("vicon:h", "cf2")),
        ({"bodies": "cf7,board"}, OWN, ("qualisys:lab:22223", "cf7")),
        ({"mocap": "vicon:h"}, PositioningConfig(), ("vicon:h", "cf")),
    ],
)
def test_motion_capture_is_the_profile_s_where_no_option_names_it(
    options: dict[str, str],
    positioning: PositioningConfig,
    expected: tuple[str, str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[tuple[str, str]] = []

    def opened(system: str, body: str) -> Recorded:
        asked.append((system, body))
        return Recorded()

    monkeypatch.setattr("perchctl.commands.fit_weights.open_named", opened)
    profile = load_profile("sim").model_copy(update={"positioning": positioning})
    _open_truth("mocap", profile, **options)
    assert asked == [expected]


def test_a_session_of_another_header_and_the_shipped_header_agree(tmp_path: Path) -> None:
    file = SessionFile(tmp_path / "new.csv", 10)
    assert file.path.read_text() == HEADER + "\n"
    assert HEADER.startswith(",".join(NEEDED))
    assert file.next_position == 1


def test_the_readers_of_nothing_are_told(tmp_path: Path) -> None:
    done = run()
    assert done.exit_code == 2
    assert "fit-weights collect" in done.stderr
    assert run(tmp_path / "none.csv").exit_code == 20
    assert run("x.csv", "--method", "magic").exit_code == 30
