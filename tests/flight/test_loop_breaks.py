"""Something breaks in the air: the flight loop lands first, and a rescue is bounded."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from perchctl.flight import loop
from perchctl.mission import Finding, Operator, Phase, Tick
from perchctl.mission.lander import LEAST_ORDERS, MAX_ORDERS, PEEL_S
from perchctl.perception import perception
from perchctl.profile import Profile
from perchctl.vehicle import (
    HL_ACTIVE,
    EmergencyStop,
    Land,
    PositionSetpoint,
    RawThrust,
    StopMotors,
)
from tests.helpers.loop_rig import PROFILE, Broken, Camera, Rig, Vehicle, Watcher
from tests.helpers.mission import AIRBORNE, HOVER_THRUST, telemetry


def _break(*_: Any, **__: Any) -> Any:
    raise Broken("by the test")


def _later(real: Callable[..., Any], calls: int) -> Callable[..., Any]:
    """As the real one, until the given number of calls."""
    left = [calls]

    def step(*arguments: Any) -> Any:
        left[0] -= 1
        return real(*arguments) if left[0] >= 0 else _break()

    return step


def landed_after_a_break(rig: Rig) -> None:
    with pytest.raises(Broken):
        rig.fly()
    assert rig.link.said(PositionSetpoint)
    orders_s = rig.link.said(Land)
    assert 1 <= len(orders_s) <= MAX_ORDERS
    assert orders_s[0] >= rig.link.said(PositionSetpoint)[0]
    land = next(c for _, c in rig.link.sent if isinstance(c, Land))
    assert land.height_m < 0.0
    assert land.duration_s >= 1.0
    assert rig.link.z_m == 0.0  # it was waited for
    assert not rig.link.motors


AIRBORNE_TICKS = 60


def test_a_failure_in_vision_lands_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(perception, "step", _later(perception.step, AIRBORNE_TICKS))
    landed_after_a_break(Rig())


def test_a_failure_in_the_planner_lands_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "step_mission", _later(loop.step_mission, AIRBORNE_TICKS))
    landed_after_a_break(Rig())


def test_a_failure_of_a_watcher_lands_first() -> None:
    rig = Rig()
    rig.watcher.on_tick = lambda tick: _break() if tick.t_s > 1.2 else None
    landed_after_a_break(rig)


def test_a_failure_of_the_camera_lands_first() -> None:
    rig = Rig()
    rig.camera.alter = lambda frame: _break() if frame.t_arrival_s > 1.2 else frame
    landed_after_a_break(rig)


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit])
def test_even_an_exit_lands_first(error: type[BaseException]) -> None:
    def leave(tick: Tick) -> None:
        if tick.t_s > 1.2:
            raise error

    rig = Rig(watcher=Watcher(leave))
    with pytest.raises(error):
        rig.fly()
    assert rig.link.said(Land)
    assert rig.link.z_m == 0.0


def test_a_failure_on_the_ground_starts_nothing() -> None:
    rig = Rig(camera=Camera(_break))
    with pytest.raises(Broken):
        rig.fly()
    assert rig.link.sent == []


@pytest.mark.parametrize("after_s", [0.0, 0.02, 0.1])
def test_a_failure_right_after_the_take_off_order_lands(after_s: float) -> None:
    """The order does not show in the telemetry yet, and a vehicle in high-level flight would
    hover for ever (docs/firmware.md, "When setpoints stop")."""
    rig = Rig(Vehicle(delay_s=0.15))

    def leave(tick: Tick) -> None:
        orders = rig.link.said(PositionSetpoint)
        if orders and tick.t_s >= orders[0] + after_s - 1e-9:
            raise Broken

    rig.watcher.on_tick = leave
    landed_after_a_break(rig)


def test_a_failure_while_hanging_with_the_motors_off_starts_nothing() -> None:
    """The flying bit outlives the motors by two seconds."""
    hanging = Vehicle(lambda s: replace(s, supervisor=AIRBORNE, thrust=0.0))
    hanging.advance_to(1.0)
    rig = Rig(hanging)
    rig.rescue(telemetry(1.0, 2.0, thrust=0.0))
    assert {type(command) for _, command in rig.link.sent} <= {StopMotors}


AT_CEILING = {"phase": Phase.PERCH, "contact_z_m": 2.0}


def test_a_rescue_at_the_ceiling_peels_off_first() -> None:
    """The vehicle's own landing would run by its clock and end up there, motors off."""
    pressed = Vehicle()
    pressed.z_m, pressed.motors = 2.0, True
    rig = Rig(pressed)
    assert rig.rescue(telemetry(0.0, 2.0), **AT_CEILING).finding is Finding.STANDS
    first = rig.link.sent[0][1]
    assert isinstance(first, PositionSetpoint)
    assert first.z_m <= 2.0
    assert rig.link.said(Land)[0] > rig.link.said(PositionSetpoint)[-1]
    assert rig.link.z_m == 0.0


