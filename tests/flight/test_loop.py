"""The flight loop: what it refuses before take-off, and that it lands first, whatever is wrong."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from perchctl.errors import Interrupted, InvalidValue, NotFound, SafetyAbort, TimedOut
from perchctl.mission import Operator, Outcome, Phase, Tick
from perchctl.vehicle import CRASHED, DECK_FAULT, FLYING, LOCKED, TUMBLED, Land, PositionSetpoint
from tests.helpers.loop_rig import PROFILE, Camera, Rig, SleepyClock, Vehicle, noise
from tests.helpers.mission import READY, changed

PERIOD_S = 1.0 / PROFILE.link.loop_hz


# --- Bad measurements ---------------------------------------------------------------------------


def test_telemetry_that_is_no_number_is_left_out() -> None:
    """Ten samples of NaN in the air: no jump, no command with NaN, the flight goes on."""
    nan = (math.nan, 0.0, 0.5)
    rig = Rig(
        Vehicle(lambda s: replace(s, position_m=nan) if 1.5 < s.t_s < 1.6 else s),
        operator=lambda: Operator.LAND if rig.link.now_s > 3.0 else Operator.NONE,
    )
    report = rig.fly()
    assert report.outcome is Outcome.OPERATOR
    assert all(math.isfinite(v) for t in rig.watcher.ticks for v in t.telemetry.position_m)
    ages = [t.telemetry_age_s for t in rig.watcher.ticks]
    assert 0.08 < max(ages) < 0.15


def test_telemetry_that_stays_away_lands() -> None:
    rig = Rig(Vehicle(lambda s: None if 1.5 < s.t_s < 4.0 else s))
    report = rig.fly()
    assert report.outcome is Outcome.SAFETY
    assert "no telemetry" in report.reason
    assert rig.link.said(Land)[0] == pytest.approx(1.5 + 1.0, abs=0.06)


def _measured(rig: Rig) -> list[Tick]:
    return [t for t in rig.watcher.ticks if t.output is not None]


def test_an_old_picture_is_no_measurement() -> None:
    """Pictures half a second late from a certain time on: none of them is used, and the
    camera counts as gone."""
    late_from_s = 2.0
    rig = Rig(
        camera=Camera(lambda f: replace(f, t_s=f.t_s - 0.5) if f.t_arrival_s > late_from_s else f)
    )
    report = rig.fly()
    assert max(t.t_s for t in _measured(rig)) <= late_from_s + 1e-9
    assert report.outcome is Outcome.SAFETY
    assert "late" in report.reason


def test_a_frozen_picture_is_no_measurement() -> None:
    """New frames with the same bytes: the receiver repeats an old picture."""
    frozen_from_s = 2.0
    still = noise(0)
    rig = Rig(
        camera=Camera(lambda f: replace(f, image=still) if f.t_arrival_s > frozen_from_s else f)
    )
    report = rig.fly()
    # The first of them is like any other picture.
    assert max(t.t_s for t in _measured(rig)) < frozen_from_s + 1.5 * PERIOD_S
    assert report.outcome is Outcome.SAFETY
    assert "stands still" in report.reason
    ages = [t.camera_age_s for t in rig.watcher.ticks]
    assert max(ages) > PROFILE.safety.camera_land_s


def test_a_camera_that_reports_a_failure_lands_with_its_words() -> None:
    rig = Rig()

    def unplug(tick: Tick) -> None:
        if tick.t_s > 2.0:
            rig.camera.told = "the plug was pulled"

    rig.watcher.on_tick = unplug
    report = rig.fly()
    assert report.outcome is Outcome.SAFETY
    assert "the plug was pulled" in report.reason


def test_a_recording_that_ends_in_flight_lands() -> None:
    rig = Rig(camera=Camera(live=False, frames=100))
    report = rig.fly()
    assert report.phase is Phase.LANDED
    assert report.outcome is Outcome.SAFETY
    assert "the scripted camera has ended" in report.reason


def test_a_lost_link_lands() -> None:
    rig = Rig()
    rig.link._dies_at_s = 2.0
    report = rig.fly()
    assert report.outcome is Outcome.SAFETY
    assert "the script ended the link" in report.reason
    assert rig.link.said(Land)[0] == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize("strict", [False, True])
def test_a_log_that_fails_lands_only_where_the_profile_wants_it(strict: bool) -> None:
    rig = Rig(
        profile=changed({"safety.land_on_log_error": strict}),
        operator=lambda: Operator.LAND if rig.link.now_s > 3.0 else Operator.NONE,
    )
    rig.watcher.problem = "the disk is full"
    report = rig.fly()
    assert report.outcome is (Outcome.SAFETY if strict else Outcome.OPERATOR)
    assert ("the disk is full" in report.reason) is strict


# --- Time ---------------------------------------------------------------------------------------


def test_a_suspended_computer_lands_and_does_not_catch_up() -> None:
    rig = Rig()
    rig.clock = SleepyClock(rig.link, at_s=2.5, for_s=30.0)
    report = rig.fly()
    assert report.outcome is Outcome.SAFETY
    times = np.array([t.t_s for t in rig.watcher.ticks])
    gap = int(np.argmax(np.diff(times)))
    assert times[gap + 1] - times[gap] > 29.0
    after = times[gap + 1 :]
    assert np.diff(after).min() > 0.5 * PERIOD_S  # no burst of stale turns
    assert rig.link.said(Land)[0] == times[gap + 1]  # at once
    first = rig.watcher.ticks[gap + 1]
    assert first.loop_late_s > 29.0
    assert not [t for t in rig.link.said(PositionSetpoint) if t > times[gap]]


def test_a_short_hiccup_is_one_late_turn() -> None:
    rig = Rig(operator=lambda: Operator.LAND if rig.link.now_s > 4.0 else Operator.NONE)
    rig.clock = SleepyClock(rig.link, at_s=2.5, for_s=0.1)
    report = rig.fly()
    assert report.outcome is Outcome.OPERATOR
    late = [t for t in rig.watcher.ticks if t.loop_late_s > 0.05]
    assert len(late) == 1
    times = [t.t_s for t in rig.watcher.ticks]
    assert np.diff(times).min() > 0.5 * PERIOD_S


def test_every_turn_is_told_once_and_phases_are_announced() -> None:
    rig = Rig(operator=lambda: Operator.LAND if rig.link.now_s > 2.0 else Operator.NONE)
    report = rig.fly()
    times = [t.t_s for t in rig.watcher.ticks]
    assert np.diff(times) == pytest.approx(PERIOD_S, abs=1e-6)
    assert tuple(rig.watcher.events) == report.history
    assert report.duration_s == pytest.approx(times[-1] - times[0])


# --- Before take-off ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"supervisor": READY | LOCKED}, "locked"),
        ({"supervisor": READY | CRASHED}, "crash"),
        ({"supervisor": READY | TUMBLED}, "upside down"),
        ({"supervisor": READY | DECK_FAULT}, "deck"),
        ({"supervisor": READY | FLYING}, "flying already"),
        ({"supervisor": READY | 1 << 13}, "unknown bits .0x200E"),
        ({"battery_v": 3.4}, r"3\.40 V.*3\.80 V.*charge"),
    ],
    ids=["locked", "crashed", "tumbled", "deck", "flying", "unknown", "battery"],
)
def test_a_vehicle_that_may_not_fly_is_refused(changes: dict[str, Any], words: str) -> None:
    rig = Rig(Vehicle(lambda sample: replace(sample, **changes)))
    rig.refused(SafetyAbort, words)
    assert rig.link.now_s < 0.1  # at once


@pytest.mark.parametrize(
    ("rig", "words", "limit_s"),
    [
        (lambda: Rig(Vehicle(lambda sample: None)), "telemetry", 10.0),
        (
            lambda: Rig(Vehicle(lambda sample: replace(sample, position_variance_m2=0.5))),
            r"variance 0\.5.*positioning",
            10.0,
        ),
        (lambda: Rig(Vehicle(lambda sample: replace(sample, supervisor=0x06))), "0x0006", 10.0),
        (lambda: Rig(camera=Camera(lambda frame: None)), "picture .none has come", 8.0),
        (
            lambda: Rig(camera=Camera(lambda frame: replace(frame, t_s=frame.t_s - 5.0))),
            "picture .*5.* s late",
            8.0,
        ),
    ],
    ids=["no telemetry", "unsettled estimate", "may not fly", "no picture", "old pictures"],
)
def test_what_does_not_come_in_time_is_refused(
    rig: Callable[[], Rig], words: str, limit_s: float
) -> None:
    it = rig()
    it.refused(TimedOut, words)
    assert limit_s < it.link.now_s < limit_s + 0.2


def test_an_estimate_that_settles_is_waited_for() -> None:
    rig = Rig(
        Vehicle(lambda s: replace(s, position_variance_m2=0.5 if s.t_s < 3.0 else 1e-4)),
        operator=lambda: Operator.LAND if rig.link.said(PositionSetpoint) else Operator.NONE,
    )
    rig.fly()
    assert 3.0 <= rig.link.said(PositionSetpoint)[0] < 3.2


def test_pictures_of_another_size_are_refused() -> None:
    Rig(camera=Camera(size_px=(320, 240))).refused(InvalidValue, "320x240.*64x48")


def test_a_recording_that_has_ended_is_refused() -> None:
    Rig(camera=Camera(live=False, frames=1)).refused(NotFound, "ended before take-off")


def test_ctrl_c_on_the_ground_starts_nothing() -> None:
    Rig(operator=lambda: Operator.LAND).refused(Interrupted, "nothing was started")
