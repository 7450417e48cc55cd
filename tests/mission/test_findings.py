"""What is said after a flight about latency and mounting."""

from __future__ import annotations

import inspect
import math
import re
from dataclasses import replace

import pytest

from perchctl.mission import CameraFindings, FlightReport, ImuMotion, Observation, Phase
from perchctl.mission.belief.reckoning import DeadReckoningState
from perchctl.mission.phase import VehicleDiagnosis
from perchctl.mission.table import TABLE
from perchctl.profile import CameraConfig
from perchctl.vision import CameraCalibrationErrors
from tests.helpers.mission import BY_TARGET, observation, remembering, state_in, telemetry
from tests.mission.rig import BEGIN_S, Look, fly


def _seen(
    delay_s: float = 0.0,
    sigma_s: float = 0.003,
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
    sigma_deg: float = 0.4,
) -> CameraCalibrationErrors:
    x, y, z = (math.radians(t) for t in turn_deg)
    sigma_rad = math.radians(sigma_deg)
    return CameraCalibrationErrors(delay_s, sigma_s, (x, y, z), (sigma_rad, sigma_rad, sigma_rad))


CAMERA = CameraConfig(latency_s=0.06)


@pytest.mark.parametrize(
    ("seen", "camera", "words"),
    [
        (
            _seen(0.032),
            CAMERA,
            "latency is 92 +- 6 ms, not 60 ms as in the profile: set camera.latency_s",
        ),
        (_seen(0.018), CAMERA, ""),
        (_seen(0.04, 0.0105), CAMERA, ""),  # too unsure
        (_seen(0.05), CameraConfig(latency_s="measured"), ""),
        (_seen(turn_deg=(0.5, -3.0, 6.0)), CAMERA, "-3.0 +- 0.8, 6.0 +- 0.8 deg"),
        (_seen(turn_deg=(-37.8, 0.0, 0.0), sigma_deg=15.0), CAMERA, ""),  # a flight of 3.5 s
    ],
)
def test_only_what_is_surely_beyond_its_gate_is_an_advice(
    seen: CameraCalibrationErrors, camera: CameraConfig, words: str
) -> None:
    found = CameraFindings.from_camera_errors(seen, camera)
    assert found.measured_latency_s == pytest.approx(
        camera.start_latency_s + seen.latency_above_profile_s
    )
    assert bool(found.advice) is bool(words)
    assert words in "".join(found.advice)
    # The scenario's camera is nobody's: it says nothing of the profile.
    dreamt = CameraFindings.from_camera_errors(seen, camera, simulated=True)
    assert dreamt == replace(found, advice=())


def test_each_row_that_blames_the_profile_is_known() -> None:
    """By what its function says: a row that names keys of camera or positioning, or how to measure
    them, is one."""
    blames = {
        row.name
        for row in TABLE
        if callable(row.reason)
        and re.search(r"camera\.(mount|latency)|check --lift", inspect.getsource(row.reason))
    }
    assert blames == {
        row.name for row in TABLE if VehicleDiagnosis.PROFILE_MAY_BE_WRONG in row.diagnosis
    }


@pytest.mark.parametrize("phase", [Phase.PERCHED, Phase.LANDED])
def test_what_the_magnet_caught_on_its_way_down_has_a_distance_too(phase: Phase) -> None:
    """A contact is proven only in PERCH; what hangs after a landing was carried there by the dead
    reckoning."""
    dead_reckoning = DeadReckoningState(
        imu_at_last_update=ImuMotion(t_s=BEGIN_S),
        gear_to_target_world_xy_m=(0.03, 0.04),
        gear_to_target_sigma_m=0.01,
    )
    state = remembering(
        state_in(phase), dead_reckoning=dead_reckoning, gear_to_target_at_last_contact=None
    )
    report = FlightReport.from_state(state, observation(BEGIN_S), BY_TARGET, (), None)
    if phase is Phase.LANDED:
        assert report.gear_to_target_at_last_contact is None
        return
    assert report.gear_to_target_at_last_contact is not None
    assert report.gear_to_target_at_last_contact.distance_xy_m == pytest.approx(0.05)
    assert 0.01 <= report.gear_to_target_at_last_contact.sigma_m < 0.02


def test_what_hangs_with_its_motors_off_stays_where_it_was_caught() -> None:
    """Its distance does not become unsure while it hangs there."""
    dead_reckoning = DeadReckoningState(
        gear_to_target_world_xy_m=(0.02, 0.0),
        gear_to_target_sigma_m=0.01,
        gear_below_target_m=0.0,
        last_sighting_at_s=BEGIN_S - 0.5,
    )
    begun = remembering(
        state_in(Phase.LANDING, z_m=1.9),
        dead_reckoning=dead_reckoning, vehicle_world_z_at_last_contact_m=1.9,
        magnet_reach_entered_at_s=BEGIN_S, motor_stop_commanded_at_s=BEGIN_S,
        dead_reckoning_began_at_s=BEGIN_S,
    )  # fmt: skip
    flight = fly(begun, hangs(1.9), 4.0, BY_TARGET, feels=True)
    rest = [
        tick.state.belief.dead_reckoning.gear_to_target_sigma_m
        for tick in flight.ticks
        if tick.t_s > BEGIN_S + 1.0
    ]
    assert rest[-1] == pytest.approx(rest[0], abs=1e-6)
    assert rest[-1] < 0.1


def hangs(z_m: float) -> Look:
    """A vehicle on the magnet, its motors off and its target out of sight."""

    def look(t_s: float) -> Observation:
        sample = telemetry(t_s, z_m, thrust=0, acc_x_g=1e-4 * (round(100 * t_s) % 3))
        return observation(
            t_s, telemetry=sample, target=None, external_position_age_s=t_s - BEGIN_S
        )

    return look
