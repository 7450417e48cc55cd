"""A lift by hand shows in the position; a vehicle that dies meanwhile fails a row.

In lockstep with a simulated vehicle.
"""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.check import CheckScope, Row, Verdict, session, vehicle
from perchctl.check.row import Finding
from perchctl.check.vehicle import Vehicle
from perchctl.sim import Scenario, SimulatedVehicle
from perchctl.vehicle import Telemetry
from tests.helpers.checks import AT_REST, NOWHERE, PROFILE, said


class Lockstep:
    """A `ProbeLink`'s questions put to a simulated vehicle, whose time passes by `wait`."""

    def __init__(self, **scenario: Any) -> None:
        self.vehicle = SimulatedVehicle(Scenario(**scenario))
        self.wait(1.5)
        self.heard_s = self.vehicle.t_s

    def wait(self, seconds: float) -> None:
        self.vehicle.advance_to(self.vehicle.t_s + seconds)
        self.heard_s = self.vehicle.t_s

    def newest(self) -> Telemetry:
        log = self.vehicle.firmware.log_value
        return replace(
            AT_REST, t_s=self.vehicle.t_s, acc_z_g=log("acc.z"),
            position_m=(0.0, 0.0, log("stateEstimate.z")),
            roll_rad=math.radians(log("stateEstimate.roll")),
            supervisor=int(log("supervisor.info")),
        )  # fmt: skip

    def telemetry(self) -> list[Telemetry]:
        return [self.newest()]

    def age_s(self) -> float:
        return self.vehicle.t_s - self.heard_s

    def lost(self) -> str | None:
        return None


def rows_with_a_lift(rig: Lockstep, dies: str, patch: pytest.MonkeyPatch) -> dict[str, Row]:
    """The vehicle's rows; `dies`: how it dies as it is to be lifted, empty if it does not."""

    def tell(text: str) -> None:
        if vehicle.HOW_TO_LIFT in text and dies:
            rig.lost = lambda: dies if dies == "switched off" else None  # type: ignore[method-assign]
            rig.age_s = lambda: 1.6  # type: ignore[method-assign]

    patch.setattr(vehicle, "look", lambda *_: Vehicle(NOWHERE, telemetry=AT_REST))
    patch.setattr(session, "time", SimpleNamespace(sleep=rig.wait))
    wanted = CheckScope(lift=True, lift_s=0.5, tell=tell)
    it = session.VehicleSession(rig, NOWHERE, PROFILE, None, wanted)  # type: ignore[arg-type]
    return {row.name: row for row in it.answering_rows()}


@pytest.mark.parametrize("dies", ["switched off", "no telemetry came for 1.6 s", ""])
def test_a_vehicle_that_dies_by_the_hand_fails_a_row(
    dies: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = rows_with_a_lift(Lockstep(), dies, monkeypatch)
    assert (vehicle.GONE in rows) == bool(dies)
    if dies:
        assert rows[vehicle.GONE].verdict is Verdict.FAIL
        assert dies in rows[vehicle.GONE].found


def a_hand(rig: Lockstep, to_m: float, moves_g: float = 0.0) -> Finding:
    """Lifts it after a second, and puts it back."""
    before = rig.wait
    at = [0.0]

    def wait(seconds: float) -> None:
        at[0] += seconds
        z_m = 0.012 + (to_m if 1.0 < at[0] < 2.0 else 0.0)
        rig.vehicle.world.set_pose((0.0, 0.0, z_m), hold=True)
        before(seconds)

    seen = vehicle.watch_lift(rig, wait, 3.0)  # type: ignore[arg-type]
    seen[len(seen) // 2] = replace(seen[len(seen) // 2], acc_z_g=1.0 + moves_g)
    return vehicle.lift_finding(seen)


def test_a_lift_by_hand_shows_in_the_position() -> None:
    assert a_hand(Lockstep(), 0.4, 0.2).verdict is Verdict.PASS


def test_a_vehicle_that_was_not_lifted_is_not_known() -> None:
    row = a_hand(Lockstep(), 0.0)
    assert row.verdict is Verdict.SKIPPED
    assert "not moved" in row.found


def test_a_position_that_stays_where_it_is_fails() -> None:
    assert a_hand(Lockstep(), 0.0, 0.3).verdict is Verdict.FAIL


def test_a_position_that_does_not_come_back_is_told() -> None:
    heights_m = (0.0, 0.4, 0.25)
    seen = [said(position_m=(0.0, 0.0, z_m), acc_z_g=1.0 + z_m) for z_m in heights_m]
    assert vehicle.lift_finding(seen).verdict is Verdict.WARN
    assert vehicle.lift_finding([]).verdict is Verdict.SKIPPED
