"""Results of simulated fleets: one fleet's result, and the figures of a campaign for JSON and as
text."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from perchctl.campaign import CampaignFlight, align_columns, rate_text
from perchctl.faults import ENDS, FLAGS, HEALTHY, FaultResult, fault_summary

_FROM_GOOD_TO_BAD = ("perched", "landed", "refused", "aborted", "failed", "gone")
WORST_FLEETS = 10
"""How many of the worst fleets the text names. If no more were flown, it lists all injected
faults."""


@dataclass(frozen=True)
class FleetResult(CampaignFlight):
    """Result of one fleet's flight.

    Attributes:
        outcome: perched if all vehicles have perched, otherwise the worst vehicle's outcome.
        fault: name of the fault in one vehicle, or of the common cause; "none" if there was none.
        vehicles: result of each vehicle, in the order of `names`.
        collisions: number of pairs in `collided`, which came so close that they touched.
        least_distance_m: smallest horizontal distance between two vehicles while the motors of at
            least one were turning.
        least_distance_in_air_m: smallest horizontal distance between two vehicles while the motors
            of both were turning; None if no two vehicles had their motors running at the same time.
        separation_m: the plan's separation between the corridors of two vehicles that fly together.
        time_s: time from the start of the first group to the end of the last one.
        injected: what was to be injected into each affected vehicle, in words. The `begin_s` of its
            result says whether the fault began.
    """

    fault: str
    names: tuple[str, ...]
    vehicles: tuple[FaultResult, ...]
    collisions: int
    collided: tuple[tuple[str, str], ...]
    least_distance_m: float | None
    least_distance_in_air_m: float | None
    separation_m: float
    time_s: float
    injected: dict[str, str] = field(default_factory=dict)

    @property
    def is_bad(self) -> bool:
        """True if two vehicles collided, if a flag counts against the program, or if there was no
        fault but some vehicle did not perch."""
        missed = self.fault == HEALTHY.fault.name and self.outcome != "perched"
        return self.collisions > 0 or missed or any(v.is_bad for v in self.vehicles)


def fleet_outcome(results: Sequence[FaultResult]) -> str:
    """The fleet's outcome: perched if all vehicles have perched, otherwise the worst vehicle's
    outcome."""
    return max((result.outcome for result in results), key=_FROM_GOOD_TO_BAD.index)


def refused_vehicle(reason: str) -> FaultResult:
    """Return the result for a vehicle that was not allowed to take off."""
    return FaultResult(
        seed=0,
        outcome="refused",
        fault=HEALTHY.fault.name,
        phase="",
        moment_s=0.0,
        begin_s=None,
        parameters={},
        reason=reason,
        flags={},
        counted=(),
        time_s=0.0,
        miss_m=None,
        drop_m=0.0,
    )


def fleet_summary(results: Sequence[FleetResult]) -> dict[str, Any]:
    """The figures of a campaign as a JSON object: figures for the fleets, and those of
    `fault_summary` for all their vehicles."""
    figures = fault_summary([vehicle for fleet in results for vehicle in fleet.vehicles])
    del figures["worst_seeds"]
    return {
        "fleets": len(results),
        "vehicles": figures.pop("flights"),
        **figures,
        "all_perched": sum(r.outcome == "perched" for r in results),
        "collisions": sum(r.collisions for r in results),
        "least_distance_m": _least([r.least_distance_m for r in results]),
        "least_distance_in_air_m": _least([r.least_distance_in_air_m for r in results]),
        "separation_m": results[0].separation_m if results else None,
        "worst_seeds": [r.seed for r in worst_fleets(results)[:WORST_FLEETS]],
        "injected": [
            {"seed": r.seed, "vehicle": name, "fault": text, "begin_s": vehicle.begin_s}
            for r in results
            for name, vehicle in zip(r.names, r.vehicles, strict=True)
            if (text := r.injected.get(name)) is not None
        ],
    }


def _least(values_m: Sequence[float | None]) -> float | None:
    return min((value for value in values_m if value is not None), default=None)


def worst_fleets(results: Sequence[FleetResult]) -> list[FleetResult]:
    """Return the fleets in which something went wrong: first those with collisions, then those with
    flags that count against the program."""
    bad = [r for r in results if r.is_bad]
    return sorted(bad, key=lambda r: (-r.collisions, -sum(v.is_bad for v in r.vehicles), r.seed))


def fleet_table(results: Sequence[FleetResult]) -> str:
    """The figures and the worst fleets as plain text."""
    figures = fleet_summary(results)
    vehicles = figures["vehicles"]
    lines = [
        f"{'fleets':<22}{figures['fleets']}, {figures['all_perched']} with all vehicles perched",
        f"{'vehicles':<22}{vehicles}",
    ]
    for end, meaning in ENDS.items():
        if figures[end] or end == "perched":
            lines.append(f"{end:<22}{rate_text(figures[end], vehicles)}: {meaning}")
    lines.append(f"{'collisions':<22}{figures['collisions']}")
    for name, words in (("least_distance_m", "flying"), ("least_distance_in_air_m", "both flying")):
        if (least_m := figures[name]) is not None:
            lines.append(f"{'least distance':<22}{least_m:.2f} m between two vehicles, {words}")
    wrong = sum(vehicle.is_bad for fleet in results for vehicle in fleet.vehicles)
    unavoidable = figures["unavoidable"]
    lines.append(
        f"{'with a flag':<22}{wrong} vehicle{'' if wrong == 1 else 's'}; excused by physics or the "
        f"firmware: {unavoidable}"
    )
    for flag, meaning in FLAGS.items():
        if figures[flag]:
            lines.append(f"{flag.replace('_', ' '):<22}{figures[flag]}: {meaning}")
    # The results file names the faults of every seed; the text does so for a few seeds only.
    if figures["injected"] and len(results) <= WORST_FLEETS:
        lines += ["", "injected faults"]
        for each in figures["injected"]:
            not_begun = "" if each["begin_s"] is not None else "; did not begin"
            lines += textwrap.wrap(
                f"seed {each['seed']}, {each['vehicle']}: {each['fault']}{not_begun}",
                width=80,
                subsequent_indent="   ",
                break_on_hyphens=False,
            )
    if worst := worst_fleets(results)[:WORST_FLEETS]:
        lines += ["", "worst fleets"]
        rows: list[tuple[str, ...]] = [("seed", "fault", "vehicle", "end", "what")]
        for fleet in worst:
            rows += _rows(fleet)
        lines += align_columns(rows)
    return "\n".join(lines)


def _rows(fleet: FleetResult) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [
        (str(fleet.seed), fleet.fault, f"{first}, {second}", "", "collided")
        for first, second in fleet.collided
    ]
    for name, vehicle in zip(fleet.names, fleet.vehicles, strict=True):
        missed = fleet.fault == HEALTHY.fault.name and vehicle.outcome != "perched"
        if vehicle.counted or missed:
            flags = ", ".join(flag.replace("_", " ") for flag in vehicle.counted)
            what = flags or vehicle.reason
            rows.append((str(fleet.seed), fleet.fault, name, vehicle.outcome, what))
    return rows
