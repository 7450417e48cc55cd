"""How a fleet's flight ended: its exit code, its record in ``fleet.json``, and its table."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from perchctl.errors import (
    EXIT_CODES,
    AttemptsUsedUp,
    ConnectionFailed,
    EmergencyStopped,
    Interrupted,
    InvalidValue,
    LogIncomplete,
    NotFound,
    PerchError,
    ReplayDiffers,
    SafetyAbort,
    TargetNotFound,
    TimedOut,
    UsageError,
)
from perchctl.fleet.messages import Result
from perchctl.fleet.plan import FleetPlan
from perchctl.flight import FlyOptions

RECORD_NAME = "fleet.json"
LOOK_FIRST = "check where the vehicle is before you reach for it"
"""Advice for a vehicle if it is unknown how its flight ended."""
_WORST_FIRST: tuple[type[PerchError], ...] = (
    EmergencyStopped,
    SafetyAbort,
    AttemptsUsedUp,
    TargetNotFound,
    PerchError,
    ConnectionFailed,
    NotFound,
    InvalidValue,
    TimedOut,
    UsageError,
    LogIncomplete,
    ReplayDiffers,
    # last, because the vehicles that land after another one's failure also end with `Interrupted`
    Interrupted,
)


_CODES_WORST_FIRST = (*(cls.exit_code for cls in _WORST_FIRST), 0)


def worst_code(codes: Iterable[int]) -> int:
    """Return the most severe of these exit codes; 0 if there are none. A code that perchctl does
    not use is treated as the exit code of `PerchError`."""
    known = (code if code in EXIT_CODES else PerchError.exit_code for code in codes)
    return min(known, key=_CODES_WORST_FIRST.index, default=0)


def fleet_exit_code(results: Sequence[Result]) -> int:
    """Return 0 if all vehicles are hanging and their logs are complete, otherwise the exit code of
    the vehicle with the worst result."""
    return worst_code(result.exit_code for result in results)


def worst_of(results: Mapping[str, Result]) -> str:
    """Return the name of the vehicle whose exit code is used for the fleet."""
    code = fleet_exit_code([*results.values()])
    return next(name for name, result in results.items() if worst_code([result.exit_code]) == code)


def as_error(name: str, result: Result) -> PerchError:
    """Return a vehicle's failure as an error with its exit code."""
    kinds = {cls.exit_code: cls for cls in _WORST_FIRST}
    return kinds.get(result.exit_code, PerchError)(f"{name}: {result.reason}")


def vehicle_line(name: str, hangs: bool, outcome: str, miss_m: float | None, reason: str) -> str:
    """Return how one vehicle's flight ended, in words."""
    miss = "" if miss_m is None else f", {1e3 * miss_m:.1f} mm from centre"
    return f"{name:<12}{'hangs' if hangs else outcome}{miss}: {reason}"


@dataclass(frozen=True, kw_only=True)
class FleetOutcome:
    """The outcome of a fleet's flight, or its current state.

    Attributes:
        started, started_s: when it began, as a date and by `time.monotonic`.
        results: results of the vehicles whose flights have ended, keyed by name.
        problems: problems that affect several vehicles, such as a dead dongle, one sentence each.
        failed: True if the parent itself has failed and landed all vehicles.
    """

    plan: FleetPlan
    options: Mapping[str, FlyOptions]
    started: datetime
    started_s: float
    results: Mapping[str, Result]
    problems: tuple[str, ...] = ()
    failed: bool = False

    @property
    def unfinished(self) -> tuple[str, ...]:
        """The vehicles without a result: they are still flying, or nobody knows how they ended."""
        names = (vehicle.name for vehicle in self.plan.fleet.vehicles)
        return tuple(name for name in names if name not in self.results)

    @property
    def exit_code(self) -> int:
        """The exit code of the vehicle with the worst result. A vehicle without a result counts as
        a failure, and so does a failure of the parent."""
        codes = [result.exit_code for result in self.results.values()]
        failures = len(self.unfinished) + int(self.failed)
        return worst_code(codes + [PerchError.exit_code] * failures)

    @property
    def hanging(self) -> int:
        """The number of vehicles that are hanging."""
        return sum(result.hangs for result in self.results.values())

    @property
    def ratio(self) -> float | None:
        """Ratio of flight time to wall-clock time; it is below 1 if simulated time ran slower."""
        paces = [result.pace for result in self.results.values() if result.pace is not None]
        wall_s = sum(pace.wall_s for pace in paces)
        return sum(pace.flown_s for pace in paces) / wall_s if wall_s > 0.0 else None

    def record(self) -> dict[str, Any]:
        """The content of ``fleet.json`` in JSON types; positions are in room axes."""
        vehicles = [self._vehicle_record(name, result) for name, result in self.results.items()]
        ratio, code = self.ratio, self.exit_code
        return {
            "fleet": self.plan.fleet.name,
            "started_utc": self.started.isoformat(timespec="milliseconds"),
            "exit_code": code,
            "error": None if code == 0 else EXIT_CODES[code],
            "hanging": self.hanging,
            "unfinished": list(self.unfinished),
            "problems": list(self.problems),
            "ratio": None if ratio is None else round(ratio, 3),
            "vehicles": vehicles,
            "plan": self.plan.record(),
        }

    def _vehicle_record(self, name: str, result: Result) -> dict[str, Any]:
        vehicle, options = self.plan.fleet.vehicle(name), self.options[name]
        place_m = None
        if result.place_m is not None:
            place_m = [round(part, 3) for part in vehicle.flown_to_room(result.place_m)]
        ended_s = None if result.ended_s is None else round(result.ended_s - self.started_s, 3)
        return {
            "name": name,
            "uri": vehicle.uri,
            "seed": options.seed if options.simulated else None,
            "outcome": result.outcome.value,
            "exit_code": result.exit_code,
            "hangs": result.hangs,
            "reason": result.reason,
            "has_flown": result.has_flown,
            "ended_s": ended_s,
            "place_m": place_m,
            "target_m": list(vehicle.target_m),
            "miss_m": result.miss_m,
            "attempts": result.attempts,
            "battery_min_v": result.battery_min_v,
            "log": None if result.log is None else Path(result.log).name,
            "pace": None
            if result.pace is None
            else {name: round(part, 4) for name, part in asdict(result.pace).items()}
            | {"ratio": round(result.pace.ratio, 4)},
        }

    def text(self) -> str:
        """The outcome in words, with a line for each vehicle."""
        lines = [f"{'problem':<12}{problem}" for problem in self.problems]
        for name, result in self.results.items():
            outcome = result.outcome.value
            lines.append(vehicle_line(name, result.hangs, outcome, result.miss_m, result.reason))
        lines += [f"{name:<12}unknown: {LOOK_FIRST}" for name in self.unfinished]
        ratio = self.ratio
        if ratio is not None and any(each.simulated for each in self.options.values()):
            lines.append(f"{'pace':<12}{ratio:.2f} s of simulated time per second")
        gaps_s = [r.pace.gap_max_s for r in self.results.values() if r.pace is not None]
        if gaps_s and not math.isnan(max(gaps_s)):
            lines.append(f"{'setpoints':<12}longest gap {max(gaps_s):.2f} s on the wall clock")
        return "\n".join(lines)
