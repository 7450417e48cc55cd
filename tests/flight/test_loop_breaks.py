"""Something breaks or hangs in the air: the flight loop lands first, a rescue is bounded, and what
could not be confirmed is said."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from perchctl.flight import loop
from perchctl.flight.watchdog import CUT_PERIOD_S
from perchctl.mission import EventKind, OperatorRequest, Outcome, Phase, RestState, Tick
from perchctl.mission.descent import (
    MAX_LANDING_COMMAND_COUNT,
    MIN_LANDING_COMMANDS_BEFORE_CONFIRMATION_BY_TELEMETRY,
)
from perchctl.perception import perception
from perchctl.profile import Profile
from perchctl.vehicle import HL_ACTIVE, EmergencyStop, Land, PositionSetpoint, RawThrust, StopMotors
from tests.helpers.loop_rig import (
    HANG_AT_S,
    PROFILE,
    SOON_GIVEN_UP,
    Broken,
    Camera,
    Guarded,
    Rig,
    Vehicle,
    Watcher,
    hung_rig,
)
from tests.helpers.mission import AIRBORNE, HOVER_THRUST, telemetry

BREAKS_S = 1.2
AIRBORNE_TICKS = 60


def _break(*_: Any, **__: Any) -> Any:
    raise Broken("by the test")


def breaks_at(t_s: float, error: type[BaseException] = Broken) -> Watcher:
    """A watcher that raises from then on."""

    def leave(tick: Tick) -> None:
        if tick.t_s > t_s:
            raise error("by the test")

    return Watcher(leave)


def landed_after_a_break(rig: Rig, error: type[BaseException] = Broken) -> None:
    with pytest.raises(error):
        rig.fly()
    assert rig.link.said(PositionSetpoint)
    orders_s = rig.link.said(Land)
    assert 1 <= len(orders_s) <= MAX_LANDING_COMMAND_COUNT
    assert orders_s[0] >= rig.link.said(PositionSetpoint)[0]
    land = orders(rig)[0]
    assert land.height_m < 0.0
    assert land.duration_s >= 1.0
    assert rig.link.z_m == 0.0  # it was waited for
    assert not rig.link.motors


def orders(rig: Rig) -> list[Land]:
    return [command for _, command in rig.link.sent if isinstance(command, Land)]


# --- An error ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("module", "name"), [(perception, "step"), (loop, "step_mission")])
def test_a_failure_in_vision_or_in_the_planner_lands_first(
    monkeypatch: pytest.MonkeyPatch, module: Any, name: str
) -> None:
    real, left = getattr(module, name), [AIRBORNE_TICKS]

    def step(*arguments: Any) -> Any:
        left[0] -= 1
        return real(*arguments) if left[0] >= 0 else _break()

    monkeypatch.setattr(module, name, step)
    landed_after_a_break(Rig())


@pytest.mark.parametrize("error", [Broken, KeyboardInterrupt, SystemExit])
def test_a_failure_of_a_watcher_and_even_an_exit_lands_first(error: type[BaseException]) -> None:
    landed_after_a_break(Rig(watcher=breaks_at(BREAKS_S, error)), error)


def test_a_failure_of_the_camera_lands_first_and_on_the_ground_starts_nothing() -> None:
    landed_after_a_break(Rig(camera=Camera(lambda f: _break() if f.t_arrival_s > BREAKS_S else f)))
    rig = Rig(camera=Camera(_break))
    with pytest.raises(Broken):
        rig.fly()
    assert rig.link.sent == []


def test_a_link_that_raises_when_it_is_asked_is_landed_all_the_same() -> None:
    rig = Rig()
    usual = rig.link.problem

    def fails(now_s: float) -> str | None:
        return _break() if now_s > BREAKS_S else usual(now_s)

    rig.link.problem = fails  # type: ignore[method-assign]
    landed_after_a_break(rig)


@pytest.mark.parametrize(
    "after_s",
    [0.0, pytest.param(0.02, marks=pytest.mark.long), pytest.param(0.1, marks=pytest.mark.long)],
)
def test_a_failure_right_after_the_take_off_order_lands(after_s: float) -> None:
    """The order does not show in the telemetry yet, and a vehicle in high-level flight would
    hover for ever (docs/firmware.md, "When setpoints stop")."""
    rig = Rig(Vehicle(delay_s=0.15))

    def leave(tick: Tick) -> None:
        ordered = rig.link.said(PositionSetpoint)
        if ordered and tick.t_s >= ordered[0] + after_s - 1e-9:
            raise Broken

    rig.watcher.on_tick = leave
    landed_after_a_break(rig)


@pytest.mark.parametrize("heard", [True, False])
def test_after_an_error_it_is_said_whether_the_landing_was_seen(heard: bool) -> None:
    link = Guarded(lambda s: s if heard or s.t_s < 1.5 else None)
    rig = Rig(link, watcher=breaks_at(1.5), profile=SOON_GIVEN_UP)
    with pytest.raises(Broken):
        rig.fly()
    assert link.own == []  # no setpoint that would take the landing back
    said = rig.watcher.events[-1]
    assert said.kind is EventKind.NOTE
    assert (said.rest_state is RestState.END_UNCONFIRMED) is not heard
    assert "Broken in flight" in said.reason
    assert ("motors off" in said.reason) is heard
    assert ("could not be confirmed" in said.reason) is not heard


# --- The rescue -------------------------------------------------------------------------------


def rescuing(z_m: float = 0.0, **changes: Any) -> Rig:
    """A vehicle in the air whose telemetry is changed."""
    link = Vehicle(lambda s: replace(s, **changes))
    link.z_m, link.motors = z_m, True
    return Rig(link)


def test_while_hanging_with_the_motors_off_it_starts_nothing() -> None:
    """The flying bit outlives the motors by two seconds."""
    rig = rescuing(supervisor=AIRBORNE, thrust=0.0)
    rig.link.motors = False
    rig.link.advance_to(1.0)
    rig.rescue(telemetry(1.0, 2.0, thrust=0.0))
    assert {type(command) for _, command in rig.link.sent} <= {StopMotors}


def test_it_is_bounded() -> None:
    """A vehicle that never says it has landed is not waited for for ever."""
    rig = rescuing(supervisor=AIRBORNE | HL_ACTIVE)
    rig.link.motors = False
    rig.rescue(telemetry(0.0))
    assert rig.link.now_s == pytest.approx(PROFILE.planner.landing.timeout_s, abs=0.2)
    assert len(rig.link.said(Land)) == MIN_LANDING_COMMANDS_BEFORE_CONFIRMATION_BY_TELEMETRY


def test_it_lands_on_the_ground_that_it_started_from_even_without_telemetry() -> None:
    """On a table its own landing would else end below it, or over the floor far above."""
    aims = []
    for ground_z_m in (-1.0, 0.0, 0.75):
        rig = Rig(Vehicle(lambda s: None))  # silent: its own landing at once
        rig.rescue(telemetry(-1.0, 1.5), takeoff_position_m=(0.0, 0.0, ground_z_m))
        aims.append(orders(rig)[0].height_m - ground_z_m)
    assert aims == pytest.approx([aims[0]] * 3)
    assert -1.0 < aims[0] <= 0.0


def test_without_positions_from_outside_it_comes_down_level() -> None:
    rig = rescuing(supervisor=AIRBORNE, thrust=HOVER_THRUST)
    rig.profile = Profile.model_validate({"positioning": "mocap"})
    rig.rescue(telemetry(0.0, 1.5), 2.0, flight_started_at_s=0.0)
    assert rig.link.said(RawThrust)
    assert not orders(rig)


def test_ctrl_c_twice_stops_it_too() -> None:
    rig = rescuing(supervisor=AIRBORNE | HL_ACTIVE)
    rig.operator = lambda: (
        OperatorRequest.CUT_MOTORS if rig.link.now_s > 0.5 else OperatorRequest.NONE
    )
    rig.rescue(telemetry(0.0))
    assert rig.link.said(EmergencyStop)[0] == pytest.approx(0.5, abs=0.05)
    assert rig.link.now_s < 1.0


def test_the_operators_stop_in_it_is_repeated() -> None:
    """Until the vehicle says that it is locked, and also while the link is closing."""
    link = Guarded()
    rig = Rig(link, watcher=breaks_at(1.5))
    rig.operator = lambda: OperatorRequest.CUT_MOTORS if link.now_s > 1.8 else OperatorRequest.NONE
    with pytest.raises(Broken):
        rig.fly()
    ended_s = link.now_s
    link.advance_to(ended_s + 1.0)
    cuts = [t for t in link.said(EmergencyStop) if t > ended_s + 0.01]
    assert len(cuts) == pytest.approx(1.0 / CUT_PERIOD_S, abs=1)


# --- A loop that hangs --------------------------------------------------------------------------


def after_the_hang(rig: Rig) -> Tick:
    return next(t for t in rig.watcher.ticks if t.t_s > HANG_AT_S + 0.1)


def landed_s(link: Guarded) -> float:
    """When the watchdog ordered the landing; nothing stale follows."""
    at_s = next(t for t, c in link.own if isinstance(c, Land))
    assert not [t for t in link.said(PositionSetpoint) if t > at_s]
    return at_s


def test_a_loop_that_hangs_in_the_camera_is_landed_and_goes_on_landing() -> None:
    rig, link = hung_rig(5.0)
    report = rig.fly()
    held = [t for t, c in link.own if isinstance(c, PositionSetpoint)]
    assert held[0] == pytest.approx(HANG_AT_S + 0.3, abs=0.08)
    assert np.diff(held).max() < 0.06  # at about 20 Hz
    assert landed_s(link) == pytest.approx(HANG_AT_S + 1.0, abs=0.08)
    first = after_the_hang(rig)
    assert first.state.phase is Phase.LANDING
    assert first.tick_start_delay_s > 4.9
    assert report.outcome is Outcome.SAFETY
    assert "the control loop was 5.0 s late" in report.reason


def test_a_hang_of_half_a_second_is_held_and_the_flight_goes_on_with_what_is_new() -> None:
    rig, link = hung_rig(0.6)
    report = rig.fly()
    assert link.own
    assert not [c for _, c in link.own if isinstance(c, Land)]
    first = after_the_hang(rig)
    assert first.t_s == pytest.approx(HANG_AT_S + 0.62, abs=0.05)  # not the time before it
    assert first.telemetry_age_s < 0.05
    assert "late" in first.state.hold_reason
    assert report.outcome is Outcome.ENDED_BY_OPERATOR


def test_what_was_decided_before_a_hang_is_not_sent_after_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig, link = hung_rig(0.0)
    real, stale = loop.step_mission, []

    def step(*arguments: Any) -> Any:
        new, command = real(*arguments)
        if not stale and link.now_s > HANG_AT_S:
            stale.append(command := replace(command, z_m=9.9))  # to be known again
            link.advance_to(link.now_s + 0.6)
        return new, command

    monkeypatch.setattr(loop, "step_mission", step)
    rig.fly()
    assert stale
    assert stale[0] not in [c for _, c in link.sent]


def test_a_landing_ordered_while_the_planner_thinks_is_not_taken_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The loop is 0.99 s late when its turn begins, and 1.01 s when it would send."""
    rig, link = hung_rig(0.97)
    real, slow = loop.step_mission, []

    def step(state: Any, obs: Any, *more: Any) -> Any:
        if not slow and obs.tick_start_delay_s > 0.5:
            slow.append(obs.tick_start_delay_s)
            link.advance_to(link.now_s + 0.1)
        return real(state, obs, *more)

    monkeypatch.setattr(loop, "step_mission", step)
    report = rig.fly()
    assert slow
    assert slow[0] < PROFILE.safety.loop_late_land_s
    assert landed_s(link)
    assert "late" in report.reason


# --- The end that nobody saw ------------------------------------------------------------------


@pytest.mark.parametrize(("changed", "words"), [
    (lambda s: None if s.t_s > 2.0 else s,
     ["the newest telemetry is 1.0 s old", "not confirmed in time: the newest telemetry is"]),
    pytest.param(lambda s: replace(s, thrust=50000.0), ["not confirmed in time: telemetry"],
                 marks=pytest.mark.long),
], ids=["silent", "flies on"])  # fmt: skip
def test_a_landing_that_nobody_saw_is_no_landing(
    changed: Callable[..., Any], words: list[str]
) -> None:
    rig = Rig(Vehicle(changed), profile=SOON_GIVEN_UP)
    if len(words) == 1:
        rig.operator = lambda: (
            OperatorRequest.LAND if rig.link.now_s > 2.0 else OperatorRequest.NONE
        )
    report = rig.fly()
    assert report.phase is Phase.ABORTED
    assert report.outcome is Outcome.SAFETY
    assert all(each in report.reason for each in words)
    assert "motors off" not in report.reason
