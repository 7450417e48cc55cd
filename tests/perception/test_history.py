"""Steps of the state estimate, and what is none."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.mission import Outcome
from perchctl.perception import History, add_samples
from perchctl.vehicle import Telemetry
from tests.helpers.loop_rig import PROFILE, SOON_GIVEN_UP, Rig, Vehicle
from tests.helpers.mission import telemetry

SAFETY = PROFILE.safety


def jumped(*samples: Telemetry) -> bool:
    history, found = History(), False
    for sample in samples:
        history = add_samples(history, [sample], SAFETY)
        found = found or history.jumped
    return found


@pytest.mark.parametrize(
    ("changes", "is_jump"),
    [
        ({"position_m": (0.3, 0.0, 1.0)}, True),
        ({"position_m": (0.2, 0.0, 1.0)}, False),
        ({"position_m": (0.0, 0.0, 0.8)}, True),
        ({"position_m": (0.0, 0.0, 1.1)}, False),
        ({"yaw_rad": math.radians(-170.0)}, True),
        ({"yaw_rad": math.radians(10.0)}, False),
        ({"velocity_mps": (0.0, 0.0, -1.5)}, True),
        ({"velocity_mps": (0.0, 0.5, -0.5)}, False),
    ],
)
def test_a_step_of_the_estimate_is_a_jump_unless_it_is_small(
    changes: dict[str, Any], is_jump: bool
) -> None:
    assert jumped(telemetry(1.0), telemetry(1.01, **changes)) is is_jump


@pytest.mark.parametrize(
    ("readings_v", "age_s"),
    [
        ((0.0,), 10.0),
        ((math.nan,), 10.0),
        ((math.inf, -math.inf), 10.0),
        ((65.0, 65.1), 10.0),
        ((3.8, 0.0), 10.0),
        ((3.8, 0.0, 3.81, math.nan), 0.0),
    ],
)  # fmt: skip
def test_a_battery_that_tells_nothing_new_ages(readings_v: tuple[float, ...], age_s: float) -> None:
    """Fault 7: it is landed after the grace, whatever fills the field of the reading."""
    history = History()
    for i in range(101):
        sample = telemetry(0.1 * i, battery_v=readings_v[i % len(readings_v)])
        history = add_samples(history, [sample], SAFETY)
    assert history.battery_age_s(10.0) == pytest.approx(age_s, abs=0.5)


def test_a_heading_that_wraps_is_no_jump_and_a_smeared_step_is_one() -> None:
    """0.3 m over five samples, which no velocity explains."""
    a, b = telemetry(1.0, yaw_rad=math.pi - 0.01), telemetry(1.01, yaw_rad=-math.pi + 0.01)
    assert not jumped(a, b)
    samples = [telemetry(1.0 + 0.01 * i, position_m=(0.06 * min(i, 5), 0.0, 1.0)) for i in range(9)]
    assert jumped(*samples)


@given(
    st.floats(0, 2 * math.pi), st.floats(0, 2.0), st.floats(-8.0, 8.0), st.sampled_from([1, 2, 5])
)
def test_a_flight_is_no_jump(way: float, mps: float, mps2: float, every: int) -> None:
    """Whatever it does: speeds up, brakes, with telemetry every 10 to 50 ms."""
    samples = []
    for i in range(0, 60, every):
        t_s = 0.01 * i
        v = max(0.0, mps + mps2 * t_s)
        stops_s = -mps / mps2 if mps2 < 0 else math.inf
        far = min(t_s, stops_s)
        s = mps * far + 0.5 * mps2 * far**2
        direction = (math.cos(way), 0.0, math.sin(way))
        samples.append(
            telemetry(
                1.0 + t_s,
                position_m=tuple(s * d for d in direction),
                velocity_mps=tuple(v * d for d in direction),
            )
        )
    assert not jumped(*samples)


def _steps_up(sample: Telemetry) -> Telemetry:
    x_m, y_m, z_m = sample.position_m
    return replace(sample, position_m=(x_m, y_m, z_m + 0.2))


@pytest.mark.parametrize(
    ("until_s", "spoil", "words"),
    [
        (math.inf, lambda s: replace(s, yaw_rad=1.0), "heading jumped"),
        pytest.param(math.inf, _steps_up, "the state estimate jumped", marks=pytest.mark.long),
        (4.0, lambda s: replace(s, velocity_mps=(math.nan, 0.0, 0.0)), "the newest telemetry is"),
    ],
    ids=["heading", "height", "no number for long"],
)
def test_an_estimate_that_jumps_or_is_no_number_lands(
    until_s: float, spoil: Callable[[Telemetry], Telemetry], words: str
) -> None:
    vehicle = Vehicle(lambda s: spoil(s) if 1.5 < s.t_s < until_s else s)
    report = Rig(vehicle, profile=SOON_GIVEN_UP).fly()
    assert report.outcome is Outcome.SAFETY
    assert words in report.reason


@pytest.mark.parametrize("name", ["position_m", "velocity_mps"])
def test_a_position_that_is_no_number_takes_no_attitude_with_it(name: str) -> None:
    """It is as old as the last that was one; by acceleration and thrust the way down goes on."""
    history = add_samples(History(), [telemetry(1.0, 0.7)], SAFETY)
    for i in range(1, 6):
        nowhere = {name: (0.0, math.nan, 0.0)}
        history = add_samples(history, [telemetry(1.0 + 0.01 * i, acc_z_g=0.9, **nowhere)], SAFETY)
    newest = history.newest
    assert newest is not None
    assert (newest.t_s, newest.acc_z_g) == (pytest.approx(1.05), 0.9)
    assert newest.position_m == (0.0, 0.0, 0.7)
    assert newest.behind_s == pytest.approx(0.05)
    assert not history.jumped
    tilted = add_samples(history, [telemetry(1.06, roll_rad=math.nan)], SAFETY)
    assert tilted.newest is newest
