"""What accelerometer and attitude tell of the motion, through silences and readings that stand."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.mission import ImuMotion
from perchctl.mission.belief.motion import (
    MAX_FROZEN_READING_DURATION_TO_TRUST_SAMPLE_S,
    MAX_SAMPLE_INTERVAL_WITHOUT_TELEMETRY_GAP_S,
    MIN_LATERAL_SPECIFIC_FORCE_TO_DETECT_PUSH_G,
    MIN_VARIANCE_GROWTH_TIME_TO_DETECT_FUSION_STOP_S,
)
from perchctl.mission.belief.reckoning import (
    MAGNET_REACH_BELOW_TARGET_M,
    MAX_POSSIBLE_CLIMB_RATE_IN_TELEMETRY_GAP_MPS,
    DeadReckoningState,
    advance_dead_reckoning,
    restart_dead_reckoning_at_sighting,
)
from perchctl.vehicle import Telemetry
from tests.helpers.mission import telemetry


def flown(samples: list[Telemetry], motion: ImuMotion | None = None) -> ImuMotion:
    motion = motion or ImuMotion()
    for last, new in zip([None, *samples], samples, strict=False):
        motion = motion.with_sample(last, new)
    return motion


def test_an_accelerometer_that_stands_still_is_a_silence() -> None:
    """A reading of 0.9 g for ever is neither a fall nor a way down."""
    frozen = [telemetry(0.01 * i, acc_x_g=0.0, acc_z_g=0.9) for i in range(300)]
    motion = flown(frozen)
    assert motion.acceleration_frozen_for_s == pytest.approx(2.99)
    assert motion.last_telemetry_gap_ended_at_s == pytest.approx(2.99)
    assert motion.last_fall_at_s < 0.0
    assert (
        abs(motion.velocity_since_first_sample_world_mps[2])
        < 1.1 * 0.1 * 9.81 * MAX_FROZEN_READING_DURATION_TO_TRUST_SAMPLE_S
    )
    alive = flown([telemetry(0.01 * i, acc_z_g=0.9) for i in range(300)])
    assert alive.acceleration_frozen_for_s == 0.0
    assert alive.last_fall_at_s > 0.0


HUNG = [telemetry(0.01 * i, 1.9) for i in range(100)]
UNTIL_THEN = flown(HUNG)


def since_heard(after: Telemetry, before: Telemetry | None = None) -> ImuMotion:
    """What a silence leaves, of a vehicle that hung at 1.9 m before it."""
    return UNTIL_THEN.with_sample(before or HUNG[-1], after)


@given(
    silent_s=st.floats(MAX_SAMPLE_INTERVAL_WITHOUT_TELEMETRY_GAP_S + 0.01, 4.0),
    drift_mps=st.floats(-0.1, 0.1),
)
def test_a_silence_over_which_the_estimate_shows_no_fall_hides_none(
    silent_s: float, drift_mps: float
) -> None:
    """On board the accelerometer is felt all the time: what fell has gained speed, or where the
    floor took that, has gone down."""
    t_s = 0.99 + silent_s
    hangs = since_heard(telemetry(t_s, 1.9 + 0.05, velocity_mps=(0.0, 0.0, drift_mps)))
    assert (hangs.last_telemetry_gap_ended_at_s, hangs.last_gap_that_may_hide_fall_ended_at_s) == (
        t_s,
        -math.inf,
    )
    for z_m, climb_mps, changes in (
        (1.9, drift_mps - 1.0, {}),  # the floor's blow was more than the accelerometer reads
        (0.0, drift_mps, {}),
        (1.9, drift_mps, {"behind_s": silent_s}),  # the position is from before
        (1.9, drift_mps, {"start": 1}),  # and this estimate is another one
    ):
        after = telemetry(t_s, z_m, velocity_mps=(0.0, 0.0, climb_mps), **changes)
        assert since_heard(after).last_gap_that_may_hide_fall_ended_at_s == t_s
    still = telemetry(0.99, 1.9)
    assert since_heard(replace(still, t_s=t_s), still).last_gap_that_may_hide_fall_ended_at_s == t_s


def test_after_a_silence_the_estimate_s_own_change_counts() -> None:
    """On board the accelerometer was felt all the time, and no position corrected anything. What
    the estimate was wrong by before it is still wrong by."""
    before = telemetry(1.0, velocity_mps=(0.1, 0.0, 0.15))
    after = telemetry(1.7, velocity_mps=(0.1, 0.2, -0.5))
    imu = flown([before])
    old = DeadReckoningState(
        imu, velocity_world_mps=(0.0, 0.0, 0.05), estimated_velocity_world_mps=before.velocity_mps
    )
    heard = imu.with_sample(before, after)
    new = advance_dead_reckoning(old, heard, after, is_estimate_trusted=False)
    assert new.velocity_world_mps == pytest.approx((0.0, 0.2, -0.6))
    assert (
        advance_dead_reckoning(old, heard, after, is_estimate_trusted=True).velocity_world_mps
        == after.velocity_mps
    )
    assert advance_dead_reckoning(
        old, heard, after, is_estimate_trusted=False, is_position_diverged=True
    ).velocity_world_mps == (old.velocity_world_mps)


@given(
    step_rad=st.tuples(st.floats(-0.15, 0.15), st.floats(-0.15, 0.15)),
    step_mps=st.floats(0.2, 2.0),
    rate_radps=st.floats(-3.0, 3.0),
)
def test_a_correction_by_a_wrong_position_does_not_turn_what_is_felt(
    step_rad: tuple[float, float], step_mps: float, rate_radps: float
) -> None:
    """The estimate's speed steps, and the attitude with it, while the vehicle itself turns on."""

    def flight(jumps: bool) -> list[Telemetry]:
        samples = []
        for i in range(60):
            after = jumps and i >= 30
            roll, pitch = step_rad if after else (0.0, 0.0)
            turned_rad = 0.1 * rate_radps * max(0.0, min(0.1, 0.01 * i - 0.25))
            samples.append(
                telemetry(
                    0.01 * i, roll_rad=turned_rad + roll, pitch_rad=pitch,
                    velocity_mps=(step_mps if after else 0.0, 0.0, 0.0),
                    acc_x_g=0.0001 * i, acc_z_g=1.0,
                )
            )  # fmt: skip
        return samples

    misled, true = flown(flight(True)), flown(flight(False))
    assert true.error_of_estimated_roll_pitch_rad == (0.0, 0.0)
    assert misled.error_of_estimated_roll_pitch_rad == pytest.approx(step_rad, rel=0.06, abs=0.001)
    assert misled.velocity_since_first_sample_world_mps[:2] == pytest.approx(
        true.velocity_since_first_sample_world_mps[:2], abs=0.04
    )


