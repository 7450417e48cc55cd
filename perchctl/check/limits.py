"""A profile's limits that are allowed and doubtful: they hardly work together.

Those that no flight could end well with are refused when the profile is read
(`perchctl.profile.limits.IMPOSSIBLE`).
"""

from __future__ import annotations

from collections.abc import Mapping

from perchctl.profile import REACHED_SHARE, Limit

OVERSHOOT_M = 0.1
"""So far a climb passes its setpoint (docs/firmware.md, "Position take-off")."""
FRESH_UNDER_LOAD_V = 3.7
"""What a full battery has left under a light vehicle (docs/firmware.md, "Thrust to PWM")."""
FULL_V = 4.35
"""The most that one cell has, of whatever kind."""
LIGHT_HOVER_THRUST = 40200
"""Of 30 g (docs/firmware.md, "Thrust to PWM"); less raw thrust does not press."""
LEAST_TILT_DEG, LEAST_FENCE_M, LEAST_STALE_S = 20.0, 0.3, 10.0
MOST_GROUND_TOLERANCE_M = 0.45
"""What hangs is higher."""
USUAL_RATE_HZ = 25.0
OVERDUE = 0.5
"""Of the landing's time: so long it goes by setpoints (`perchctl.mission.lander`)."""


def _least_time_s(takeoff_m: float, takeoff_mps: float, *dwells_s: float) -> float:
    return REACHED_SHARE * takeoff_m / takeoff_mps + sum(dwells_s)


DOUBTFUL: Mapping[str, tuple[Limit, ...]] = {
    "heights": (
        Limit(
            (OVERSHOOT_M, "planner.search.max_height_m"), "safety.max_height_m",
            "a climb overshoots by as much, and lands for it", equal=True,
        ),
        Limit(
            ("safety.ground_tolerance_m",), MOST_GROUND_TOLERANCE_M,
            "a vehicle that hangs would be taken for one on the ground", equal=True,
        ),
    ),
    "fence": (
        Limit(
            (LEAST_FENCE_M,), "safety.fence_radius_m", "a draught carries it so far", equal=True
        ),
    ),
    "battery limits": (
        Limit(("safety.min_load_v",), "safety.min_rest_v", "it would land as soon as it lifts"),
        Limit(
            ("safety.min_load_v",), FRESH_UNDER_LOAD_V,
            "hovering takes a full battery down to it: it would land as soon as it lifts",
        ),
        Limit(("safety.min_rest_v",), FULL_V, "no battery rests so high: no flight would begin"),
        Limit(
            (LEAST_STALE_S,), "safety.battery_stale_s",
            "a reading may well stand still for so long", equal=True,
        ),
    ),
    "time limits": (
        Limit(
            (
                "planner.takeoff_height_m", "planner.takeoff_speed_mps",
                "planner.estimate.dwell_s", "planner.align.dwell_s",
                "planner.ascend.settle_dwell_s", "planner.perch.contact_dwell_s",
            ), "planner.perching_time_s", "the perching time is over before a contact",
            of=_least_time_s, words="the least time for {0} at {1}, with {2}, {3}, {4} and {5}",
        ),
        Limit(
            ("planner.search.attempts", "planner.search.wait_s"), "planner.perching_time_s",
            "the perching time is over before the search", of=lambda waits, wait_s: waits * wait_s,
            words="{0} times {1}",
        ),
        Limit(
            ("safety.max_height_m", "planner.landing.speed_mps"), "planner.landing.timeout_s",
            "from there it is not down by setpoints when half of that is over, and is left to its "
            "own landing", of=lambda height_m, speed_mps: height_m / speed_mps / OVERDUE,
            words="twice the time that landing from {0} takes at {1}",
        ),
        Limit(
            ("safety.camera_hold_s",), "safety.camera_land_s", "it lands before it was held"
        ),
        Limit(
            ("safety.telemetry_hold_s",), "safety.telemetry_land_s", "it lands before it was held"
        ),
        Limit(
            ("safety.loop_late_hold_s",), "safety.loop_late_land_s", "it lands before it was held"
        ),
    ),
    "thresholds": (
        Limit(
            ("planner.align.xy_m",), "planner.ascend.cone_base_m",
            "near the target it goes back and forth between ALIGN and ASCEND", equal=True,
        ),
        Limit(
            ("planner.perch.contact_z_m",), "planner.ascend.standoff_m",
            "where it settles it is as near as at a contact already",
        ),
        Limit(
            ("planner.ascend.near_speed_mps",), "planner.ascend.speed_mps",
            "it climbs faster near the target than far from it", equal=True,
        ),
        Limit(
            (LIGHT_HOVER_THRUST,), "planner.perch.thrust", "so little raw thrust does not press",
            equal=True,
        ),
        Limit(
            ("safety.start_tilt_deg",), "safety.max_tilt_deg",
            "it may start at a tilt that cuts the motors",
        ),
        Limit(
            (LEAST_TILT_DEG,), "safety.max_tilt_deg", "a gust tilts it so far, and cuts the motors",
            equal=True,
        ),
        Limit(
            ("safety.jump_deg",), "safety.heading_lost_deg",
            "each jump of the heading would take it down by thrust alone",
        ),
        Limit(
            ("safety.estimator_variance_m2",), "safety.flight_variance_m2",
            "it may start with an estimate that it lands for", equal=True,
        ),
        Limit(
            ("link.telemetry_period_s", "link.telemetry_period_s"), "safety.proof_age_s",
            "one lost packet, and nothing is proven", equal=True,
        ),
    ),
}  # fmt: skip
"""By the row that they are told in."""
