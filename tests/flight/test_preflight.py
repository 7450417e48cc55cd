"""What keeps a vehicle on the ground: it hangs, is held, lies askew, or sees what cannot be."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.errors import SafetyAbort, TimedOut
from perchctl.flight.preflight import still_waiting_for
from perchctl.mission import Operator, Outcome
from perchctl.perception import perception
from perchctl.vehicle import PositionSetpoint
from perchctl.vision import Detections
from tests.helpers.flights import fly_short
from tests.helpers.loop_rig import PROFILE, Camera, Rig, Vehicle, noise
from tests.helpers.mission import READY, changed, target_at, telemetry

LOWEST_M = PROFILE.planner.takeoff_height_m


def rig(**changes: Any) -> Rig:
    return Rig(Vehicle(lambda sample: replace(sample, **changes)))


@pytest.mark.parametrize("z_m", [2.1, 0.3, -0.3])
def test_a_vehicle_off_the_ground_is_refused(z_m: float) -> None:
    """It hangs from its last flight, and its program was started anew."""
    it = rig(position_m=(0.0, 0.0, z_m))
    it.refused(SafetyAbort, rf"at {z_m:.2f} m.*hangs.*take it down.*safety\.ground_z_m")
    assert it.link.now_s < 0.1


def test_a_hanging_vehicle_is_refused_without_a_picture() -> None:
    """Against the ceiling the camera is dark."""
    it = rig(position_m=(0.0, 0.0, 2.1))
    it.camera = Camera(lambda frame: None)
    it.refused(SafetyAbort, "hangs")


def test_an_unsettled_height_is_no_height() -> None:
    rig(position_m=(0.0, 0.0, 2.1), position_variance_m2=0.5).refused(TimedOut, "settle")


def on_the_ground(z_m: float = 0.0, **safety: float) -> str:
    profile = PROFILE.model_copy(update={"safety": PROFILE.safety.model_copy(update=safety)})
    sample = telemetry(1.0, z_m, thrust=0.0, supervisor=READY)
    return still_waiting_for(sample, True, None, 0.0, profile)


@pytest.mark.parametrize(
    ("age_s", "waits"), [(0.02, False), (0.2, False), (0.5, True), (5.0, True)]
)
def test_old_telemetry_is_waited_for(age_s: float, waits: bool) -> None:
    """It may have stopped while the camera was waited for: nothing is taken over on it."""
    sample = telemetry(1.0, 0.0, thrust=0.0, supervisor=READY)
    waiting = still_waiting_for(sample, True, None, 0.0, PROFILE, age_s=age_s)
    assert ("old" in waiting) is waits
    if waits:
        limit_s = PROFILE.safety.estimator_wait_s
        with pytest.raises(TimedOut, match="old"):
            still_waiting_for(sample, True, None, limit_s + 0.1, PROFILE, age_s=age_s)


@pytest.mark.parametrize("variance", [float("nan"), 1.0])
def test_a_variance_that_is_no_number_is_not_settled(variance: float) -> None:
    rig(position_variance_m2=variance).refused(TimedOut, "settle")


def test_a_table_may_be_the_ground() -> None:
    assert on_the_ground(0.8, ground_z_m=0.75) == ""
    with pytest.raises(SafetyAbort):
        on_the_ground(0.0, ground_z_m=0.75)
    assert on_the_ground(0.3, ground_tolerance_m=0.4) == ""


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"roll_rad": 0.3}, "stand level .it is tilted by 17 deg, at most 10"),
        ({"pitch_rad": -0.2}, "tilted by 11 deg"),
        ({"acc_z_g": 0.7}, r"stand still .*0\.70 g"),
        ({"acc_z_g": 1.2}, r"1\.20 g"),
    ],
)
def test_a_vehicle_that_lies_askew_or_is_carried_is_waited_for(
    changes: dict[str, Any], words: str
) -> None:
    it = rig(**changes)
    it.refused(TimedOut, words)
    assert it.link.now_s == pytest.approx(PROFILE.safety.estimator_wait_s, abs=0.2)


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"battery_v": 3.797}, SafetyAbort, r"rests at 3\.797 V, at least 3\.800 V"),
        ({"battery_v": 3.5}, SafetyAbort, r"rests at 3\.50 V, at least 3\.80 V"),
        ({"roll_rad": math.radians(10.2)}, TimedOut, r"by 10\.2 deg, at most 10\.0"),
        ({"position_variance_m2": 0.0103}, TimedOut, r"variance 0\.0103 .*at most 0\.0100"),
    ],
)
def test_what_is_found_does_not_look_like_what_is_needed(
    changes: dict[str, Any], error: type[Exception], words: str
) -> None:
    rig(**changes).refused(error, words)


def test_a_vehicle_that_is_put_down_flies() -> None:
    it = Rig(Vehicle(lambda s: replace(s, roll_rad=0.3 if s.t_s < 3.0 else 0.0)))
    it.operator = lambda: Operator.LAND if it.link.said(PositionSetpoint) else Operator.NONE
    assert it.fly().outcome is Outcome.OPERATOR
    assert 3.0 <= it.link.said(PositionSetpoint)[0] < 3.2


@pytest.mark.parametrize(("away_m", "tracked", "flies"), [
    (0.2, True, False), (0.2, False, True), (1.5, True, True),
])  # fmt: skip
def test_a_target_within_reach_is_refused(away_m: float, tracked: bool, flies: bool) -> None:
    sample = telemetry(1.0, 0.0, thrust=0.0, supervisor=READY)
    gear_m = PROFILE.vehicle.gear_body_m[2]
    target = target_at(1.0, (0.0, 0.0, gear_m + away_m), (0.0, 0.0, 0.0), tracked=tracked)
    if flies:
        assert still_waiting_for(sample, True, None, 0.0, PROFILE, target) == ""
        return
    with pytest.raises(SafetyAbort, match=r"target is only 0\.20 m away.*take it down"):
        still_waiting_for(sample, True, None, 0.0, PROFILE, target)


def test_the_camera_refuses_a_target_within_reach() -> None:
    with pytest.raises(SafetyAbort, match="target is only"):
        fly_short(ceiling_z_m=0.32)


# --- Pictures that are none --------------------------------------------------------------


def test_a_picture_of_another_size_in_flight_is_no_measurement() -> None:
    """The receiver changes its mode: nothing is raised in the air, it is named and landed."""
    small = noise(0)[:24, :32]
    it = Rig()
    it.camera.alter = lambda f: replace(f, image=small + f.index % 7) if f.t_arrival_s > 2 else f
    report = it.fly()
    assert report.outcome is Outcome.SAFETY
    assert "32x24 px, the calibration 64x48" in report.reason
    assert max(t.t_s for t in it.watcher.ticks if t.output is not None) <= 2.0 + 1e-9


def test_a_mirrored_picture_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    real = perception.step

    def mirrored(*arguments: Any) -> Any:
        state, output = real(*arguments)
        seen = Detections(output.detections.frame_index, output.detections.t_s, mirrored=True)
        return state, replace(output, detections=seen)

    monkeypatch.setattr(perception, "step", mirrored)
    for is_set in (False, True):
        it = Rig(profile=changed({"camera.mirrored": is_set}))
        report = it.fly()
        assert report.outcome is Outcome.TARGET_NOT_FOUND
        assert "the picture is mirrored" in report.reason
        advice = "take camera.mirrored out" if is_set else "set camera.mirrored"
        assert advice in report.reason


def test_a_mirrored_picture_once_is_a_chance(monkeypatch: pytest.MonkeyPatch) -> None:
    real, left = perception.step, [perception.MIRRORED_FRAMES - 1]

    def seldom(*arguments: Any) -> Any:
        state, output = real(*arguments)
        left[0] -= 1
        seen = replace(output.detections, mirrored=left[0] >= 0)
        return state, replace(output, detections=seen)

    monkeypatch.setattr(perception, "step", seldom)
    assert "mirrored" not in Rig().fly().reason
