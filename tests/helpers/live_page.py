"""What the tests of the displays share: a moment of a flight, asking the page, and its buttons."""

from __future__ import annotations

import http.client
import math
from dataclasses import replace
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from perchctl.display.serve import TOKEN_HEADER
from perchctl.mission import GearToTargetDistance, Observation, Outcome, Phase, Tick
from perchctl.mission.state import BatteryOutlook, HoverErrorAccumulator
from perchctl.vehicle import PositionSetpoint
from tests.helpers import log as synthetic
from tests.helpers.mission import HOVERING, state_with

CORNERS = np.array([[200.0, 150.0], [400.0, 150.0], [400.0, 350.0], [200.0, 350.0]])


def tick(
    t_s: float = 101.0, phase: str = "ALIGN", reason: str = "pose is steady", hold: str = "",
    entered_s: float = 99.75, e_m: tuple[float, ...] | None = (-0.123, 0.045, 1.234),
    e_yaw_rad: float = math.radians(-166.2), tracked: bool = True, battery_v: float = 3.714,
    battery: BatteryOutlook | None = None, output: Any = None,
    camera_age_s: float = 0.05, telemetry_age_s: float = 0.012,
    contact: GearToTargetDistance | None = None,
) -> Tick:  # fmt: skip
    """A moment of a flight."""
    seen = None
    if e_m is not None:
        seen = replace(
            synthetic.target(t_s, 1.0), e_m=np.array(e_m), e_yaw_rad=e_yaw_rad, tracked=tracked
        )
    state = state_with(
        phase=Phase(phase), entered_s=entered_s, reason=reason, hold_reason=hold, failed_attempts=1,
        takeoff_position_m=(0.0, 0.0, 0.1), battery=battery or BatteryOutlook(),
        gear_to_target_at_last_contact=contact,
    )  # fmt: skip
    sample = replace(synthetic.telemetry(t_s, 0.92), battery_v=battery_v, behind_s=telemetry_age_s)
    command = PositionSetpoint(1.0, 2.0, 0.5, 0.0)
    obs = Observation(
        t_s, sample, seen, last_good_frame_age_s=camera_age_s, tick_start_delay_s=0.001
    )
    turn = synthetic.flown_turn(obs, command)
    return Tick(record=turn, state=state, output=output)


def hover_tick(phase: str = "HOVER", outcome: Outcome | None = None) -> Tick:
    """A moment of a mission that hovers, after two frames: 3 mm ahead, 4 mm low, turned by 0.1."""
    errors = HoverErrorAccumulator(100.0)
    for t_s in (100.5, 101.0):
        errors = errors.with_error(t_s, (0.003, 0.0, 0.004), 0.1)
    told = tick(phase=phase, reason="steady 1.17 m below the target")
    belief = replace(told.state.belief, profile=HOVERING)
    return replace(
        told, state=replace(told.state, belief=belief, hover_errors=errors, outcome=outcome)
    )


def ask(
    url: str, path: str = "/", method: str = "GET", **headers: str
) -> tuple[int, bytes, dict[str, str]]:
    """Status, body and headers; `_` in a header's name stands for `-`."""
    connection = http.client.HTTPConnection("127.0.0.1", urlsplit(url).port or 0, timeout=5.0)
    try:
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request(method, path, headers=named)
        answer = connection.getresponse()
        return answer.status, answer.read(), dict(answer.getheaders())
    finally:
        connection.close()


def press(url: str, token: str, button: str = "land", **headers: str) -> int:
    """The status that a button, ``land`` or ``cut``, is answered with."""
    return ask(url, f"/{button}", "POST", **{TOKEN_HEADER: token}, **headers)[0]
