"""A flight's edges, read off its log: telemetry, setpoints, external positions, battery, timing."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from perchctl.analysis.sight import percentile
from perchctl.geometry import Array
from perchctl.mission import (
    BatteryFit,
    EnergyState,
    SentBy,
    charge_at,
    fit_battery,
    update_energy,
)
from perchctl.record import FlightLog
from perchctl.vehicle import NO_BATTERY_READING_V

OLD_TELEMETRY_S = 0.1
"""Telemetry older than that is reported."""


def runs_of(log: FlightLog, key: str) -> list[tuple[float, float, str]]:
    """Stretches over which a text stayed the same, without those that have none: from, to, text."""
    found: list[tuple[float, float, str]] = []
    began_s, text = 0.0, ""
    for t_s, now in zip((*log.t_s, log.end_s), (*log.texts(key), None), strict=True):
        if now == text:
            continue
        if text:
            found.append((began_s, float(t_s), text))
        began_s, text = float(t_s), now or ""
    return found


# --- the link -------------------------------------------------------------------------------


@dataclass(frozen=True)
class LinkHealth:
    """Telemetry as the turns had it, and what was sent. Rates in 1/s, NaN where unknown.

    Attributes:
        fresh_hz: samples that were new in their turn; not above the loop's own rate.
        age_s, age_most_s, age_worst_s: of the newest sample: median, 99 of 100 below, all below.
        old: stretches in which the newest sample was older than `OLD_TELEMETRY_S`: from, to,
            worst age.
    """

    turns_hz: float
    fresh_hz: float
    age_s: float
    age_most_s: float
    age_worst_s: float
    old: tuple[tuple[float, float, float], ...]


def link_of(log: FlightLog) -> LinkHealth:
    """The link over the whole flight."""
    t_s, age = log.t_s, log.column("tel_age_s")
    spent_s = max(log.end_s, 1e-9) if t_s.size > 1 else math.nan
    sampled = np.round(t_s - age, 4)
    fresh = np.count_nonzero(np.diff(sampled[np.isfinite(sampled)]) > 0)
    return LinkHealth(
        turns_hz=(t_s.size - 1) / spent_s,
        fresh_hz=fresh / spent_s,
        age_s=percentile(age, 50),
        age_most_s=percentile(age, 99),
        age_worst_s=percentile(age, 100),
        old=_old_telemetry(t_s, age),
    )


def _old_telemetry(times_s: Array, ages_s: Array) -> tuple[tuple[float, float, float], ...]:
    found: list[tuple[float, float, float]] = []
    inside = False
    for t_s, age_s in zip(times_s, ages_s, strict=True):
        if not age_s > OLD_TELEMETRY_S:
            inside = False
        elif inside:
            start_s, _, worst_s = found[-1]
            found[-1] = (start_s, float(t_s), max(worst_s, float(age_s)))
        else:
            found.append((float(t_s), float(t_s), float(age_s)))
            inside = True
    return tuple(found)


# --- what was sent in the loop's place ------------------------------------------------------

APART_S = 2.0
"""Commands of one sender that are farther apart are two goes."""
_TELLS = {
    "position": "position setpoints",
    "thrust": "raw thrust",
    "land": "landing ordered",
    "stop": "motors stopped",
    "emergency": "motors cut",
}


@dataclass(frozen=True)
class Takeover:
    """What one sender sent in one go. Times on the loop's clock; `sent`: commands by their name
    in a tick's `cmd`, in the order of their first, and how many of each."""

    by: SentBy
    start_s: float
    end_s: float
    sent: tuple[tuple[str, int], ...]

    @property
    def text(self) -> str:
        """``position setpoints (14), landing ordered (2)``"""
        return ", ".join(f"{_TELLS[name]} ({count})" for name, count in self.sent)


def takeovers_of(sent: Sequence[Mapping[str, Any]]) -> tuple[Takeover, ...]:
    """The goes in the order of their times; `sent` are a log's `sent_values`."""
    goes: list[list[Mapping[str, Any]]] = []
    for each in sorted(sent, key=lambda one: float(one["t_s"])):
        last = goes[-1][-1] if goes else None
        if last is None or last["by"] != each["by"] or each["t_s"] - last["t_s"] > APART_S:
            goes.append([])
        goes[-1].append(each)
    return tuple(
        Takeover(go[0]["by"], go[0]["t_s"], go[-1]["t_s"],
                 tuple(Counter(each["cmd"] for each in go).items()))
        for go in goes
    )  # fmt: skip


