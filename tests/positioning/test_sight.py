"""The target as positioning system: what of its sights is sent, and for which moment."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.geometry import Place
from perchctl.positioning import TargetFeed
from perchctl.positioning.sight import (
    GROUND_FRAMES,
    OLDEST_S,
    SETTLED_POSITION_M,
    SETTLED_TILT_RAD,
    body_place,
    target_place,
)
from perchctl.vehicle import ExternalPosition
from perchctl.vision import MarkerPose, VehicleState
from tests.helpers.mission import target_at
from tests.helpers.sights import SETUP, TARGET_ONLY, attitude, seen

TARGET = Place(np.array([0.3, -0.2, 2.0]), 0.4)
FRAME_S, LATE_S = 1.0 / 30.0, 0.08
PERIOD_S = 1.0 / TARGET_ONLY.positioning.rate_hz
within = st.floats(-1.5, 1.5)
angle = st.floats(-math.pi, math.pi)
tilt = st.floats(-0.3, 0.3)


class Sent:
    """A link that takes everything, or nothing."""

    def __init__(self) -> None:
        self.places: list[ExternalPosition] = []
        self.busy = False

    def __call__(self, place: ExternalPosition) -> bool:
        if not self.busy:
            self.places.append(place)
        return not self.busy


def feed(sent: Sent) -> TargetFeed:
    return TargetFeed(sent, TARGET_ONLY, SETUP)


def shown(
    it: TargetFeed, at: VehicleState, now_s: float, believed: VehicleState | None = None,
    now: VehicleState | None = None, pose: MarkerPose | None = None, at_rest: bool = True,
) -> None:  # fmt: skip
    """A picture from `at`, which the vehicle's estimate had at `believed`, and has it at `now`."""
    then = believed or at
    it.add_pose(pose or seen(TARGET, at), then, now or then, now_s, at_rest=at_rest)


def flying(sent: Sent) -> TargetFeed:
    """With the target's place measured from the ground, at the origin."""
    it = feed(sent)
    for i in range(GROUND_FRAMES):
        shown(it, attitude(i * FRAME_S), i * FRAME_S + LATE_S)
    sent.places.clear()
    return it


# --- geometry ----------------------------------------------------------------------------


@given(x=within, y=within, z=within, yaw=angle, roll=tilt, pitch=tilt, seen_yaw=angle)
def test_a_body_is_where_the_target_is_seen_from(
    x: float, y: float, z: float, yaw: float, roll: float, pitch: float, seen_yaw: float
) -> None:
    """Whatever heading the vehicle believes in: that of the target's place counts."""
    true = attitude(1.0, (x, y, z), yaw, roll, pitch)
    pose = seen(TARGET, true)
    place = body_place(pose, attitude(1.0, (9.0, 9.0, 9.0), seen_yaw, roll, pitch), TARGET, SETUP)
    np.testing.assert_allclose(place.position_m, (x, y, z), atol=1e-12)
    assert math.isclose(math.cos(place.yaw_rad - yaw), 1.0, abs_tol=1e-12)
    back = target_place(pose, true, SETUP)
    np.testing.assert_allclose(back.position_m, TARGET.position_m, atol=1e-12)


@given(yaw=angle)
def test_a_touching_gear_is_in_the_targets_centre(yaw: float) -> None:
    it = feed(Sent())
    it.target = TARGET
    place_m = it.contact_position(yaw)
    assert place_m is not None
    np.testing.assert_allclose(seen(TARGET, attitude(0.0, place_m, yaw)).e_m, 0.0, atol=1e-12)


@given(dx=within, dy=within, turned=tilt, yaw=angle)
def test_what_steers_is_the_true_way_whatever_the_estimate_is_beside(
    dx: float, dy: float, turned: float, yaw: float
) -> None:
    """A steady error of the estimate, in place and in heading, moves the goal with it."""
    true = attitude(1.0, (0.1, 0.2, 1.0), yaw)
    believed = attitude(1.0, (0.1 + dx, 0.2 + dy, 1.0), yaw + turned)
    it = feed(Sent())
    it.target, it.off = TARGET, Place(np.array([-dx, -dy, 0.0]), -turned)
    target = it.with_fixed_target(target_at(1.0), believed)
    assert target.world_m is not None
    goal_m = np.asarray(target.world_m) - np.array(believed.position_m)
    np.testing.assert_allclose(goal_m, TARGET.position_m - np.array(true.position_m), atol=1e-9)
    assert target.e_yaw_rad == pytest.approx(seen(TARGET, true).e_yaw_rad, abs=1e-9)


# --- on the ground -----------------------------------------------------------------------


def test_standing_it_is_at_the_origin_until_the_target_has_been_seen_often_enough() -> None:
    sent = Sent()
    it = feed(sent)
    for i in range(GROUND_FRAMES):
        assert it.target is None
        assert it.status(i * FRAME_S).problem
        it.send_origin(i * FRAME_S)
        shown(it, attitude(i * FRAME_S), i * FRAME_S)
    assert {place.position_m for place in sent.places} == {(0.0, 0.0, 0.0)}
    assert it.target is not None
    np.testing.assert_allclose(it.target.position_m, TARGET.position_m, atol=1e-9)
    count = len(sent.places)
    it.send_origin(2.0)
    assert len(sent.places) == count  # from now on the sights tell


def test_a_place_is_measured_at_rest_only_and_by_the_median() -> None:
    it = feed(Sent())
    for i in range(3 * GROUND_FRAMES):
        shown(it, attitude(i * FRAME_S, (0.1 * i, 0.0, 0.0)), i * FRAME_S, at_rest=False)
    assert it.target is None
    for i in range(GROUND_FRAMES):
        at = attitude(10.0 + i * FRAME_S)
        false = Place(TARGET.position_m + 0.5, 1.0)
        shown(it, at, at.t_s, pose=seen(TARGET if i else false, at))
    assert it.target is not None
    np.testing.assert_allclose(it.target.position_m, TARGET.position_m, atol=1e-9)


