"""Check keys whose values must be consistent with each other.

A profile that violates a limit in `IMPOSSIBLE` is rejected when it is read; `perchctl check` and
`fly` warn if it violates one in `DOUBTFUL`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from perchctl.profile.base import key_unit
from perchctl.profile.mission import (
    OVERDUE_SHARE,
    AlignConfig,
    AscendConfig,
    EstimateConfig,
    SafetyConfig,
)

REACHED_SHARE = 0.8
"""Fraction of the take-off height that counts as reached (`Condition.TAKEOFF_HEIGHT_REACHED`)."""
_KEY = re.compile(r"[a-z_]+(?:\.[a-z0-9_]+)+")


@dataclass(frozen=True)
class Limit:
    """A relation between keys that a profile must fulfil.

    Attributes:
        relation: a Python expression such as ``kalman.k1 + 0.1 < kalman.k2``.
        consequence: what happens if it is violated.
    """

    relation: str
    consequence: str

    @property
    def keys(self) -> tuple[str, ...]:
        """The dotted keys in the relation, in order."""
        return tuple(_KEY.findall(self.relation))

    def holds(self, profile: Any) -> bool:
        """True if the profile's values satisfy the relation."""
        # eval is safe: the relations are written in this module, and contain only keys and numbers.
        return bool(eval(_KEY.sub(_read, self.relation), {"profile": profile}))

    def violation_text(self, profile: Any) -> str:
        """A sentence with the violated relation, each key's value, and the consequence."""

        def shown(found: re.Match[str]) -> str:
            value = eval(_read(found), {"profile": profile})
            return f"{found[0]} ({f'{value:g} {key_unit(found[0])}'.strip()})"

        return f"{_KEY.sub(shown, self.relation)} does not hold: {self.consequence}"


def _read(found: re.Match[str]) -> str:
    """Convert a profile's key to an expression; `camera.latency_s`, which may be ``measured``, is
    replaced by the latency at the start of the flight."""
    key = found[0]
    return f"profile.{'camera.start_latency_s' if key == 'camera.latency_s' else key}"


_IMPOSSIBLE = {
    "planner.search.max_height_m <= safety.max_height_m": (
        "the search would climb to a height at which the vehicle has to land"
    ),
    "planner.takeoff_height_m <= planner.search.max_height_m": (
        "the take-off would end above the search's highest point"
    ),
    f"{REACHED_SHARE:g} * planner.takeoff_height_m / planner.takeoff_speed_mps"
    " < planner.approach_timeout_s": ("the take-off takes longer than its timeout"),
    "camera.latency_s < safety.max_frame_age_s": "every image would be too old to use",
    f"link.telemetry_period_s < {SafetyConfig.proof_age_s:g}": (
        "telemetry would be too old to prove a contact or a landing"
    ),
    "link.telemetry_period_s < safety.telemetry_hold_s": (
        "telemetry would always be too old, so the vehicle would always hold its position"
    ),
    "link.telemetry_period_s < safety.telemetry_land_s": (
        "telemetry would always be too old, so the vehicle would land"
    ),
}
"""Relations, and what happens to every flight with a profile that breaks one."""

_DOUBTFUL = {
    "heights": {
        # A climb overshoots its setpoint by 0.1 m (docs/firmware.md, "Position take-off").
        "0.1 + planner.search.max_height_m <= safety.max_height_m": (
            "a climb overshoots by 0.1 m, which would make the vehicle land"
        ),
        "safety.ground_tolerance_m <= 0.45": (
            "a hanging vehicle would be mistaken for one on the ground"
        ),
    },
    "fence": {
        "0.3 <= safety.fence_radius_m": "a draught can carry the vehicle that far",
    },
    "battery limits": {
        "safety.min_load_v < safety.min_rest_v": "the vehicle would land as soon as it takes off",
        # A full battery still delivers 3.7 V while a light vehicle hovers (docs/firmware.md,
        # "Thrust to PWM").
        "safety.min_load_v < 3.7": (
            "hovering lowers even a full battery to this voltage, so the vehicle would land as "
            "soon as it takes off"
        ),
        "safety.min_rest_v < 4.35": "no battery has this voltage at rest, so no flight would begin",
    },
    "time limits": {
        f"{REACHED_SHARE:g} * planner.takeoff_height_m / planner.takeoff_speed_mps"
        f" + {EstimateConfig.dwell_s + AlignConfig.dwell_s:g} + planner.ascend.settle_dwell_s"
        " + planner.perch.contact_dwell_s < planner.perching_time_s": (
            "the perching time ends before a contact is possible"
        ),
        "planner.search.attempts * planner.search.wait_s < planner.perching_time_s": (
            "the perching time ends before the search does"
        ),
        f"safety.max_height_m / planner.landing.speed_mps / {OVERDUE_SHARE:g}"
        " < planner.landing.timeout_s": (
            "a descent from the maximum height takes more than half of the timeout, and after "
            "half of it the firmware lands the vehicle"
        ),
        "safety.camera_hold_s < safety.camera_land_s": (
            "the vehicle would land before it holds its position"
        ),
        "safety.telemetry_hold_s < safety.telemetry_land_s": (
            "the vehicle would land before it holds its position"
        ),
    },
    "thresholds": {
        f"planner.align.xy_m <= {AscendConfig.cone_base_m:g}": (
            "near the target the vehicle would alternate between ALIGN and ASCEND"
        ),
        "planner.perch.contact_z_m < planner.ascend.standoff_m": (
            "the vehicle would settle at a distance that already counts as contact"
        ),
        f"{AscendConfig.near_speed_mps:g} <= planner.ascend.speed_mps": (
            "the vehicle would climb faster near the target than far from it"
        ),
        # The thrust at which a vehicle of 30 g hovers (docs/firmware.md, "Thrust to PWM").
        "40200 <= planner.perch.thrust": "this raw thrust is too small to press against the target",
        "20 <= safety.max_tilt_deg": (
            "a gust can tilt the vehicle that far, which would cut the motors"
        ),
        f"link.telemetry_period_s <= {SafetyConfig.proof_age_s / 2:g}": (
            "a single lost packet would make telemetry too old to count as evidence"
        ),
    },
}
"""Relations, grouped by the check row that reports them, and what may go wrong in a flight with a
profile that breaks one."""

IMPOSSIBLE = tuple(Limit(*each) for each in _IMPOSSIBLE.items())
"""Relations whose violation makes every flight fail."""
DOUBTFUL = {
    name: tuple(Limit(*each) for each in relations.items()) for name, relations in _DOUBTFUL.items()
}
"""Relations that a profile may break, although flights then rarely succeed, keyed by the check row
that reports them."""
