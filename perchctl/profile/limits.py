"""Keys that must fit each other.

A profile that breaks a limit of `IMPOSSIBLE` is refused when it is read; `perchctl check` and
`fly` warn where it breaks one of `DOUBTFUL`.
"""

from __future__ import annotations

import operator
import re
from dataclasses import dataclass
from functools import reduce
from typing import Any

from perchctl.profile.base import key_unit
from perchctl.profile.mission import OVERDUE_SHARE, AscendConfig

REACHED_SHARE = 0.8
"""Of the take-off height: from here on it counts as reached (`Condition.AT_TAKEOFF_HEIGHT`)."""
_OPERATORS = {"+": operator.add, "*": operator.mul, "/": operator.truediv}
_OPERATOR = re.compile(r" ([+*/]) ")


@dataclass(frozen=True)
class Limit:
    """A relation between keys that a profile must hold.

    Attributes:
        relation: as in ``kalman.k1 + 0.1 < kalman.k2``, or with ``<=``. The left side holds keys
            by their dotted paths and numbers, with +, * and / between; it is worked out from
            left to right. The right side is one key or number.
        because: what happens otherwise.
        words: of a left side that is no sum, what it is: {0}, {1}, ... stand for its keys.
    """

    relation: str
    because: str
    words: str = ""

    @property
    def _sides(self) -> tuple[str, str, str]:
        """Left, the relation's sign, right."""
        left, sign, right = re.split(" (<=?) ", self.relation)
        return left, sign, right

    @property
    def keys(self) -> tuple[str, ...]:
        left, _, right = self._sides
        sides = (*_OPERATOR.split(left)[::2], right)
        return tuple(side for side in sides if side[0].isalpha())

    def holds(self, profile: Any) -> bool:
        """Also where a key has no number to compare."""
        left, sign, right = self._sides
        found, most = _evaluate(left, profile), _evaluate(right, profile)
        return found is None or most is None or found < most or (sign == "<=" and found == most)

    def sentence(self, profile: Any) -> str:
        """What is found, and what must hold."""
        left, sign, right = self._sides
        relation = "must not exceed" if sign == "<=" else "must be less than"
        limit = _named(profile, right, units=bool(self.words))
        return f"{self._found(left, right, profile)} {relation} {limit}: {self.because}"

    def _found(self, left: str, right: str, profile: Any) -> str:
        """The left side, and what it comes to where it has parts."""
        parts, value = _OPERATOR.split(left)[::2], _evaluate(left, profile)
        if self.words:
            named = [_named(profile, part, units=True) for part in parts if part[0].isalpha()]
            result = f"{value:.3g} {key_unit(right)}".strip()
            return f"{self.words.format(*named)} is {result}, and"
        total = " + ".join(_named(profile, part) for part in parts)
        return total if len(parts) == 1 else f"{total}, together {value:.3g},"


def _evaluate(side: str, profile: Any) -> float | None:
    first, *rest = _OPERATOR.split(side)
    value = _value(profile, first)
    for sign, part in zip(rest[::2], rest[1::2], strict=True):
        other = _value(profile, part)
        if value is None or other is None:
            return None
        value = _OPERATORS[sign](value, other)
    return value


def _value(profile: Any, part: str) -> float | None:
    """The number that stands there, or that the profile has at that key; None where it has none."""
    if part == "camera.latency_s":
        part = "camera.start_latency_s"
    value = reduce(getattr, part.split("."), profile) if part[0].isalpha() else float(part)
    return value if isinstance(value, (int, float)) else None


def _named(profile: Any, part: str, units: bool = False) -> str:
    value = _value(profile, part)
    if not part[0].isalpha():
        return f"{value:g}"
    return f"{part} ({f'{value:g} {key_unit(part) if units else str()}'.strip()})"


IMPOSSIBLE: tuple[Limit, ...] = (
    Limit(
        "planner.search.max_height_m <= safety.max_height_m",
        "the search would climb to where it has to land",
    ),
    Limit(
        "planner.takeoff_height_m <= planner.search.max_height_m",
        "the take-off would end above where the search ends",
    ),
    Limit(
        f"{REACHED_SHARE:g} * planner.takeoff_height_m / planner.takeoff_speed_mps"
        " < planner.approach_timeout_s",
        "the take-off takes longer than it is waited for",
        words=f"the climb to {REACHED_SHARE:g} of {{0}} at {{1}}",
    ),
    Limit(
        "camera.latency_s < safety.max_frame_age_s", "every picture would be too old to measure by"
    ),
    Limit(
        "link.telemetry_period_s < safety.proof_age_s",
        "telemetry would be too old to prove a contact or a landing",
    ),
    Limit(
        "link.telemetry_period_s < safety.telemetry_hold_s",
        "telemetry would always be old, and the vehicle held",
    ),
    Limit(
        "link.telemetry_period_s < safety.telemetry_land_s",
        "telemetry would always be old, and the vehicle landed",
    ),
    Limit(
        "planner.estimate.dwell_s < planner.estimate.timeout_s", "no pose could be steady in time"
    ),
    Limit("planner.align.dwell_s < planner.align.timeout_s", "nothing could be aligned in time"),
    Limit(
        "planner.ascend.settle_dwell_s < planner.ascend.settle_timeout_s",
        "it could not settle in time",
    ),
    Limit(
        "planner.ascend.settle_dwell_s < planner.ascend.timeout_s", "it could not settle in time"
    ),
    Limit(
        "planner.perch.contact_dwell_s < planner.perch.timeout_s",
        "no contact could be proven in time",
    ),
    Limit(
        "planner.complete.hold_dwell_s + planner.complete.ramp_s + planner.complete.hang_s"
        " < planner.complete.release_timeout_s",
        "the thrust could not be released in time",
    ),
    Limit(
        "planner.recover.dwell_s < planner.recover.timeout_s",
        "after a miss it could not become steady in time",
    ),
)
"""Every flight with such a profile comes to nothing."""

