"""What a flight took out of its battery, by the flight's own model, read off its log."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from perchctl.geometry import Array
from perchctl.log import FlightLog
from perchctl.mission import (
    BatteryFit,
    EnergyState,
    charge_at,
    fit_battery,
    update_energy,
    used_mah,
)
from perchctl.vehicle import NO_BATTERY_READING_V

USUAL_MAH = 250.0
"""Of the battery that a Crazyflie comes with, where a log's profile does not say."""
LONGEST_STEP_S = 1.0
"""A longer gap between two ticks is the log's, and not counted as flown."""


@dataclass(frozen=True)
class PhaseEnergy:
    """Of all stays in a phase together. `lowest_v` is NaN without a reading."""

    phase: str
    duration_s: float
    used_mah: float
    mean_thrust: float
    lowest_v: float


@dataclass(frozen=True, eq=False)
class EnergyHistory:
    """Voltages as they were read, charge by the count of the thrust.

    Attributes:
        battery_mah: what the charge is counted against; `assumed` where no profile says it.
        rest_v: (n,) the estimated resting voltage over the ticks, NaN where there is none.
        start_v, end_v, lowest_v: first, last and lowest reading; NaN without any.
        fit: how much the voltage falls under full thrust, and how much faster than assumed the
            battery empties; None where it was never under load.
        left: estimated share of the charge at the end; None where nothing tells it.
    """

    battery_mah: float
    assumed: bool
    phases: tuple[PhaseEnergy, ...]
    rest_v: Array
    start_v: float
    end_v: float
    lowest_v: float
    fit: BatteryFit | None
    left: float | None

    @property
    def used_mah(self) -> float:
        return sum(phase.used_mah for phase in self.phases)

    @property
    def duration_s(self) -> float:
        return sum(phase.duration_s for phase in self.phases)


def energy_history(log: FlightLog) -> EnergyHistory:
    """Fits the model to the whole flight; a log without ticks gives one without phases."""
    battery_mah, assumed = _battery_mah(log.header)
    t_s, volts = log.column("t_s"), log.column("battery_v")
    thrust = np.nan_to_num(log.column("thrust"))
    state, before_mah = EnergyState(), 0.0
    rest_v = np.full(t_s.shape, np.nan)
    spent: dict[str, list[int]] = {}
    step_s, step_mah = np.zeros(t_s.shape), np.zeros(t_s.shape)
    for i, record in enumerate(log.records):
        after_s = float(t_s[i + 1] - t_s[i]) if i + 1 < t_s.size else 0.0
        step_s[i] = min(max(after_s, 0.0), LONGEST_STEP_S)
        state = update_energy(
            state, float(step_s[i]), float(volts[i]), float(thrust[i]), battery_mah
        )
        now_mah = used_mah(state, battery_mah)
        step_mah[i], before_mah = now_mah - before_mah, now_mah
        rest_v[i] = math.nan if state.rest_v is None else state.rest_v
        spent.setdefault(str(record.get("phase") or ""), []).append(i)
    known = volts[volts >= NO_BATTERY_READING_V]
    loaded = state.loaded_s > 0
    return EnergyHistory(
        battery_mah,
        assumed,
        tuple(_phase(name, at, step_s, step_mah, thrust, volts) for name, at in spent.items()),
        rest_v,
        float(known[0]) if known.size else math.nan,
        float(known[-1]) if known.size else math.nan,
        float(known.min()) if known.size else math.nan,
        fit_battery(state) if loaded else None,
        charge_at(state.rest_v) if loaded and state.rest_v is not None else None,
    )


def _phase(
    name: str, at: list[int], step_s: Array, step_mah: Array, thrust: Array, volts: Array
) -> PhaseEnergy:
    here = volts[at]
    here = here[here >= NO_BATTERY_READING_V]
    return PhaseEnergy(
        name,
        float(step_s[at].sum()),
        float(step_mah[at].sum()),
        float(thrust[at].mean()),
        float(here.min()) if here.size else math.nan,
    )


def _battery_mah(header: Mapping[str, Any]) -> tuple[float, bool]:
    """As the flight's profile said it; a log of an older perchctl does not."""
    profile = header.get("profile")
    vehicle = profile.get("vehicle") if isinstance(profile, Mapping) else None
    written = vehicle.get("battery_mah") if isinstance(vehicle, Mapping) else None
    if isinstance(written, (int, float)) and not isinstance(written, bool) and written > 0:
        return float(written), False
    return USUAL_MAH, True
