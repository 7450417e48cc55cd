"""A hand finds what a vehicle at rest cannot tell of its motion capture, and says which."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from perchctl.check import Verdict, capture, vehicle
from perchctl.check.row import Finding
from perchctl.geometry import (
    Array,
    quaternion_from_rotation,
    rot_z,
    rotation_from_rpy,
    rpy_from_rotation,
)
from perchctl.positioning import BodyPose, VehiclePose
from perchctl.profile import PositioningConfig
from perchctl.vehicle import Telemetry
from tests.helpers.capture import TURNS, UPRIGHT, named_up
from tests.helpers.carried import Stop, Stops, lifted_and_turned
from tests.helpers.checks import said
from tests.helpers.mission import telemetry

CONFIG = PositioningConfig(by="mocap", host="lab", body="cf2")
LASTS_S, DELAY_S = 8.0, 0.015
I3 = np.eye(3)
HOME = (0.0, 0.0, 0.012)


def bump(t_s: float, from_s: float, to_s: float) -> float:
    """0 outside, 1 in the middle, smooth."""
    if not from_s < t_s < to_s:
        return 0.0
    return math.sin(math.pi * (t_s - from_s) / (to_s - from_s)) ** 2


STRAIGHT_UP_M = (0.02, 0.01, 0.3)


def motion(
    t_s: float,
    lift: float = 1.0,
    turn: float = 1.0,
    tilt: float = 1.0,
    way_m: tuple[float, float, float] = STRAIGHT_UP_M,
) -> tuple[Array, Array]:
    """Lifted by 30 cm, turned by 80 deg, tilted forward and aside by 30 deg, put back."""
    place = np.array(way_m) * lift * bump(t_s, 1.0, 7.0)
    yaw = math.radians(80.0) * turn * bump(t_s, 1.5, 4.0)
    pitch = math.radians(30.0) * tilt * bump(t_s, 4.0, 5.5)
    roll = math.radians(30.0) * tilt * bump(t_s, 5.0, 6.5)
    return place, rotation_from_rpy(roll, pitch, yaw)


def recorded(
    seed: int = 0,
    world: Array = I3,
    body: Array = I3,
    scale: float = 1.0,
    own: tuple[float, float, float] = (1.0, 1.0, 1.0),
    seen: tuple[float, float, float] | None = None,
    mirror: Array = I3,
    config: PositioningConfig = CONFIG,
    way_m: tuple[float, float, float] = STRAIGHT_UP_M,
) -> Finding:
    """The finding on what a capture says that has the vehicle as ``world R body``, and of what the
    vehicle says itself, from a heading of its own: both with noise, the capture late."""
    rng = np.random.default_rng(seed)
    heading = rng.uniform(-math.pi, math.pi)
    origin = np.array([0.4, -0.2, 0.01])
    samples: list[Telemetry] = []
    places: list[VehiclePose] = []
    for t_s in np.arange(0.0, LASTS_S, 0.025):
        _, R = motion(t_s, *own)
        roll, pitch, yaw = (float(a) for a in rpy_from_rotation(rot_z(heading) @ R))
        noise = rng.normal(0.0, 0.004, 4)
        shake = 0.1 * (own[0] > 0) * bump(t_s, 1.0, 2.0)
        samples.append(telemetry(
            float(t_s), 0.0, roll_rad=roll + noise[0], pitch_rad=pitch + noise[1],
            yaw_rad=yaw + noise[2], acc_z_g=1.0 + shake + 0.5 * noise[3],
        ))  # fmt: skip
        place, R = motion(t_s - DELAY_S, *(own if seen is None else seen), way_m)
        R = mirror @ R @ mirror.T if np.linalg.det(mirror) < 0 else R
        R_seen = world @ R @ body @ rotation_from_rpy(*rng.normal(0.0, 0.005, 3))
        place = scale * (mirror @ world @ (origin + place + rng.normal(0.0, 0.001, 3)))
        pose = BodyPose(tuple(place), quaternion_from_rotation(R_seen))
        places.append(VehiclePose.of(pose, config, float(t_s)))
    return capture.comparison_finding(capture.pair_motion(samples, places), config)


def test_a_true_capture_passes() -> None:
    row = recorded()
    assert row.verdict is Verdict.PASS, row
    assert "rose by 0.30 m" in row.found


@pytest.mark.parametrize(
    "number",
    [pytest.param(n, marks=[pytest.mark.long] * (n % 3 > 0)) for n in range(len(TURNS))],
)
def test_each_of_the_axes_is_found_and_named(number: int) -> None:
    """A world in other axes, in whatever heading, its body defined along them."""
    turn, yaw = TURNS[number], 0.7 * number
    row = recorded(number, turn @ rot_z(yaw), rot_z(-yaw) @ turn.T)
    if named_up(turn) != "z":
        assert row.verdict is Verdict.FAIL
        assert f"swapped axes: up is {named_up(turn)} in" in row.found
    elif number:  # the first names them as they are
        assert "the rigid body's axes are rotated by" in row.found


@pytest.mark.parametrize("turn", UPRIGHT)
def test_a_body_turned_about_the_vertical_is_told_by_how_much(turn: Array) -> None:
    row = recorded(1, turn, turn.T)
    if np.allclose(turn, I3):
        assert row.verdict is Verdict.PASS
        return
    off_deg = round(math.degrees(math.acos((np.trace(turn) - 1.0) / 2.0)))
    assert row.verdict is Verdict.FAIL
    told = re.search(r"rotated by (\d+) deg", row.found)
    assert told is not None
    assert abs(int(told[1]) - off_deg) <= 3
    assert "set positioning.body_rpy_deg: [" in row.advice


@pytest.mark.parametrize("rpy_deg", [(0.0, 0.0, 90.0), (0.0, 0.0, -40.0), (90.0, 0.0, 20.0)])
def test_what_it_advises_mends_it(rpy_deg: tuple[float, float, float]) -> None:
    body = rotation_from_rpy(*(math.radians(a) for a in rpy_deg))
    row = recorded(2, body=body)
    assert row.verdict is Verdict.FAIL
    numbers = re.search(r"body_rpy_deg: \[([^\]]*)\]", row.advice)
    assert numbers is not None
    mended = CONFIG.model_copy(
        update={"body_rpy_deg": tuple(float(v) for v in numbers[1].split(","))}
    )
    assert recorded(3, body=body, config=mended).verdict is Verdict.PASS


@pytest.mark.parametrize("turn", UPRIGHT)
def test_the_heading_of_the_capture_is_its_own_affair(turn: Array) -> None:
    """The vehicle's is set by it."""
    assert recorded(4, turn).verdict is Verdict.PASS


