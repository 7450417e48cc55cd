"""A locked target does not jump: what contradicts it is no measurement, and for how long."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.geometry import make_T, rot_z, rotation_from_rpy, wrap_rad
from perchctl.profile import KalmanConfig, MergeConfig
from perchctl.vision import (
    MarkerPose,
    Pipeline,
    PipelineOutput,
    PipelineState,
    TargetEstimate,
    VehicleState,
    estimate,
)
from perchctl.vision.filter import X_STATE_INDEX, TrackMeasurement, make_filter_setup
from perchctl.vision.pipeline import step_from_detections
from perchctl.vision.tracks import (
    MIN_FRAMES_TO_ESTABLISH_TARGET_LOCK,
    MIN_RIVAL_ALONE_TIME_TO_LOCK_WITHOUT_ATTITUDE_S,
    MIN_TARGET_UNSEEN_TIME_TO_LOCK_RIVAL_S,
    UNSEEN_TARGET_LOCK_TIMEOUT_S,
    FramePose,
    _is_pose_clearly_consistent,
    judge_pose,
)
from perchctl.vision.types import Detections, MarkerFilterState, RivalTargetState, TargetLockState
from tests.helpers.seen import seen_from

Build = Callable[..., Pipeline]
HZ = 30.0
TARGET_M = np.array([0.1, -0.05, 2.0])
RANGE_M = 0.6
LOCKED = 8


@dataclass(eq=False)
class Watch:
    """A camera that sways under the target, and what its pipeline makes of what it is shown."""

    setup: Pipeline
    in_world: bool
    k: int = 0
    jumped_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the estimate
    state: PipelineState = field(default_factory=PipelineState)
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(3))
    attitude: VehicleState | None = None  # at the last frame

    def show(self, frames: int, **what: object) -> list[PipelineOutput]:
        """So many frames of the target, `away_m` from its place and otherwise as
        `seen_from` has it; of nothing, if `markers` is empty."""
        away_m = np.array(what.pop("away_m", (0.0, 0.0, 0.0)))
        outputs = []
        for _ in range(frames):
            t = self.k / HZ
            x, y, z = TARGET_M + np.array([0.03 * np.sin(2 * t), 0.02 * np.cos(3 * t), -RANGE_M])
            yaw = 0.2 * np.sin(t)
            T = make_T(rotation_from_rpy(0.02 * np.sin(2 * t), 0.0, yaw), (x, y, z))
            seen: Detections = seen_from(T, TARGET_M + away_m, t, self.rng, **what)
            self.attitude = None
            if self.in_world:
                jx, jy, jz = self.jumped_m
                here = (x + jx, y + jy, z + jz)
                self.attitude = VehicleState(t, 0.02 * np.sin(2 * t), 0.0, yaw, here)
            self.state, output = step_from_detections(self.state, seen, self.attitude, self.setup)
            outputs.append(output)
            self.k += 1
        return outputs

    def estimate(self) -> TargetEstimate:
        """The target a moment after the last frame."""
        assert self.attitude is not None
        found = estimate(self.state, self.attitude.t_s + 0.01, self.attitude, self.setup)
        assert found is not None
        return found


@pytest.fixture(params=["track", "fly"])
def watch(build: Build, request: pytest.FixtureRequest) -> Watch:
    return Watch(build(), in_world=request.param == "fly")


def covers(target: TargetEstimate, pose: MarkerPose) -> bool:
    """Whether the target's spread reaches to another place: all but noise within its sigma."""
    off_m = np.abs(pose.e_m - target.e_m)
    off_rad = abs(wrap_rad(pose.e_yaw_rad - target.e_yaw_rad))
    return bool((off_m < 1.2 * target.sigma_m + 0.01).all()) and (
        off_rad < 1.2 * target.sigma_yaw_rad + 0.02
    )


def measured(outputs: list[PipelineOutput]) -> list[bool]:
    return [
        output.target is not None and output.target.is_measured_in_newest_frame
        for output in outputs
    ]


HALF = {"scale": 0.5}
DECOYS = {
    "half the size": HALF,
    "half the size, aside": {"scale": 0.5, "away_m": (0.1, 0.05, 0.0)},
    "lone small, four times too large": {"markers": ("small",), "scale": 4.0},
    "lone large, half the size": {"markers": ("large",), "scale": 0.5},
    "lone large, aside": {"markers": ("large",), "away_m": (-0.24, 0.0, 0.0)},
    "a second one, aside": {"away_m": (0.24, 0.0, 0.0)},
    "turned": {"heading_rad": 1.0},
}


