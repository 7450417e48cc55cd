"""The profile as a whole: every key, its unit, its default and its bounds.

A profile is checked here and only here; `perchctl.profile.load` reads it from its file.
`perchctl.profile.vision`, `perchctl.profile.mission` and `perchctl.profile.simulation` hold the
larger sections.
"""

from __future__ import annotations

import datetime
import operator
import re
from dataclasses import dataclass
from functools import reduce
from typing import Any

from pydantic import Field, model_validator

from perchctl.profile.base import Section, key
from perchctl.profile.dictionaries import check_marker_id
from perchctl.profile.keys import key_unit
from perchctl.profile.merge import MergeConfig
from perchctl.profile.mission import PlannerConfig, SafetyConfig
from perchctl.profile.old_keys import with_present_keys
from perchctl.profile.positioning import PositioningConfig
from perchctl.profile.simulation import SimulationConfig
from perchctl.profile.vision import (
    CameraConfig,
    DetectorConfig,
    KalmanConfig,
    PoseConfig,
    TargetConfig,
    VehicleConfig,
)


class LinkConfig(Section):
    """The profile's `link`: URI, telemetry and firmware parameters."""

    uri: str = key("sim://", "`sim://`, `radio://...`, `usb://0`, `udp://HOST:PORT`")
    connect_timeout_s: float = key(15.0, "for both tries together", gt=0, le=120)
    parameters: dict[str, int | float] = Field(
        default_factory=dict, description="firmware parameters, set and read back before the flight"
    )
    telemetry_period_s: float = key(0.01, "of position and attitude", ge=0.01, le=0.1)
    loop_hz: float = key(50.0, "turns of the flight loop", ge=5, le=200)


class LogConfig(Section):
    directory: str = key("perchctl-logs", "for the log and its plot")
    plot: bool = key(True, "draw the flight after it")
    max_mb: float = key(
        2000.0, "no more pictures are recorded into a larger recording", gt=0, le=1e6
    )


class Profile(Section):
    """One flight's resolved configuration."""

    name: str = key("unnamed", "of the profile; else its file's")
    description: str = key("", "one sentence for people")
    date: datetime.date | None = key(None, "of the measurements in it; printed on the target")
    camera: CameraConfig = CameraConfig()
    vehicle: VehicleConfig = VehicleConfig()
    target: TargetConfig = TargetConfig()
    detector: DetectorConfig = DetectorConfig()
    pose: PoseConfig = PoseConfig()
    kalman: KalmanConfig = KalmanConfig()
    merge: MergeConfig = MergeConfig()
    planner: PlannerConfig = PlannerConfig()
    safety: SafetyConfig = SafetyConfig()
    link: LinkConfig = LinkConfig()
    positioning: PositioningConfig = PositioningConfig()
    simulation: SimulationConfig = SimulationConfig()
    log: LogConfig = LogConfig()

    @model_validator(mode="before")
    @classmethod
    def _present_keys(cls, values: Any) -> Any:
        """Logs of earlier versions hold profiles with old keys."""
        return with_present_keys(values)[0] if isinstance(values, dict) else values

    @model_validator(mode="after")
    def _neighbours_can_be_printed(self) -> Profile:
        ids = self.simulation.neighbour_ids
        for name, marker, number in zip(
            ("large", "small"), (self.target.large, self.target.small), ids or (), strict=False
        ):
            try:
                check_marker_id(marker.dictionary, number)
            except ValueError as error:
                raise ValueError(f"simulation.neighbour_ids, {name}: {error}") from None
        return self

    @model_validator(mode="after")
    def _limits_fit(self) -> Profile:
        for limit in IMPOSSIBLE:
            if not limit.holds(self):
                raise ValueError(limit.sentence(self))
        return self


# --- Keys that must fit each other: what no flight could end well with is refused at load ------
# `IMPOSSIBLE` is the list that a profile is held to. What is only doubtful is in
# `perchctl.check.profile`.


REACHED_SHARE = 0.8
"""Of the take-off height: from here on it counts as reached (`Condition.AT_TAKEOFF_HEIGHT`)."""
OVERDUE_SHARE = 0.5
"""Of the landing's time: so long it goes by setpoints, and then by the vehicle's own landing."""

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