@pytest.mark.parametrize(("own", "seen", "scale", "words"), [
    ((1.0, 1.0, 1.0), (0.0, 0.0, 0.0), 1.0, "vehicle moves while the rigid body 'cf2' does not"),
    ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 1.0, "rigid body 'cf2' moves while the vehicle does not"),
    ((1.0, 1.0, 1.0), (1.0, -1.0, 0.6), 1.0, "does not match the vehicle's"),
    ((1.0, 1.0, 1.0), (1.0, 0.0, 0.0), 1.0, "does not match the vehicle's"),
    ((1.0, 1.0, 1.0), None, 1000.0, "millimetres"),
    ((1.7, 1.0, 1.0), None, 1000.0, "millimetres"),
])  # fmt: skip
def test_another_body_or_unit_is_named(
    own: tuple[float, float, float], seen: tuple[float, float, float] | None, scale: float,
    words: str,
) -> None:  # fmt: skip
    row = recorded(5, own=own, seen=seen, scale=scale)
    assert row.verdict is Verdict.FAIL
    assert words in row.found


@pytest.mark.parametrize("axis", range(3))
def test_a_mirrored_world_is_named(axis: int) -> None:
    mirror = np.eye(3)
    mirror[axis, axis] = -1.0
    row = recorded(6, mirror=mirror)
    assert row.verdict is Verdict.FAIL
    assert re.search("mirrored|swapped axes", row.found)


Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@pytest.mark.parametrize("world", [I3, Y_UP], ids=["as it is", "y up"])
@pytest.mark.parametrize(("own", "verdict", "words"), [
    ((0.0, 0.0, 0.0), "skipped", "not moved"),
    ((1.0, 0.0, 0.0), "warn", "too few axes"),
    ((1.0, 1.0, 0.0), "warn", "too few axes"),
])  # fmt: skip
def test_what_too_small_a_motion_cannot_tell_is_no_pass(
    own: tuple[float, float, float], verdict: str, words: str, world: Array
) -> None:
    row = recorded(7, world, world.T, own=own)
    assert row.verdict == verdict, row
    assert words in row.found
    assert row.advice == capture.HOW_TO_TURN


def test_a_turn_without_a_lift_is_no_pass() -> None:
    row = recorded(7, own=(0.0, 1.0, 1.0))
    assert (row.verdict, "not lifted" in row.found) == (Verdict.WARN, True), row


@pytest.mark.parametrize(("places", "way_m"), [
    (Y_UP, STRAIGHT_UP_M), (Y_UP, (0.02, -0.2, 0.4)), (Y_UP, (0.02, -0.3, 0.4)),
    (I3, (0.02, 0.3, 0.3)), (I3, (0.02, 0.3, 0.03)),
])  # fmt: skip
def test_places_in_other_axes_fail_though_the_turns_are_right(
    places: Array, way_m: tuple[float, float, float]
) -> None:
    """However far the hand drifts aside, which may rise along the capture's z."""
    row = recorded(7, mirror=places, way_m=way_m)
    assert row.verdict is Verdict.FAIL, row
    assert "lifted, the body moves by x" in row.found
    assert "straight up" in row.advice