SHOWN = ("half the size, aside", "lone large, aside", "turned")
"""One of each kind; the others with the long tests."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.long] * (name not in SHOWN)) for name in DECOYS]
)
def test_what_contradicts_the_lock_is_not_measured(watch: Watch, name: str) -> None:
    """A camera alone takes both markers for the target's after a while: it may have jumped."""
    assert all(measured(watch.show(LOCKED)))
    decoy = DECOYS[name]
    lasts = watch.in_world or "markers" in decoy
    outputs = watch.show(
        72 if lasts else int(MIN_RIVAL_ALONE_TIME_TO_LOCK_WITHOUT_ATTITUDE_S * HZ), **decoy
    )
    assert all(output.poses for output in outputs)  # it was seen
    assert not any(measured(outputs))
    assert all(o.target_lock_message.startswith("not the tracked target: ") for o in outputs)
    told = [o.target for o in outputs if o.target is not None]
    assert len(told) == watch.setup.kalman.n_max
    assert all(abs(t.e_m[2] - RANGE_M) < 0.03 for t in told)
    for output in outputs:
        seen = min(output.poses.values(), key=lambda pose: float(pose.sigma_m @ pose.sigma_m))
        assert output.target is None or covers(output.target, seen)
    (back,) = watch.show(1)
    assert measured([back]) == [True]
    assert back.target_lock_message == ""


@settings(max_examples=80)
@given(
    off_m=st.tuples(*[st.floats(-0.2, 0.2)] * 3),
    off_rad=st.floats(-0.6, 0.6),
    sigma_m=st.floats(1e-4, 0.1),
    range_m=st.floats(0.05, 2.0),
)
def test_what_is_clearly_the_targets_is_so_by_every_spread(
    off_m: tuple[float, float, float], off_rad: float, sigma_m: float, range_m: float
) -> None:
    """By way of all spreads, as beside a rival, too."""
    track = MarkerFilterState(t_s=0.0, x=np.zeros(8), P=np.eye(8) * sigma_m**2)
    pose = MarkerPose(
        "joint", 0.03, np.zeros(3), np.array([0.0, 0.0, range_m]), np.zeros(3), 0.0, np.ones(3),
        1.0, 0.0,
    )  # fmt: skip
    z = np.array([off_rad, *off_m])
    sight = FramePose(
        0.03, pose, TrackMeasurement(z, np.eye(4) * sigma_m**2, np.eye(4) * 0.01), True, True
    )
    constants = make_filter_setup(KalmanConfig(), is_world_frame=True)
    rival = RivalTargetState(replace(track, x=np.full(8, 5.0)), True, 0.0, 1, 1, False, "")
    lock = TargetLockState(
        track=track,
        last_pose=pose,
        is_in_world_frame=True,
        accepted_frame_count=9,
        has_shown_both_markers=True,
    )
    if _is_pose_clearly_consistent(track, sight, constants):
        assert judge_pose(lock, rival, sight, constants).is_accepted


@pytest.mark.parametrize(("x_m", "in_world"), [(-0.02, False), (-0.45, False), (-0.02, True)])
def test_a_pose_that_fits_the_track_before_the_last_one_is_the_targets(
    x_m: float, in_world: bool
) -> None:
    """If the last pose has led the track 1 m away. In flight no single pose does."""
    before = MarkerFilterState(t_s=-0.1, x=np.zeros(8), P=np.eye(8) * 1e-4)
    track = MarkerFilterState(t_s=0.0, x=np.eye(8)[X_STATE_INDEX], P=np.eye(8) * 1e-4)
    pose = MarkerPose(
        "joint", 0.1, np.zeros(3), np.array([0.0, 0.0, 1.0]), np.zeros(3), 0.0, np.ones(3), 1.0, 0.0
    )
    measured = TrackMeasurement(np.array([0.0, x_m, 0.0, 0.0]), np.eye(4) * 1e-4)
    sight = FramePose(0.1, pose, measured, in_world, True)
    lock = TargetLockState(track, replace(pose, e_m=np.full(3, 5.0)), in_world, 9, True, before)
    verdict = judge_pose(lock, None, sight, make_filter_setup(KalmanConfig(), in_world))
    assert verdict.is_accepted is (x_m == -0.02 and not in_world)
    assert verdict.keeps_lock_at_restart is verdict.is_accepted
    again = TargetLockState(
        track, lock.last_pose, in_world, 9, True
    )  # as long as nothing is known of before
    assert not judge_pose(
        again, None, sight, make_filter_setup(KalmanConfig(), in_world)
    ).is_accepted