# --- external positions ---------------------------------------------------------------------


@dataclass(frozen=True)
class ExternalHealth:
    """External positions as they were sent to the vehicle.

    Attributes:
        sent: how many; `rate_hz`: while they were sent.
        age_s, age_most_s: since their exposure: median, 99 of 100 below.
        apart_m, apart_most_m: between the newest one and the vehicle's own estimate: median,
            95 of 100 below.
        stops: stretches in which none was sent: from, to, why.
    """

    sent: int
    rate_hz: float
    age_s: float
    age_most_s: float
    apart_m: float
    apart_most_m: float
    stops: tuple[tuple[float, float, str], ...]


def external_of(log: FlightLog) -> ExternalHealth | None:
    """None where the vehicle's decks measured its position."""
    sent = log.column("pos_sent")
    if not np.isfinite(sent).any():
        return None
    offsets = [log.column(f"pos_{axis}_m") - log.column(f"{axis}_m") for axis in "xyz"]
    stopped = np.array([bool(text) for text in log.texts("pos_note")])
    apart = np.where(stopped, np.nan, np.linalg.norm(np.stack(offsets, 1), axis=1))
    age = log.column("pos_age_s")
    return ExternalHealth(
        int(np.nanmax(sent)),
        percentile(np.where(stopped, np.nan, log.column("pos_hz")), 50),
        percentile(age, 50),
        percentile(age, 99),
        percentile(apart, 50),
        percentile(apart, 95),
        tuple(runs_of(log, "pos_note")),
    )


# --- the battery ----------------------------------------------------------------------------

USUAL_MAH = 250.0
"""Of the battery that a Crazyflie comes with, where a log's profile does not say."""
LONGEST_STEP_S = 1.0
"""A longer gap between two ticks is the log's, and not counted as flown."""


@dataclass(frozen=True, eq=False)
class BatteryUse:
    """Voltages as they were read, charge by the count of the thrust.

    Attributes:
        battery_mah: what the charge is counted against; `assumed` where no profile says it.
        used_mah: the charge that was used.
        rest_v: (n,) the estimated resting voltage over the ticks, NaN where there is none.
        start_v, end_v, lowest_v: first, last and lowest reading; NaN without any.
        fit: how much the voltage falls under full thrust, and how much faster than assumed the
            battery empties; None where it was never under load.
        left: estimated share of the charge at the end; None where it is unknown.
    """

    battery_mah: float
    assumed: bool
    used_mah: float
    rest_v: Array
    start_v: float
    end_v: float
    lowest_v: float
    fit: BatteryFit | None
    left: float | None


def battery_of(log: FlightLog) -> BatteryUse:
    """Fits the battery model to the whole flight."""
    written = log.number("vehicle.battery_mah") or 0.0
    battery_mah = written if written > 0 else USUAL_MAH
    t_s, volts = log.column("t_s"), log.column("battery_v")
    thrust = np.nan_to_num(log.column("thrust"))
    step_s = np.clip(np.diff(t_s, append=t_s[-1:]), 0.0, LONGEST_STEP_S)
    state = EnergyState()
    rest_v = np.full(t_s.shape, np.nan)
    for i in range(t_s.size):
        state = update_energy(
            state, float(step_s[i]), float(volts[i]), float(thrust[i]), battery_mah
        )
        rest_v[i] = math.nan if state.rest_v is None else state.rest_v
    known = volts[volts >= NO_BATTERY_READING_V]
    is_loaded = state.loaded_s > 0
    return BatteryUse(
        battery_mah,
        written <= 0,
        state.used * battery_mah,
        rest_v,
        float(known[0]) if known.size else math.nan,
        float(known[-1]) if known.size else math.nan,
        float(known.min()) if known.size else math.nan,
        fit_battery(state) if is_loaded else None,
        charge_at(state.rest_v) if is_loaded and state.rest_v is not None else None,
    )


# --- the loop -------------------------------------------------------------------------------


def timings_of(log: FlightLog) -> dict[str, Array]:
    """What each turn took, s, by name: how late it began, and what the log has of its parts; a
    flight in lockstep has none of them."""
    late = log.column("late_s")
    found = {"late": late[np.isfinite(late)]}
    timings = [t for r in log.turn_records if isinstance(t := r.get("timing"), dict)]
    for key in dict.fromkeys(key for timing in timings for key in timing):
        found[key.removesuffix("_s")] = np.array([t.get(key, math.nan) for t in timings], float)
    return found