@given(
    gear_below_target_m=st.floats(0.05, 2.0),
    silent_s=st.floats(MAX_SAMPLE_INTERVAL_WITHOUT_TELEMETRY_GAP_S + 0.01, 3.0),
)
def test_in_a_silence_only_what_had_thrust_climbs_into_the_magnet_s_reach(
    gear_below_target_m: float, silent_s: float
) -> None:
    """However it was last heard to sink. With motors that were off, or started anew, it lies, or
    hangs where it hung."""
    sinks = {"velocity_mps": (0.0, 0.0, -0.3)}
    near = (
        gear_below_target_m - MAX_POSSIBLE_CLIMB_RATE_IN_TELEMETRY_GAP_MPS * silent_s
        < MAGNET_REACH_BELOW_TARGET_M
    )
    off = {"thrust": 0.0}
    for z_m, before, after, unsure, kept in (
        (
            gear_below_target_m,
            telemetry(1.0, **sinks),
            telemetry(1.0 + silent_s, **sinks),
            near,
            True,
        ),
        (
            gear_below_target_m,
            telemetry(1.0, **off),
            telemetry(1.0 + silent_s, **off),
            False,
            False,
        ),
        (
            gear_below_target_m,
            telemetry(1.0),
            telemetry(1.0 + silent_s, start=1, **off),
            False,
            False,
        ),
        (0.02, telemetry(1.0, **off), telemetry(1.0 + silent_s, **off), True, True),
    ):
        imu = flown([before])
        old = restart_dead_reckoning_at_sighting(
            DeadReckoningState(imu), 0.9, (0.0, 0.0), z_m, 0.001
        )
        new = advance_dead_reckoning(
            old, imu.with_sample(before, after), after, is_estimate_trusted=False
        )
        assert (new.last_telemetry_gap_in_magnet_reach_ended_at_s == after.t_s) is unsure
        assert new.gear_below_target_m == (z_m if kept else math.inf)
        assert (
            restart_dead_reckoning_at_sighting(
                new, after.t_s + 0.1, (0.0, 0.0), z_m, 0.001
            ).gear_below_target_lower_bound_m
            == z_m
        )


def test_a_fall_that_was_caught_does_not_take_it_out_of_what_a_silence_may_bring() -> None:
    """It fell by 5 cm, and the setpoint that catches it is a metre above."""
    falls = [telemetry(1.0 + 0.01 * i, acc_z_g=0.3) for i in range(13)]
    motion = flown(falls[:1])
    dead_reckoning = restart_dead_reckoning_at_sighting(
        DeadReckoningState(motion), 0.9, (0.0, 0.0), 0.0, 0.001
    )
    late = telemetry(falls[-1].t_s + 1.5)
    for last, new in pairwise([*falls, late]):
        assert new is not late or 0.02 < dead_reckoning.gear_below_target_lower_bound_m < 0.1
        motion = motion.with_sample(last, new)
        dead_reckoning = advance_dead_reckoning(
            dead_reckoning, motion, new, is_estimate_trusted=False
        )
    assert motion.last_fall_at_s > 1.0
    assert dead_reckoning.last_telemetry_gap_in_magnet_reach_ended_at_s == late.t_s