def test_without_the_gate_all_of_them_steer(build: Build) -> None:
    watch = Watch(build(kalman=KalmanConfig(gate=False)), in_world=True)
    watch.show(LOCKED)
    assert all(measured(watch.show(5, **HALF)))


def test_a_target_that_moved_is_taken_up_anew_after_a_while(watch: Watch) -> None:
    watch.show(LOCKED)
    while_s = (
        MIN_TARGET_UNSEEN_TIME_TO_LOCK_RIVAL_S
        if watch.in_world
        else MIN_RIVAL_ALONE_TIME_TO_LOCK_WITHOUT_ATTITUDE_S
    )
    outputs = watch.show(int(1.2 * while_s * HZ) + 2, away_m=(0.3, 0.0, 0.0))
    first = measured(outputs).index(True)
    assert while_s * HZ - 1 <= first <= while_s * HZ + 2
    assert all(measured(outputs[first:]))
    assert outputs[first].target_lock_message.startswith("target reacquired 0.3")
    target = outputs[first].target
    assert np.linalg.norm(target.e_m[:2]) > 0.2


def test_a_flickering_stranger_is_still_the_same_one(watch: Watch) -> None:
    """Unseen for a few frames, it is not taken for the target because that got vague."""
    watch.show(LOCKED)
    for _ in range(8 if watch.in_world else 1):  # not for so long that it is believed
        assert not any(measured(watch.show(5, away_m=(0.24, 0.0, 0.0))))
        watch.show(5, markers=())


def test_a_second_target_seen_beside_the_first_takes_no_camera_alone_soon(build: Build) -> None:
    """What was seen before the target was lost did not come from where the target was."""
    watch = Watch(build(), in_world=False)
    watch.show(LOCKED)
    for _ in range(3):
        assert not any(measured(watch.show(2, away_m=(0.3, 0.0, 0.0))))
        assert all(measured(watch.show(2)))
    outputs = watch.show(
        int(1.2 * MIN_TARGET_UNSEEN_TIME_TO_LOCK_RIVAL_S * HZ), away_m=(0.3, 0.0, 0.0)
    )
    assert measured(outputs).index(True) >= MIN_TARGET_UNSEEN_TIME_TO_LOCK_RIVAL_S * HZ - 2


def test_no_jump_locks_the_pipeline_out_for_ever(watch: Watch) -> None:
    watch.show(LOCKED)
    assert not any(measured(watch.show(int((UNSEEN_TARGET_LOCK_TIMEOUT_S - 0.1) * HZ), **HALF)))
    assert any(measured(watch.show(int(0.5 * HZ), **HALF)))


def test_what_contradicts_the_lock_widens_the_target_between_frames_too(build: Build) -> None:
    watch = Watch(build(), in_world=True)
    watch.show(LOCKED)
    (output,) = watch.show(1, away_m=(0.24, 0.0, 0.0), heading_rad=1.0)
    assert covers(watch.estimate(), output.poses["joint"])
    watch.show(1)
    assert watch.estimate().sigma_m.max() < 0.01


@pytest.mark.parametrize(("in_world", "unseen_s"), [(False, 1.2), (True, 4.0)])
def test_what_was_unseen_for_long_is_where_it_was_in_flight_but_not_in_a_hand(
    build: Build, in_world: bool, unseen_s: float
) -> None:
    watch = Watch(build(), in_world=in_world)
    watch.show(LOCKED)
    watch.show(int(unseen_s * HZ), markers=())
    assert any(measured(watch.show(10, **HALF))) is not in_world
    assert not in_world or all(measured(watch.show(3)))


SMALL_JUMPS_M = [(0.0, 0.0, 0.08), (0.12, 0.0, 0.0)]
LARGE_JUMPS_M = [(0.5, 0.0, 0.0), (0.0, 0.0, 0.4), (0.1, -1.0, 0.0)]