def test_a_rescue_of_what_does_not_peel_off_puts_the_weight_on_the_magnet() -> None:
    """A landing ordered to what the magnet holds would drop it when its trajectory ends."""
    stuck = Vehicle(lambda s: replace(s, position_m=(0.0, 0.0, 2.0)))
    stuck.z_m, stuck.motors = 2.0, True
    rig = Rig(stuck)
    rig.rescue(telemetry(0.0, 2.0), **AT_CEILING)
    assert not rig.link.said(Land)
    assert PEEL_S <= rig.link.said(RawThrust)[0] < PEEL_S + 0.2


def test_the_rescue_is_bounded() -> None:
    """A vehicle that never says it has landed is not waited for for ever."""
    rig = Rig(Vehicle(lambda s: replace(s, supervisor=AIRBORNE | HL_ACTIVE)))
    rig.rescue(telemetry(0.0))
    assert rig.link.now_s == pytest.approx(PROFILE.planner.landing.timeout_s, abs=0.2)
    assert len(rig.link.said(Land)) == LEAST_ORDERS


def test_the_rescue_orders_again_what_shows_no_effect() -> None:
    deaf = Vehicle(lambda s: replace(s, supervisor=AIRBORNE, thrust=HOVER_THRUST))
    deaf.z_m = 0.2
    rig = Rig(deaf)
    rig.rescue(telemetry(0.0, 0.2))
    assert np.diff(rig.link.said(Land)).min() > 0.3
    assert len(rig.link.said(Land)) == MAX_ORDERS


def orders(rig: Rig) -> list[Land]:
    return [command for _, command in rig.link.sent if isinstance(command, Land)]


def test_a_rescue_lands_on_the_ground_that_it_started_from() -> None:
    """On a table its own landing would else end below it, or over the floor far above."""
    aims = []
    for ground_z_m in (-1.0, 0.0, 0.75):
        rig = Rig(Vehicle(lambda s: None))  # silent: its own landing at once
        rig.rescue(telemetry(-1.0, 1.5), ground_m=(0.0, 0.0, ground_z_m))
        aims.append(orders(rig)[0].height_m - ground_z_m)
    assert aims == pytest.approx([aims[0]] * 3)
    assert -1.0 < aims[0] <= 0.0


def test_a_rescue_without_positions_from_outside_comes_down_level() -> None:
    still = Vehicle(lambda s: replace(s, supervisor=AIRBORNE, thrust=HOVER_THRUST))
    rig = Rig(still, profile=Profile.model_validate({"positioning": "mocap"}))
    rig.rescue(telemetry(0.0, 1.5), 2.0, started_s=0.0)
    assert rig.link.said(RawThrust)
    assert not orders(rig)


def test_a_rescue_steers_by_no_number_that_is_none() -> None:
    rig = Rig(Vehicle(lambda s: replace(s, position_m=(math.nan,) * 3, supervisor=AIRBORNE)))
    rig.rescue(telemetry(0.0, 2.0), **AT_CEILING)
    places = [c.z_m for _, c in rig.link.sent if isinstance(c, PositionSetpoint)]
    assert places
    assert all(z_m <= 2.0 for z_m in places)


def test_a_rescue_without_telemetry_still_orders_the_landing() -> None:
    rig = Rig(Vehicle(lambda s: None))
    rig.rescue(telemetry(-1.0))
    assert rig.link.said(Land)


def test_ctrl_c_twice_stops_a_rescue_too() -> None:
    rig = Rig(
        Vehicle(lambda s: replace(s, supervisor=AIRBORNE | HL_ACTIVE)),
        operator=lambda: Operator.STOP if rig.link.now_s > 0.5 else Operator.NONE,
    )
    rig.rescue(telemetry(0.0))
    assert rig.link.said(EmergencyStop)[0] == pytest.approx(0.5, abs=0.05)
    assert rig.link.now_s < 1.0