def test_a_hand_may_drift_aside() -> None:
    assert recorded(7, way_m=(0.05, -0.12, 0.3)).verdict is Verdict.PASS


def truly_moved(way: Stops, from_s: float, to_s: float) -> capture.PairedMotion:
    """Vehicle and capture agree on that way."""
    times_s = np.arange(from_s, to_s, capture.POSE_PAIR_PERIOD_S)
    places, turns = zip(*(way(HOME, I3, float(t_s)) for t_s in times_s), strict=True)
    R = Rotation.from_matrix(turns)
    return capture.PairedMotion(R, R, np.array(places), 0.2)


@given(tilt_deg=st.floats(20.0, 40.0), before_s=st.floats(0.2, 5.0), after_s=st.floats(0.2, 20.0))
@settings(max_examples=8, deadline=None)
def test_what_is_asked_for_is_enough_however_long_it_stands(
    tilt_deg: float, before_s: float, after_s: float
) -> None:
    """The very motion, as the simulated hand makes it, tilted more or less."""
    share = math.radians(tilt_deg) / math.radians(30.0)
    way = Stops(tuple(
        Stop(after_s, place_m, (share * roll, share * pitch, yaw))
        for after_s, place_m, (roll, pitch, yaw) in lifted_and_turned(HOME).stops
    ))  # fmt: skip
    moved = truly_moved(way, -before_s, 7.5 + after_s)
    assert capture.comparison_finding(moved, CONFIG).verdict is Verdict.PASS


@given(wobble_deg=st.floats(0.0, 5.0), stands_s=st.floats(0.2, 20.0))
@settings(max_examples=8, deadline=None)
def test_a_hand_that_wobbles_has_tilted_nothing(wobble_deg: float, stands_s: float) -> None:
    up, wobble, turn = (0.0, 0.0, 0.3), math.radians(wobble_deg), math.radians(90.0)
    way = Stops((
        Stop(1.0, up), Stop(0.8, up, (wobble, -wobble, turn / 2.0)),
        Stop(0.8, up, (-wobble, wobble, turn)), Stop(1.5, up), Stop(1.0, HOME),
    ))  # fmt: skip
    moved = truly_moved(way, -0.5, 5.1 + stands_s)
    assert "too few axes" in capture.comparison_finding(moved, CONFIG).found


def test_without_moments_of_both_nothing_is_said() -> None:
    assert capture.comparison_finding(None, CONFIG).verdict is Verdict.SKIPPED
    sample = telemetry(0.0)
    assert capture.pair_motion([sample, replace(sample, t_s=1.0)], []) is None
    assert capture.pair_motion([], []) is None


# --- Without a motion capture: the position that the vehicle reports --------------------------


class Scripted:
    """A link whose vehicle reports one height after another, and moves by so much."""

    def __init__(self, heights_m: Sequence[float], moves_g: float) -> None:
        self.heights_m, self.moves_g = list(heights_m), moves_g

    def telemetry(self) -> list[Telemetry]:
        if not self.heights_m:
            return []
        place_m = (0.0, 0.0, self.heights_m.pop(0))
        return [said(position_m=place_m, acc_z_g=1.0 + self.moves_g)]


@pytest.mark.parametrize(("heights_m", "moves_g", "verdict", "words"), [
    ([0.01, 0.3, 0.4, 0.01, *[0.0] * 20], 0.2, "pass", "rose by 0.39 m"),
    ([0.01] * 30, 0.0, "skipped", "not moved"),
    ([0.01] * 30, 0.3, "fail", "moved, but its position"),
    ([0.01, 0.1, 0.01], 0.2, "skipped", "not enough to judge"),
    ([0.0, 0.4, 0.25], 0.2, "warn", "ended +0.25 m"),
    ([], 0.0, "skipped", "no telemetry"),
])  # fmt: skip
def test_a_lift_makes_its_row(
    heights_m: list[float], moves_g: float, verdict: str, words: str
) -> None:
    waits: list[float] = []
    link = Scripted(heights_m, moves_g)
    finding = vehicle.lift_finding(vehicle.record_lift(link, waits.append, 3.0))  # type: ignore[arg-type]
    assert finding.verdict == verdict, finding
    assert words in finding.found
    assert sum(waits) == pytest.approx(3.0)


def test_the_time_for_a_lift_is_counted_down() -> None:
    waits: list[float] = []
    announced: list[str] = []
    wait = vehicle.counting_down(12.0, announced.append, lambda: sum(waits), waits.append)
    for _ in range(130):  # longer than announced: nothing is said after the end
        wait(0.1)
    assert announced == ["7 s left", "2 s left"]
    assert sum(waits) == pytest.approx(13.0)