@pytest.mark.parametrize(
    ("jump_m", "missed"), [*product(SMALL_JUMPS_M, [0, 1, 2, 4, 8]), *product(LARGE_JUMPS_M, [0])]
)
def test_an_estimate_that_jumps_while_frames_are_missed_loses_no_target(
    build: Build, jump_m: tuple[float, float, float], missed: int
) -> None:
    watch = Watch(build(), in_world=True)
    watch.show(LOCKED)
    watch.show(missed, markers=())
    watch.jumped_m = jump_m
    outputs = watch.show(10)
    assert all(measured(outputs))
    if jump_m in LARGE_JUMPS_M:
        assert outputs[0].target_lock_message == "the state estimate jumped, but the target did not"
        for output in outputs:
            assert np.abs(output.target.world_m - TARGET_M - jump_m).max() < 0.015


def test_what_is_off_in_the_picture_too_is_no_jump_of_the_estimate(build: Build) -> None:
    """One pose that is 10 cm off does not move the tracks, and the next are taken as ever."""
    watch = Watch(build(), in_world=True)
    watch.show(LOCKED)
    assert measured(watch.show(1, away_m=(0.15, 0.0, 0.0))) == [False]
    assert all(measured(watch.show(5)))


def test_a_lock_keeps_its_standing_when_the_estimate_jumps(build: Build) -> None:
    watch = Watch(build(), in_world=True)
    watch.show(60)
    watch.jumped_m = (0.0, 0.0, 0.4)
    assert all(measured(watch.show(3)))
    assert not any(measured(watch.show(12, markers=("large",), scale=0.5)))
    assert not any(measured(watch.show(12, away_m=(0.24, 0.0, 0.0))))


def test_a_frame_out_of_order_captures_no_lock(watch: Watch) -> None:
    """Two frames of a burst whose fields overlap: the later one's are judged, the other's are
    not measured."""
    watch.show(LOCKED)
    watch.k -= 2
    assert not any(measured(watch.show(1, **HALF)))
    watch.k += 1
    assert not any(measured(watch.show(12, **HALF)))
    assert measured(watch.show(1)) == [True]


def test_a_clock_that_was_set_back_begins_anew(watch: Watch) -> None:
    watch.show(LOCKED)
    watch.k -= int(5.0 * HZ)
    assert any(measured(watch.show(3)))


def test_both_markers_overrule_a_lock_on_one(watch: Watch) -> None:
    """What was locked on was perhaps never the target."""
    watch.show(20, markers=("large",), scale=0.5)
    outputs = watch.show(MIN_FRAMES_TO_ESTABLISH_TARGET_LOCK + 1)
    assert measured(outputs) == [False] * (MIN_FRAMES_TO_ESTABLISH_TARGET_LOCK - 1) + [True] * 2


def test_a_lock_of_a_moment_gives_way_to_what_lasts(watch: Watch) -> None:
    watch.show(2, **HALF)
    outputs = watch.show(6)
    assert measured(outputs) == [False] * 2 + [True] * 4


def test_a_lone_marker_never_moves_an_established_lock(watch: Watch) -> None:
    watch.show(LOCKED)
    outputs = watch.show(
        int(2.0 * MIN_TARGET_UNSEEN_TIME_TO_LOCK_RIVAL_S * HZ),
        markers=("large",),
        away_m=(0.3, 0.0, 0.0),
    )
    assert not any(measured(outputs))


@pytest.mark.parametrize("method", ["joint", "weights"])
def test_the_target_goes_on_when_the_attitude_comes_and_goes(build: Build, method: str) -> None:
    merge = MergeConfig(method=method)
    watch = Watch(build(merge=merge), in_world=True)
    watch.show(LOCKED)
    watch.in_world = False
    assert all(measured(watch.show(3)))
    watch.in_world = True
    assert all(measured(watch.show(3)))


def test_of_two_targets_in_view_one_is_told(build: Build) -> None:
    watch = Watch(build(), in_world=True)
    watch.show(LOCKED)
    T = make_T(rot_z(0.0), TARGET_M - [0.0, 0.0, RANGE_M])
    seen = seen_from(T, TARGET_M, watch.k / HZ, watch.rng)
    _, output = step_from_detections(watch.state, replace(seen, target_count=2), None, watch.setup)
    assert "more than one target in view" in output.target_lock_message
