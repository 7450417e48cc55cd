"""What harder worlds draw beyond `perchctl.sim.draw`: each group from a random stream of its own,
so that no other value of a seed moves."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from perchctl.profile import SimulationConfig
from perchctl.sim.scenario import Gust

_STREAM = 21
_AIR, _CELL, _TILT, _LAMP, _FLOW, _FLOOR, _RADIO, _CAPTURE = range(8)
_LONGEST_S = 240.0
"""No simulated flight lasts longer."""
_GUST_S = (0.5, 2.0)
_GUST_UPWARD = 0.3
_LEAST_GAP_S = 1.0


def beyond(sim: SimulationConfig, seed: int, target_xy_m: tuple[float, float]) -> dict[str, Any]:
    """Fields of the scenario. Where the ranges are those of the nominal world, its defaults."""
    return {
        **_air(sim, _Draws(seed, _AIR)),
        **_cell(sim, _Draws(seed, _CELL)),
        **_tilt(sim, _Draws(seed, _TILT)),
        **_lamp(sim, _Draws(seed, _LAMP), target_xy_m),
        **_flow(sim, _Draws(seed, _FLOW)),
        **_floor(sim, _Draws(seed, _FLOOR), target_xy_m),
        **_radio(sim, _Draws(seed, _RADIO)),
        **_capture(sim, _Draws(seed, _CAPTURE)),
    }


class _Draws:
    """One group's random numbers."""

    def __init__(self, seed: int, group: int) -> None:
        self.rng = np.random.default_rng([seed, _STREAM, group])

    def between(self, bounds: tuple[float, float]) -> float:
        return float(self.rng.uniform(*bounds))

    def angle_rad(self, bounds_deg: tuple[float, float] = (-180.0, 180.0)) -> float:
        return math.radians(self.between(bounds_deg))

    def around(self, xy_m: tuple[float, float], aside_m: float) -> tuple[float, float]:
        """A point so far from another one."""
        angle = self.angle_rad()
        return (xy_m[0] + aside_m * math.cos(angle), xy_m[1] + aside_m * math.sin(angle))


def _air(sim: SimulationConfig, draws: _Draws) -> dict[str, Any]:
    fields: dict[str, Any] = {"ceiling_suction": draws.between(sim.ceiling_suction)}
    if not sim.gust_mps[1]:
        return fields
    gusts, t_s = [], 0.0
    while (t_s := t_s + float(draws.rng.exponential(sim.gust_every_s))) < _LONGEST_S:
        angle, upward = draws.angle_rad(), _GUST_UPWARD * float(draws.rng.uniform(-1.0, 1.0))
        peak_mps, length_s = draws.between(sim.gust_mps), draws.between(_GUST_S)
        level_mps = peak_mps * math.sqrt(1.0 - upward**2)
        peak = (level_mps * math.cos(angle), level_mps * math.sin(angle), peak_mps * upward)
        gusts.append(Gust(t_s, length_s, peak))
    return fields | {"gusts": tuple(gusts)}


def _cell(sim: SimulationConfig, draws: _Draws) -> dict[str, Any]:
    ohm = None
    if sim.cell_resistance_ohm is not None:
        ohm = draws.between(sim.cell_resistance_ohm)
    return {
        "cell_resistance_ohm": ohm,
        "cell_slow_ohm": draws.between(sim.cell_slow_ohm),
        "cell_charge": draws.between(sim.cell_charge),
        "cell_knee": draws.between(sim.cell_knee),
    }


def _tilt(sim: SimulationConfig, draws: _Draws) -> dict[str, Any]:
    tilt_rad = draws.angle_rad(sim.target_tilt_deg)
    towards_rad = draws.angle_rad(sim.target_tilt_towards_deg)
    if not tilt_rad:
        return {}
    # Lifted on the side of +x is a turn about -y, on that of +y one about x.
    about = (tilt_rad * math.sin(towards_rad), -tilt_rad * math.cos(towards_rad))
    return {"target_tilt_rad": about}


def _lamp(sim: SimulationConfig, draws: _Draws, target_xy_m: tuple[float, float]) -> dict[str, Any]:
    gloss, aside_m, z_m = map(draws.between, (sim.gloss, sim.lamp_aside_m, sim.lamp_z_m))
    if not gloss:
        return {}
    return {"gloss": gloss, "lamp_m": (*draws.around(target_xy_m, aside_m), z_m)}


def _flow(sim: SimulationConfig, draws: _Draws) -> dict[str, Any]:
    noise, bias = draws.between(sim.flow_noise_radps), draws.angle_rad(sim.flow_bias_dps)
    fields: dict[str, Any] = {"flow_noise_radps": noise, "flow_reach_m": sim.flow_reach_m}
    angle = draws.angle_rad()
    if bias:
        fields["flow_bias_radps"] = (bias * math.cos(angle), bias * math.sin(angle))
    return fields


def _floor(
    sim: SimulationConfig, draws: _Draws, target_xy_m: tuple[float, float]
) -> dict[str, Any]:
    radius_m, aside_m = draws.between(sim.bare_floor_m), draws.between(sim.bare_floor_aside_m)
    if not radius_m:
        return {}
    return {"bare_floors": ((*draws.around(target_xy_m, aside_m), radius_m),)}


def _radio(sim: SimulationConfig, draws: _Draws) -> dict[str, Any]:
    loss, burst_s = draws.between(sim.radio_loss), draws.between(sim.radio_burst_s)
    return {"radio_loss": loss, "radio_burst_s": burst_s}


def _capture(sim: SimulationConfig, draws: _Draws) -> dict[str, Any]:
    if not sim.capture_hole_s[1]:
        return {}
    holes, t_s = [], 0.0
    while (t_s := t_s + float(draws.rng.exponential(sim.capture_hole_every_s))) < _LONGEST_S:
        length_s = draws.between(sim.capture_hole_s)
        holes.append((t_s, length_s))
        t_s += length_s + _LEAST_GAP_S
    return {"capture_holes_s": tuple(holes)}
