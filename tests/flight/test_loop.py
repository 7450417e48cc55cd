"""The flight loop: what it refuses before take-off, and that it lands first, whatever is wrong."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.errors import Interrupted, InvalidValue, NotFound, PerchError, SafetyAbort, TimedOut
from perchctl.flight.preflight import still_waiting_for
from perchctl.mission import EventKind, FlightReport, Operator, Outcome, Tick
from perchctl.perception import perception
from perchctl.vehicle import CRASHED, DECK_FAULT, FLYING, LOCKED, TUMBLED, Land, PositionSetpoint
from perchctl.vision.types import Detections
from tests.helpers.loop_rig import PROFILE, Camera, Rig, SleepyClock, Vehicle, noise
from tests.helpers.mission import READY, changed, target_at, telemetry

PERIOD_S = 1.0 / PROFILE.link.loop_hz
BAD_S = 2.0
"""From then on something is wrong."""


def landed_for(rig: Rig, words: str) -> FlightReport:
    """The report of a flight that safety ended, and which says so."""
    report = rig.fly()
    assert report.outcome is Outcome.SAFETY
    assert words in report.reason
    return report


def land_after(rig: Rig, t_s: float) -> Callable[[], Operator]:
    return lambda: Operator.LAND if rig.link.now_s > t_s else Operator.NONE


# --- Bad measurements ---------------------------------------------------------------------------


def test_telemetry_that_is_no_number_is_left_out() -> None:
    """Ten samples of NaN in the air: no jump, no command with NaN, the flight goes on."""
    nan = (math.nan, 0.0, 0.5)
    rig = Rig(Vehicle(lambda s: replace(s, position_m=nan) if 1.5 < s.t_s < 1.6 else s))
    rig.operator = land_after(rig, 3.0)
    assert rig.fly().outcome is Outcome.OPERATOR
    assert all(math.isfinite(v) for t in rig.watcher.ticks for v in t.telemetry.position_m)
    assert 0.08 < max(t.telemetry_age_s for t in rig.watcher.ticks) < 0.15


def test_telemetry_that_stays_away_lands() -> None:
    rig = Rig(Vehicle(lambda s: None if 1.5 < s.t_s < 4.0 else s))
    landed_for(rig, "no telemetry")
    assert rig.link.said(Land)[0] == pytest.approx(1.5 + 1.0, abs=0.06)


STILL, SMALL = noise(0), noise(0)[:24, :32]


@pytest.mark.parametrize(("bad", "words"), [
    (lambda f: replace(f, t_s=f.t_s - 0.5), "late"),
    (lambda f: replace(f, image=STILL), "stands still"),  # the receiver repeats an old picture
    (lambda f: replace(f, image=SMALL + f.index % 7), "32x24 px, the calibration 64x48"),
], ids=["late", "frozen", "of another size"])  # fmt: skip
def test_a_bad_picture_is_no_measurement(bad: Callable[..., Any], words: str) -> None:
    """Nothing is raised in the air: the camera counts as gone, is named, and landed for."""
    rig = Rig(camera=Camera(lambda f: bad(f) if f.t_arrival_s > BAD_S else f))
    landed_for(rig, words)
    # The first repeated one is like any other picture.
    measured = [t.t_s for t in rig.watcher.ticks if t.output is not None]
    assert max(measured) < BAD_S + 1.5 * PERIOD_S * (words == "stands still") + 1e-9
    assert max(t.camera_age_s for t in rig.watcher.ticks) > PROFILE.safety.camera_land_s


def test_a_camera_that_reports_a_failure_lands_with_its_words() -> None:
    rig = Rig()

    def unplug(tick: Tick) -> None:
        if tick.t_s > BAD_S:
            rig.camera.told = "the plug was pulled"

    rig.watcher.on_tick = unplug
    landed_for(rig, "the plug was pulled")


def test_a_lost_link_lands() -> None:
    rig = Rig()
    rig.link.dies_at_s = BAD_S
    landed_for(rig, "the script ended the link")
    assert rig.link.said(Land)[0] == pytest.approx(BAD_S, abs=0.05)


@pytest.mark.parametrize("strict", [False, True])
def test_a_log_that_fails_is_said_once_and_landed_for_where_the_profile_wants_it(
    strict: bool,
) -> None:
    rig = Rig(profile=changed({"safety.land_on_log_error": strict}))
    rig.operator = land_after(rig, 3.0)

    def fill(tick: Tick) -> None:
        rig.watcher.problem = "the disk is full"

    rig.watcher.on_tick = fill
    report = rig.fly()
    assert report.outcome is (Outcome.SAFETY if strict else Outcome.OPERATOR)
    assert ("the disk is full" in report.reason) is strict
    said = [e for e in rig.watcher.events if "incomplete" in e.reason]
    assert [e.kind for e in said] == [EventKind.NOTE]
    assert "the disk is full" in said[0].reason


@pytest.mark.parametrize("is_set", [False, True])
def test_a_mirrored_picture_is_named(monkeypatch: pytest.MonkeyPatch, is_set: bool) -> None:
    real = perception.step

    def mirrored(*arguments: Any) -> Any:
        state, output = real(*arguments)
        seen = Detections(output.detections.frame_index, output.detections.t_s, mirrored=True)
        return state, replace(output, detections=seen)

    monkeypatch.setattr(perception, "step", mirrored)
    report = Rig(profile=changed({"camera.mirrored": is_set})).fly()
    assert report.outcome is Outcome.TARGET_NOT_FOUND
    assert "the picture is mirrored" in report.reason
    assert ("take camera.mirrored out" if is_set else "set camera.mirrored") in report.reason


# --- Time ---------------------------------------------------------------------------------------


def test_a_suspended_computer_lands_and_does_not_catch_up() -> None:
    rig = Rig()
    rig.clock = SleepyClock(rig.link, at_s=2.5, for_s=30.0)
    assert rig.fly().outcome is Outcome.SAFETY
    times = np.array([t.t_s for t in rig.watcher.ticks])
    gap = int(np.argmax(np.diff(times)))
    assert times[gap + 1] - times[gap] > 29.0
    assert np.diff(times[gap + 1 :]).min() > 0.5 * PERIOD_S  # no burst of stale turns
    assert rig.link.said(Land)[0] == times[gap + 1]  # at once
    assert rig.watcher.ticks[gap + 1].loop_late_s > 29.0
    assert not [t for t in rig.link.said(PositionSetpoint) if t > times[gap]]


# --- Before take-off: refused at once, or waited for ----------------------------------------------


HANGS = (0.0, 0.0, 2.1)


AT_ONCE: list[tuple[dict[str, Any], str]] = [
    ({"supervisor": READY | LOCKED}, "locked"),
    ({"supervisor": READY | CRASHED}, "crash"),
    ({"supervisor": READY | TUMBLED}, "upside down"),
    ({"supervisor": READY | DECK_FAULT}, "deck"),
    ({"supervisor": READY | FLYING}, "flying already"),
    ({"supervisor": READY | 1 << 13}, "unknown bits .0x200E"),
    ({"battery_v": 3.4}, r"3\.40 V.*3\.80 V.*charge"),
    ({"position_m": HANGS}, r"at 2\.10 m.*hangs.*take it down.*safety\.ground_z_m"),
    ({"position_m": (0.0, 0.0, -0.3)}, r"at -0\.30 m"),
]
IN_TIME: list[tuple[dict[str, Any], str]] = [
    ({"position_variance_m2": 0.5}, r"settle.*variance 0\.5.*positioning"),
    ({"position_variance_m2": math.nan}, "settle"),
    ({"position_variance_m2": 0.5, "position_m": HANGS}, "settle"),  # it is no height
    ({"supervisor": 0x06}, "0x0006"),
    ({"roll_rad": 0.3}, "stand level .tilted by 17 deg, at most 10"),
    ({"pitch_rad": -0.2}, "tilted by 11 deg"),
    ({"acc_z_g": 0.7}, r"stand still .*0\.70 g"),
    ({"acc_z_g": 1.2}, r"1\.20 g"),
]
NO_PICTURE = Camera(lambda frame: None)


@pytest.mark.parametrize(("changes", "words", "waits"), [
    *((*each, False) for each in AT_ONCE), *((*each, True) for each in IN_TIME),
])  # fmt: skip
def test_a_vehicle_that_may_not_fly_or_is_not_ready_in_time_is_refused(
    changes: dict[str, Any], words: str, waits: bool
) -> None:
    rig = Rig(Vehicle(lambda sample: replace(sample, **changes)))
    rig.refused(TimedOut if waits else SafetyAbort, words)
    limit_s = PROFILE.safety.estimator_wait_s if waits else 0.0
    assert rig.link.now_s == pytest.approx(limit_s, abs=0.2 if waits else 0.1)


@pytest.mark.parametrize(
    ("vehicle", "camera", "error", "words", "limit_s"),
    [
        (Vehicle(lambda sample: None), Camera(), TimedOut, "telemetry", 10.0),
        (Vehicle(), NO_PICTURE, TimedOut, "picture .none has come", 8.0),
        (Vehicle(), Camera(lambda f: replace(f, t_s=f.t_s - 5.0)), TimedOut, "5.* s late", 8.0),
        (Vehicle(), Camera(lambda f: replace(f, t_s=f.t_s + 0.2)), TimedOut, "is not past", 8.0),
        (
            Vehicle(),
            Camera(lambda f: replace(f, t_s=math.nan)),
            TimedOut,
            "nan s, is not past",
            8.0,
        ),
        # Against the ceiling the camera is dark.
        (Vehicle(lambda s: replace(s, position_m=HANGS)), NO_PICTURE, SafetyAbort, "hangs", 0.0),
        (Vehicle(), Camera(size_px=(320, 240)), InvalidValue, "320x240.*64x48", 0.0),
        (Vehicle(), Camera(live=False, frames=1), NotFound, "ended before take-off", 0.0),
    ],
)
def test_what_does_not_come_is_refused(
    vehicle: Vehicle, camera: Camera, error: type[PerchError], words: str, limit_s: float
) -> None:
    Rig(vehicle, camera).refused(error, words)
    assert limit_s <= vehicle.now_s < limit_s + 0.2


def test_ctrl_c_on_the_ground_starts_nothing() -> None:
    Rig(operator=lambda: Operator.LAND).refused(Interrupted, "nothing was started")


def waits(z_m: float = 0.0, waited_s: float = 0.0, age_s: float = 0.0, target: Any = None,
          **safety: float) -> str:  # fmt: skip
    profile = PROFILE.model_copy(update={"safety": PROFILE.safety.model_copy(update=safety)})
    sample = telemetry(1.0, z_m, thrust=0.0, supervisor=READY)
    return still_waiting_for(sample, True, None, waited_s, profile, target, age_s)


@pytest.mark.parametrize(
    ("age_s", "is_old"), [(0.02, False), (0.2, False), (0.5, True), (5.0, True)]
)
def test_old_telemetry_is_waited_for(age_s: float, is_old: bool) -> None:
    """It may have stopped while the camera was waited for: nothing is taken over on it."""
    assert ("old" in waits(age_s=age_s)) is is_old
    if is_old:
        with pytest.raises(TimedOut, match="old"):
            waits(waited_s=PROFILE.safety.estimator_wait_s + 0.1, age_s=age_s)


@pytest.mark.parametrize(("away_m", "tracked", "flies"), [
    (0.2, True, False), (0.2, False, True), (1.5, True, True),
])  # fmt: skip
def test_a_target_within_reach_is_refused(away_m: float, tracked: bool, flies: bool) -> None:
    gear_m = PROFILE.vehicle.gear_body_m[2]
    target = target_at(1.0, (0.0, 0.0, gear_m + away_m), (0.0, 0.0, 0.0), tracked=tracked)
    if flies:
        assert waits(target=target) == ""
        return
    with pytest.raises(SafetyAbort, match=r"target is only 0\.20 m away.*take it down"):
        waits(target=target)