def estimate_only_mps(
    turn: int, pushed_g: float = 0.0, samples: int = 4, offset_g: float = 0.0
) -> float:
    """After 0.4 s of a tilt that speeds it up by 1 m/s2, with an estimate that follows as it is, or
    mirrored (`turn` -1), or corrected by positions after a push that it did not feel and that so
    many samples show. `offset_g`: what the accelerometer reads too much."""
    lean_rad = 1.0 / 9.81
    dead_reckoning, motion, last = (
        DeadReckoningState(),
        ImuMotion(accelerometer_offset_g=(offset_g, 0.0, 0.0)),
        None,
    )
    for i in range(41):
        t_s = 1.0 + 0.01 * i
        new = telemetry(
            t_s, velocity_mps=(turn * 0.01 * i, 0.0, 0.0), pitch_rad=lean_rad + 1e-6 * (i % 7),
            acc_x_g=offset_g + (pushed_g if 3 <= i < 3 + samples else 1e-6 * (i % 7)),
        )  # fmt: skip
        motion = motion.with_sample(last, new)
        dead_reckoning = advance_dead_reckoning(
            dead_reckoning, motion, new, is_estimate_trusted=True
        )
        last = new
    return abs(dead_reckoning.recent_estimate_minus_imu_velocity_world_xy_mps[0])


def test_an_estimate_that_moves_otherwise_than_it_feels_is_told_from_one_that_was_pushed() -> None:
    assert estimate_only_mps(1) < 0.05
    assert estimate_only_mps(-1) > 0.3
    assert estimate_only_mps(-1, pushed_g=2.0 * MIN_LATERAL_SPECIFIC_FORCE_TO_DETECT_PUSH_G) == 0.0
    assert estimate_only_mps(-1, pushed_g=0.09, samples=20) == 0.0  # a gust of 1 m/s in a second
    assert estimate_only_mps(-1, offset_g=1.2 * MIN_LATERAL_SPECIFIC_FORCE_TO_DETECT_PUSH_G) > 0.3


# --- Whether the estimate is corrected -----------------------------------------------------------


def uncorrected_s(*growths: tuple[float, float]) -> float:
    """The age of the last correction, after each a second by how much the variance of the vertical
    speed grows in it and how long it lasts; its packets come each 0.1 s."""
    variance, motion, last = 1e-4, ImuMotion(), None
    t_s = 0.0
    for per_s, lasts_s in growths:
        for _ in range(round(lasts_s / 0.01)):
            t_s += 0.01
            if round(100 * t_s) % 10 == 0:
                variance += 0.1 * per_s
            new = telemetry(t_s, climb_variance_m2ps2=variance)
            motion, last = motion.with_sample(last, new), new
    return motion.estimate_fusion_monitor.age_s(t_s)


def test_a_variance_that_grows_on_and_on_is_corrected_no_more() -> None:
    """After 0.5 s it is certain, and then the age counts from the last correction."""
    assert (
        uncorrected_s((0.0, 1.0), (1e-3, MIN_VARIANCE_GROWTH_TIME_TO_DETECT_FUSION_STOP_S)) == 0.0
    )
    assert uncorrected_s((0.0, 1.0), (1e-3, 0.6)) == pytest.approx(0.6, abs=0.11)
    assert uncorrected_s((0.0, 1.0), (1e-3, 5.0)) == pytest.approx(5.0, abs=0.11)


@pytest.mark.parametrize("growths", [
    ((2e-4, 5.0),),  # a laser's reading that is worse with each centimetre of height
    ((1e-3, 0.4), (-1e-3, 0.1)) * 8,  # positions with holes
    ((1e-3, 3.0), (-1e-2, 0.2)),  # they come again
    ((1e-3, 0.4), (0.0, 3.0)),  # the variance's packets come no more
    ((math.nan, 3.0),),
])  # fmt: skip
def test_what_is_corrected_or_not_known_is_not_called_uncorrected(
    growths: tuple[tuple[float, float], ...],
) -> None:
    assert uncorrected_s((0.0, 1.0), *growths) == 0.0


def test_no_silence_and_no_frozen_accelerometer_hides_that_nothing_corrects_it() -> None:
    silent = [telemetry(0.3 * i, climb_variance_m2ps2=1e-4 + 3e-4 * i) for i in range(10)]
    assert flown(silent).estimate_fusion_monitor.age_s(2.7) == pytest.approx(2.7)
