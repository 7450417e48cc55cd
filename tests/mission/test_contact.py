"""A contact is proven by every one of its terms: with one of them spoilt there is none."""

from __future__ import annotations

from typing import Any

import pytest

from perchctl.mission import ImuMotion, Observation, Phase
from perchctl.mission.belief.contact import (
    CLIMB_BLOCKED,
    IMU_SHOWS_SUPPORT,
    MIN_REPORTED_TO_HOVER_THRUST_RATIO_TO_DETECT_PRESS,
    TARGET_CONTACT,
    is_pressing_against_surface,
)
from perchctl.profile import Profile
from perchctl.values import replace
from perchctl.vehicle import PositionSetpoint
from tests.helpers.mission import (
    BY_TARGET,
    CEILING_M,
    HANG_Z_M,
    HOVER_THRUST,
    MOCAP,
    PROFILE,
    changed,
    observing,
    remembering,
    state_in,
    target_at,
)
from tests.mission.rig import BEGIN_S, at

PRESSED = 1.2 * HOVER_THRUST


def touching(
    distance_below_m: float = 0.0, steady_s: float = 5.0, unseen_s: float = 0.0, **changes: Any
) -> Observation:
    """A vehicle that presses its gear against the target, `distance_below_m` too low by the
    target's place, which was seen `unseen_s` ago, its vertical speed steady since `steady_s`; with
    changes of its telemetry."""
    place_m = (0.0, 0.0, CEILING_M + distance_below_m)
    seen = {
        "target": target_at(
            BEGIN_S, place_m, (0, 0, HANG_Z_M), last_measured_at_s=BEGIN_S - unseen_s
        ),
        "imu": ImuMotion(t_s=BEGIN_S, climb_rate_became_steady_at_s=steady_s),
    }
    return at(HANG_Z_M, obs=seen, **{"thrust": PRESSED, **changes})(BEGIN_S)


def is_contact(obs: Observation, profile: Profile = PROFILE, **remembered: Any) -> bool:
    pressing = remembering(state_in(Phase.PERCH, z_m=HANG_Z_M), **remembered)
    return TARGET_CONTACT in observing(pressing, obs, profile).belief.condition_start_times_s


@pytest.mark.parametrize("profile", [PROFILE, MOCAP, BY_TARGET], ids=["deck", "mocap", "target"])
def test_all_terms_together_are_a_contact(profile: Profile) -> None:
    assert is_contact(touching(), profile)


@pytest.mark.parametrize("profile", [PROFILE, MOCAP, BY_TARGET], ids=["deck", "mocap", "target"])
@pytest.mark.parametrize(
    "spoilt",
    [
        touching(distance_below_m=0.1),  # the gear is not at the target's height
        touching(distance_below_m=-0.1),
        touching(velocity_mps=(0.0, 0.0, 0.3), steady_s=BEGIN_S),  # it still moves
        touching(acc_z_g=1.3),  # it speeds up
        touching(acc_z_g=0.7),
        touching(thrust=HOVER_THRUST),  # the motors carry it
        touching(t_s=BEGIN_S - 0.5),  # all of that was half a second ago
    ],
    ids=["too low", "too high", "moves", "speeds up", "slows", "hovers", "old"],
)
def test_without_one_of_them_there_is_none(spoilt: Observation, profile: Profile) -> None:
    assert not is_contact(spoilt, profile)


@pytest.mark.parametrize(
    ("profile", "inside", "outside"),
    [
        (PROFILE, touching(thrust=1.09 * HOVER_THRUST), touching(thrust=1.07 * HOVER_THRUST)),
        (PROFILE, touching(acc_z_g=1.11), touching(acc_z_g=1.13)),
        (PROFILE, touching(acc_z_g=0.89), touching(acc_z_g=0.87)),
        (PROFILE, touching(distance_below_m=0.049), touching(distance_below_m=0.051)),
        (PROFILE, touching(distance_below_m=-0.049), touching(distance_below_m=-0.051)),
        (
            PROFILE,
            touching(velocity_mps=(0.0, 0.0, 0.045), steady_s=BEGIN_S),
            touching(velocity_mps=(0.0, 0.0, 0.055), steady_s=BEGIN_S),
        ),
        # By the target alone the estimated height may have run away, by 0.1 m/s since it was seen.
        (BY_TARGET, touching(0.14, unseen_s=1.0), touching(0.16, unseen_s=1.0)),
        (MOCAP, touching(0.049, unseen_s=1.0), touching(0.051, unseen_s=1.0)),
    ],
    ids=["thrust", "heavy", "light", "low", "high", "speed", "unseen", "unseen by mocap"],
)
def test_each_term_has_its_limit(
    profile: Profile, inside: Observation, outside: Observation
) -> None:
    """Just inside of it there is a contact, just outside there is none."""
    assert [is_contact(inside, profile), is_contact(outside, profile)] == [True, False]


def test_without_a_reference_for_the_thrust_there_is_none() -> None:
    """No hover thrust was learned, or the thrust that is read is not the one that was ordered."""
    assert not is_contact(touching(), hover_thrust=0.0)
    unanswered = {
        "commanded_raw_thrust": 20000,
        "thrust_began_to_differ_from_command_at_s": BEGIN_S - 1.0,
        "setpoint": None,
    }
    assert not is_contact(touching(), **unanswered)


@pytest.mark.parametrize("thrust", [1.02, 1.06, 1.1, 1.2])
def test_more_thrust_than_hovering_takes_is_the_same_everywhere(thrust: float) -> None:
    """In the same tick a press proves a contact, is in the way, is felt, and is left slowly."""
    obs = touching(thrust=thrust * HOVER_THRUST)
    pressing = state_in(Phase.PERCH, z_m=HANG_Z_M)
    above = PositionSetpoint(0.0, 0.0, HANG_Z_M + 0.2, 0.0)
    b = observing(replace(pressing, setpoint=above), obs).belief
    found = [
        TARGET_CONTACT in b.condition_start_times_s,
        CLIMB_BLOCKED in b.condition_start_times_s,
        IMU_SHOWS_SUPPORT in b.condition_start_times_s,
        is_pressing_against_surface(b),
    ]
    assert found == [thrust >= MIN_REPORTED_TO_HOVER_THRUST_RATIO_TO_DETECT_PRESS] * 4


@pytest.mark.parametrize(("commanded_raw_thrust", "presses"), [(60_000, True), (None, False)])
def test_the_end_of_a_raw_press_counts_only_while_one_is_flown(
    commanded_raw_thrust: int | None, presses: bool
) -> None:
    """At 59400 of a raw press's 60000 no more can be shown; in position mode, hover thrust of a
    heavy vehicle is as much, and presses nothing."""
    raw = changed({"planner.perch.mode": "raw", "planner.perch.thrust": 62_000})
    pressing = remembering(
        state_in(Phase.PERCH, z_m=HANG_Z_M),
        hover_thrust=58_500.0,
        commanded_raw_thrust=commanded_raw_thrust,
    )
    b = observing(pressing, touching(thrust=59_500.0), raw).belief
    assert is_pressing_against_surface(b) is presses
