"""Whether the position follows a hand: lifted and put back, motors off."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from perchctl.check.row import Row, failed, passed, skipped, warned
from perchctl.link import ProbeLink
from perchctl.vehicle import Telemetry

NAME = "lifted"
WITHIN_S = 20.0
POLL_S = 0.1
LIFTED_M, FOLLOWED_M, BACK_M = 0.15, 0.08, 0.10
MOVED_G = 0.05
"""A hand that lifts shows in the accelerometer; its noise at rest is a tenth of it."""
HOW = "lift it by 30 cm, hold it level, put it back"


@dataclass(frozen=True)
class Lift:
    """Rise of the position at its highest and at the end, m, and the largest difference of the
    accelerometer from 1 g."""

    rise_m: float
    back_m: float
    moved_g: float


def unasked() -> Row:
    return skipped(NAME, "not asked for", "add --lift, and lift it by hand when told")


def watch(
    link: ProbeLink, wait: Callable[[float], None], within_s: float = WITHIN_S
) -> list[Telemetry]:
    """What the vehicle reports until it was lifted and is back, or for so long."""
    seen: list[Telemetry] = []
    for _ in range(max(1, round(within_s / POLL_S))):
        wait(POLL_S)
        seen.extend(link.telemetry())
        lift = lift_of(seen)
        if lift is not None and lift.rise_m > LIFTED_M and abs(lift.back_m) < BACK_M / 2.0:
            break
    return seen


def lift_of(seen: Sequence[Telemetry]) -> Lift | None:
    """None of no telemetry."""
    if not seen:
        return None
    start_m = seen[0].position_m[2]
    return Lift(
        max(t.position_m[2] for t in seen) - start_m,
        seen[-1].position_m[2] - start_m,
        max(abs(t.acc_z_g - 1.0) for t in seen),
    )


def row(lift: Lift | None) -> Row:
    if lift is None:
        return skipped(NAME, "no telemetry")
    found = f"rose by {lift.rise_m:.2f} m, then {lift.back_m:+.2f} m"
    if lift.rise_m < FOLLOWED_M and lift.moved_g < MOVED_G:
        return skipped(NAME, "it was not moved", HOW)
    if lift.rise_m < FOLLOWED_M:
        advice = "the positioning does not see it: light, floor, base stations"
        return failed(NAME, f"it moved, and the position {found}", advice)
    if lift.rise_m < LIFTED_M:
        return skipped(NAME, f"{found}: not enough to tell", HOW)
    if abs(lift.back_m) > BACK_M:
        return warned(NAME, found, "was it put back where it was? else the position drifts")
    return passed(NAME, found)