@given(roll_rad=st.floats(-0.02, 0.02), pitch_rad=st.floats(-0.02, 0.02), drift_m=within)
def test_a_place_is_learned_only_after_the_estimate_has_settled(
    roll_rad: float, pitch_rad: float, drift_m: float
) -> None:
    """The first positions correct an estimate that has drifted: its attitude turns for a while."""
    it = feed(Sent())
    for i in range(6 * GROUND_FRAMES):
        t_s = i * FRAME_S
        true = attitude(t_s)
        wrong = math.exp(-t_s / 0.3)
        believed = replace(
            true,
            roll_rad=true.roll_rad + wrong * roll_rad,
            pitch_rad=true.pitch_rad + wrong * pitch_rad,
            position_m=(wrong * drift_m, 0.0, 0.0),
        )
        shown(it, true, t_s, believed)
    assert it.target is not None
    # what the frames may differ by, seen at the target's distance
    away_m = float(np.linalg.norm(TARGET.position_m))
    most_m = SETTLED_POSITION_M + SETTLED_TILT_RAD * away_m
    assert math.dist(it.target.position_m, TARGET.position_m) < most_m


# --- in the air --------------------------------------------------------------------------


@given(vx=within, vy=within, late_s=st.floats(0.0, OLDEST_S - 0.01))
def test_a_place_is_carried_to_now_by_the_estimates_own_motion(
    vx: float, vy: float, late_s: float
) -> None:
    """The estimate is 5 cm beside the truth, and stays so: its motion is true."""
    sent = Sent()
    it = flying(sent)
    then_s, beside = 5.0, 0.05
    then_m, now_m = (0.1, 0.1, 1.0), (0.1 + vx * late_s, 0.1 + vy * late_s, 1.0)
    shown(
        it, attitude(then_s, then_m), then_s + late_s,
        believed=attitude(then_s, (then_m[0] + beside, *then_m[1:])),
        now=attitude(then_s + late_s, (now_m[0] + beside, *now_m[1:])),
    )  # fmt: skip
    np.testing.assert_allclose(sent.places[-1].position_m, now_m, atol=1e-9)
    assert it.status(then_s + late_s).age_s == pytest.approx(late_s)


@given(off_m=st.floats(0.0, 3.0), silent_s=st.floats(0.05, 3.0))
def test_what_estimate_and_blindness_cannot_explain_is_not_sent(
    off_m: float, silent_s: float
) -> None:
    """A hand's breadth at once, a metre after three seconds; never what is beyond that."""
    sent = Sent()
    it = flying(sent)
    shown(it, attitude(5.0, (0.0, 0.0, 1.0)), 5.05)
    t_s = 5.0 + silent_s
    shown(it, attitude(t_s, (off_m, 0.0, 1.0)), t_s + 0.05, believed=attitude(t_s, (0, 0, 1.0)))
    sure, never = 0.10 + 0.35 * silent_s, 0.12 + 0.36 * silent_s
    if off_m < sure:
        assert len(sent.places) == 2
    elif off_m > never:
        assert len(sent.places) == 1
        assert "from its estimate" in (it.status(t_s + 1.0).problem or "")
        assert it.status(t_s).beside_m == pytest.approx(off_m)


@pytest.mark.parametrize(("late_s", "sigma_m", "words"), [
    (OLDEST_S + 0.01, 0.002, "old"), (0.05, 0.2, "uncertain"), (0.05, math.nan, "uncertain"),
])  # fmt: skip
def test_an_old_vague_or_endless_pose_is_not_sent(
    late_s: float, sigma_m: float, words: str
) -> None:
    sent = Sent()
    it, at = flying(sent), attitude(5.0, (0.0, 0.0, 1.0))
    shown(it, at, 5.0 + late_s, pose=seen(TARGET, at, sigma_m))
    assert not sent.places
    assert words in (it.status(6.0).problem or "")


@pytest.mark.parametrize(("again_s", "busy"), [(5.0, False), (4.9, False), (5.2, True)])
def test_what_is_not_new_or_not_taken_leaves_the_age_growing(again_s: float, busy: bool) -> None:
    """The same exposure, an older one, or a link that is busy."""
    sent = Sent()
    it = flying(sent)
    shown(it, attitude(5.0, (0.0, 0.0, 1.0)), 5.05)
    sent.busy = busy
    shown(it, attitude(again_s, (0.0, 0.0, 1.0)), 5.05 + 6 * PERIOD_S)
    assert len(sent.places) == 1
    assert it.status(5.3).age_s == pytest.approx(0.3)
    assert it.status(5.0 + TARGET_ONLY.positioning.hold_s + 0.1).problem


def test_a_steady_difference_is_learned_and_noise_is_not() -> None:
    """A bias of the estimate is known within seconds; noise of 5 mm moves what steers by less
    than a third of it."""
    it = flying(Sent())
    rng, steered_m = np.random.default_rng(4), []
    for i in range(240):
        t_s = 5.0 + i * FRAME_S
        at = attitude(t_s, (0.0, 0.0, 1.0))
        noisy = attitude(t_s, (0.03 + float(rng.normal(0.0, 0.005)), 0.0, 1.0))
        shown(it, at, t_s + LATE_S, believed=noisy)
        steered_m.append(float(it.off.position_m[0]))
    assert np.mean(steered_m[-90:]) == pytest.approx(-0.03, abs=0.001)
    assert np.std(steered_m[-90:]) < 0.005 / 3
