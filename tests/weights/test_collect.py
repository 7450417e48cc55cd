"""`perchctl fit-weights`: sessions that collect, simulated, asked for, and by motion capture."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from perchctl.calibration import load_calibration
from perchctl.errors import ConnectionFailed, NotFound
from perchctl.positioning import BodyPose, CaptureFrame
from perchctl.profile import PositioningConfig, apply_settings, find_calibration, load_profile
from perchctl.weights import MocapPoses, SimulatedStand
from perchctl.weights.collect import position_fault, read_markers
from perchctl.weights.data import HEADER, read_data
from tests.helpers.weights_data import run


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
    data = read_data(simulated)
    assert np.unique(data.position).tolist() == [1, 2, 3, 4]
    assert len(data) == 48
    for pose in (data.large, data.small):
        assert np.abs((pose - data.actual)[:, :3]).max() < 2e-3
    torn = simulated.with_name("torn.csv")
    torn.write_bytes(whole[: len(whole) - 700])  # within position 4
    done = run("collect", torn, "--truth", "sim", "--frames", 12, "--positions", 4)
    assert done.exit_code == 0, done.output
    assert "removed an incomplete position" in done.stderr
    assert torn.read_bytes() == whole
    torn.write_bytes(b"".join(line for line in whole.splitlines(True) if line[:2] != b"2,"))
    run("collect", torn, "--truth", "sim", "--frames", 12, "--positions", 4)
    assert np.unique(read_data(torn).position).tolist() == [1, 3, 4, 5], "one was taken out"


def test_a_mistyped_folder_is_not_made(tmp_path: Path) -> None:
    done = run("collect", tmp_path / "sesions/session.csv", "--truth", "sim")
    assert done.exit_code == 30
    assert "sesions does not exist; create it, or name another folder" in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_file_that_is_no_session_is_left_alone(tmp_path: Path) -> None:
    other = tmp_path / "other.csv"
    other.write_text("position,t_s\n1,0.1\n", encoding="utf-8")
    done = run("collect", other, "--truth", "sim")
    assert done.exit_code == 30
    assert "nothing was appended" in done.stderr
    assert other.read_text(encoding="utf-8") == "position,t_s\n1,0.1\n"
    other.write_text(f"{HEADER}\nx,0.1\n", encoding="utf-8")
    for path, said in ((other, "position is not a whole number"), (tmp_path, "cannot be read")):
        assert said in run("collect", path, "--truth", "sim").stderr


def test_shaken_and_half_seen_positions_are_refused() -> None:
    profile = load_profile("sim")
    camera = load_calibration(find_calibration(profile.camera.calibration))
    stand = SimulatedStand(profile, camera, 2, 0)
    place = stand.place(1)
    good = list(read_markers(stand.frames(1, place, 6), profile, camera))
    assert position_fault(good) is None
    moved = place.T_world_cam.copy()
    moved[0, 3] += 0.002
    other = type(place)(moved, place.actual)
    late = list(read_markers(stand.frames(1, other, 6), profile, camera))
    assert "not still" in (position_fault([*good, *late]) or "")
    blind = [type(s)(s.t_s, s.large, None, None) for s in good]
    assert "seen together in only 6 of 12" in (position_fault([*good, *blind]) or "")
    assert "only 2 frames" in (position_fault(good[:2]) or "")
    strict = apply_settings(profile, ["pose.max_reprojection_px=1e-6"])
    poseless = list(read_markers(stand.frames(1, place, 3), strict, camera))
    assert "seen together in only 0 of 3" in (position_fault(poseless) or "")


def test_the_dialogue_asks_refuses_and_goes_on(tmp_path: Path) -> None:
    """Pictures of two places; the person mistypes, stops, and goes on."""
    profile = load_profile("sim")
    camera = load_calibration(find_calibration(profile.camera.calibration))
    stand = SimulatedStand(profile, camera, 2, 0)
    pictures, typed = tmp_path / "pictures", []
    pictures.mkdir()
    for position, name in ((1, "a"), (1, "b"), (2, "c")):
        place = stand.place(position)
        x, y, z = place.actual[:3] * 100
        typed.append(f"{x:.2f} {y:.2f} {z:.2f} {math.degrees(place.actual[3]):.1f}")
        for k, frame in enumerate(stand.frames(position, place, 10)):
            cv2.imwrite(str(pictures / f"{name}{k:02d}.png"), frame.image)
    path = tmp_path / "session.csv"
    # No pose; a wrong one; a right one; enough for today.
    answers = ["12 x", "0 0 60 0", "", typed[1], "", "q"]
    words = ("collect", path, "--frames", 10, "--positions", 2, "--source", f"images:{pictures}")
    done = run(*words, stdin="\n".join(answers) + "\n")
    assert done.exit_code == 130, done.output
    assert "is not a pose: enter four numbers" in done.stderr
    assert "but the actual pose is (0.0, 0.0, 60.0) cm" in done.stderr
    assert "stopped with 1 positions" in done.stderr
    assert path.read_text(encoding="utf-8").count("\n") == 11
    for old in pictures.glob("[ab]*"):
        old.unlink()
    done = run(*words, stdin=f"{typed[2]}\n\n")
    assert done.exit_code == 0, done.output
    assert "already contains 1 positions" in done.stderr
    assert np.unique(read_data(path).position).tolist() == [1, 2]


class Recorded:
    """A capture of three bodies with some noise, 100 frames a second of a clock of its own."""

    def __init__(self) -> None:
        self.now_s, self.trouble = 0.0, ""

    def clock(self) -> float:
        return self.now_s

    def wait(self, duration_s: float) -> None:
        self.now_s += duration_s

    def poll(self, now_s: float) -> CaptureFrame | None:
        self.now_s += 0.01
        noise_m = 1e-4 * math.sin(1e4 * self.now_s)
        turned = (math.cos(0.2), 0.0, 0.0, math.sin(0.2))
        bodies = {
            "cf": BodyPose((0.1 + noise_m, 0.2, 1.0), (1.0, 0.0, 0.0, 0.0)),
            "askew": BodyPose((0.1 + noise_m, 0.2, 1.0), turned),
            "target": BodyPose((0.1, 0.25 + noise_m, 1.2), turned),
        }
        return CaptureFrame(self.now_s, bodies)

    def problem(self, now_s: float) -> str | None:
        return self.trouble or None

    def close(self) -> None:
        return None


GEAR = np.array([0.0, 0.0, 0.03])


def truth_of(capture: Recorded, body: str, yaw_deg: float = 0.0) -> MocapPoses:
    config = PositioningConfig(by="mocap", body=body, body_rpy_deg=(0.0, 0.0, yaw_deg))
    return MocapPoses(capture, config, "target", GEAR, capture.clock, capture.wait)


@pytest.mark.parametrize(("body", "yaw_rad"), [("cf", 0.0), ("askew", 0.4)])
def test_motion_capture_gives_the_median_of_the_vehicle_s_axes(body: str, yaw_rad: float) -> None:
    truth = truth_of(Recorded(), body, math.degrees(yaw_rad))
    pose, attitude = truth.actual_pose(lambda question: "")
    assert pose == pytest.approx([0.0, 0.05, 0.17, 0.4], abs=2e-4)
    assert attitude is not None
    assert attitude.yaw_rad == pytest.approx(0.0, abs=1e-6)


def test_a_capture_that_does_not_see_the_body_is_named() -> None:
    with pytest.raises(NotFound, match="both rigid bodies, 'drone' and 'target'"):
        truth_of(Recorded(), "drone").actual_pose(lambda question: "")
    gone = Recorded()
    gone.trouble = "motion capture at vicon:host has ended"
    with pytest.raises(ConnectionFailed, match="has ended"):
        truth_of(gone, "drone").actual_pose(lambda question: "")


def test_motion_capture_is_the_profile_s(tmp_path: Path) -> None:
    done = run("collect", tmp_path / "s.csv", "-p", "sim", "--truth", "mocap")
    assert done.exit_code == 2
    assert "by: mocap" in done.stderr
    assert not list(tmp_path.iterdir())