DOUBTFUL: dict[str, tuple[Limit, ...]] = {
    "heights": (
        # A climb passes its setpoint by 0.1 m (docs/firmware.md, "Position take-off").
        Limit(
            "0.1 + planner.search.max_height_m <= safety.max_height_m",
            "a climb overshoots by as much, and lands for it",
        ),
        Limit(
            "safety.ground_tolerance_m <= 0.45",
            "a vehicle that hangs would be taken for one on the ground",
        ),
    ),
    "fence": (Limit("0.3 <= safety.fence_radius_m", "a draught carries it so far"),),
    "battery limits": (
        Limit("safety.min_load_v < safety.min_rest_v", "it would land as soon as it lifts"),
        # What a full battery has left under a light vehicle (docs/firmware.md, "Thrust to PWM").
        Limit(
            "safety.min_load_v < 3.7",
            "hovering takes a full battery down to it: it would land as soon as it lifts",
        ),
        Limit("safety.min_rest_v < 4.35", "no battery rests so high: no flight would begin"),
        Limit(
            "10 <= safety.battery_stale_s",
            "a reading may well stand still for so long",
        ),
    ),
    "time limits": (
        Limit(
            f"{REACHED_SHARE:g} * planner.takeoff_height_m / planner.takeoff_speed_mps"
            " + planner.estimate.dwell_s + planner.align.dwell_s + planner.ascend.settle_dwell_s"
            " + planner.perch.contact_dwell_s < planner.perching_time_s",
            "the perching time is over before a contact",
            words="the least time for {0} at {1}, with {2}, {3}, {4} and {5}",
        ),
        Limit(
            "planner.search.attempts * planner.search.wait_s < planner.perching_time_s",
            "the perching time is over before the search",
            words="{0} times {1}",
        ),
        Limit(
            f"safety.max_height_m / planner.landing.speed_mps / {OVERDUE_SHARE:g}"
            " < planner.landing.timeout_s",
            "from there it is not down by setpoints when half of that is over, and is left to its "
            "own landing",
            words="twice the time that landing from {0} takes at {1}",
        ),
        Limit("safety.camera_hold_s < safety.camera_land_s", "it lands before it was held"),
        Limit("safety.telemetry_hold_s < safety.telemetry_land_s", "it lands before it was held"),
        Limit("safety.loop_late_hold_s < safety.loop_late_land_s", "it lands before it was held"),
    ),
    "thresholds": (
        Limit(
            f"planner.align.xy_m <= {AscendConfig.cone_base_m:g}",
            "near the target it goes back and forth between ALIGN and ASCEND",
        ),
        Limit(
            "planner.perch.contact_z_m < planner.ascend.standoff_m",
            "where it settles it is as near as at a contact already",
        ),
        Limit(
            "planner.ascend.near_speed_mps <= planner.ascend.speed_mps",
            "it climbs faster near the target than far from it",
        ),
        # The hover thrust of 30 g (docs/firmware.md, "Thrust to PWM").
        Limit("40200 <= planner.perch.thrust", "so little raw thrust does not press"),
        Limit(
            "safety.start_tilt_deg < safety.max_tilt_deg",
            "it may start at a tilt that cuts the motors",
        ),
        Limit(
            "20 <= safety.max_tilt_deg",
            "a gust tilts it so far, and cuts the motors",
        ),
        Limit(
            "safety.jump_deg < safety.heading_lost_deg",
            "each jump of the heading would take it down by thrust alone",
        ),
        Limit(
            "safety.estimator_variance_m2 <= safety.flight_variance_m2",
            "it may start with an estimate that it lands for",
        ),
        Limit(
            "link.telemetry_period_s + link.telemetry_period_s <= safety.proof_age_s",
            "one lost packet, and nothing is proven",
        ),
    ),
}
"""What is allowed and hardly works together, by the name of its row in the check."""
