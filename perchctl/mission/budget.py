"""What the battery is enough for: an attempt up to contact, and a landing from there.

Asked before each attempt. What it has left (`perchctl.mission.energy`) is compared with what
the way up, the press and the way down take at the profile's speeds, with a reserve. It ends
where `battery-low` would fire; what there is below that is for a landing that nobody planned.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from perchctl.mission.conditions import press_thrust
from perchctl.mission.context import Context
from perchctl.mission.energy import (
    LOW_POWER_V,
    EnergyState,
    Floor,
    left_s,
    loaded_v,
    update_energy,
    used_mah,
)
from perchctl.mission.state import BatteryOutlook, Phase
from perchctl.profile import Profile
from perchctl.vehicle import FULL_THRUST

FRESH_S = 1.0
"""In flight a reading changes all the time: one that stood still for longer is none."""
UNKNOWN_S = 5.0
"""Without a reading for so long, what the battery has left is not known any more."""
SETTLING_S, TOUCHING_S, LANDING_S = 3.0, 1.0, 3.0
"""Under the target, from the press to its proof, and of the vehicle's own landing: as measured
in simulated flights."""
PRESS_DIP_V = 0.3
"""By so much a press that is over before `battery-low` fires may go below `safety.min_load_v`."""
BACK_OFF_S = 3.0
"""From a failed attempt until it is steady, has the target, and is aligned again."""


@dataclass(frozen=True)
class Needs:
    """Seconds of flight: for the attempt at hand, for each further one, for the landing."""

    attempt_s: float
    again_s: float
    landing_s: float


def watched(c: Context) -> EnergyState:
    """The battery with this tick's reading; one that is not fresh is none."""
    tel = c.obs.telemetry
    reading_v = tel.battery_v if c.obs.battery_age_s <= FRESH_S else math.nan
    dt_s = max(0.0, c.obs.t_s - c.state.t_s)
    return update_energy(c.state.energy, dt_s, reading_v, tel.thrust, c.profile.vehicle.battery_mah)


def outlook(c: Context) -> BatteryOutlook:
    """What is left, None where it is not known, and for how many attempts that is enough. What
    is not known counts as what was left by the last reading, less what has been used since, and as
    no more than the grace that a vehicle without a reading has (fault 7)."""
    energy, battery_mah = c.state.energy, c.profile.vehicle.battery_mah
    used = used_mah(energy, battery_mah)
    counted_s = left_s(energy, floor_of(c.profile), battery_mah, _hover_load(c))
    seconds = None if _is_unknown(c) else counted_s
    if c.target_m is None:
        return BatteryOutlook(seconds, None, used, energy.rest_v)
    needs = needs_of(c)
    if seconds is None:
        enough_s = grace_s(c) if counted_s is None else min(counted_s, grace_s(c))
    else:
        enough_s = seconds
    spare_s = enough_s - c.profile.safety.energy_reserve_s - needs.landing_s - needs.attempt_s
    left = c.profile.planner.attempts - c.state.attempts
    attempts = 0  # also where the figures are no numbers
    if spare_s >= 0.0:
        attempts = 1 + math.floor(min(spare_s / needs.again_s, max(0, left)))
    return BatteryOutlook(seconds, max(0, min(attempts, left)), used, energy.rest_v)


def grace_s(c: Context) -> float:
    """What `battery-unknown` leaves of its time to one whose reading tells nothing."""
    return c.profile.safety.battery_stale_s - max(c.state.energy.unknown_s, c.obs.battery_age_s)


def _is_unknown(c: Context) -> bool:
    return c.state.energy.unknown_s > UNKNOWN_S


def floor_of(profile: Profile) -> Floor:
    """Where `battery-low` fires: by the firmware's word under a long load, by the profile's
    under one that outlasts `safety.battery_debounce_s`. A press seldom does."""
    safety = profile.safety
    low_v = float(profile.link.parameters.get("pm.lowVoltage", LOW_POWER_V))
    press_s = TOUCHING_S + profile.planner.perch.contact_dwell_s
    dip_v = 0.0 if press_s > safety.battery_debounce_s else PRESS_DIP_V
    press_load = press_thrust(profile) / FULL_THRUST
    return Floor(max(low_v, safety.min_load_v), safety.min_load_v - dip_v, press_load)


def needs_of(c: Context) -> Needs:
    """By the height of the target, which was seen."""
    planner = c.profile.planner
    up_m = max(0.0, c.contact_goal_z_m - c.obs.telemetry.position_m[2])
    touch_s = SETTLING_S + planner.ascend.settle_dwell_s + TOUCHING_S
    touch_s += planner.ascend.standoff_m / planner.perch.climb_mps + planner.perch.contact_dwell_s
    aligned_s = 0.0
    if c.state.phase not in (Phase.ALIGN, Phase.ASCEND, Phase.PERCH):
        aligned_s = BACK_OFF_S if c.state.phase is Phase.RECOVER else 2.0 * BACK_OFF_S
    again_m = planner.recover.descend_m + planner.ascend.standoff_m
    return Needs(
        aligned_s + _climb_s(c.profile, up_m) + touch_s,
        2.0 * BACK_OFF_S + _climb_s(c.profile, again_m) + touch_s,
        max(0.0, c.height_m + up_m) / planner.landing.speed_mps + LANDING_S,
    )


def short_of_charge(c: Context) -> bool:
    """The attempt that would begin now has not enough. Where no target is remembered none
    begins: first there is a search, and then it is asked again."""
    asked = c.profile.safety.energy_gate and c.target_m is not None
    return asked and not c.state.battery.attempts


def why_short(c: Context) -> str:
    """With the figures."""
    energy, seconds = c.state.energy, c.state.battery.left_s
    needs, volts = needs_of(c), loaded_v(energy, _hover_load(c))
    if seconds is None or volts is None:
        has = (
            f"what the battery has left is not known, and of the time that it may fly without a "
            f"reading (safety.battery_stale_s) {max(0.0, grace_s(c)):.0f} s are left"
        )
    else:
        has = f"the battery has {max(0.0, seconds):.0f} s left at {volts:.2f} V under load"
    return (
        f"{has}; an attempt takes {needs.attempt_s:.0f} s, the landing {needs.landing_s:.0f} s, "
        f"the reserve is {c.profile.safety.energy_reserve_s:g} s"
    )


def _hover_load(c: Context) -> float:
    """What hovering takes, of the full thrust."""
    return (c.state.hover_thrust or FULL_THRUST * c.state.energy.mean_load) / FULL_THRUST


def _climb_s(profile: Profile, up_m: float) -> float:
    ascend = profile.planner.ascend
    near_m = min(up_m, ascend.near_m)
    return (up_m - near_m) / ascend.speed_mps + near_m / ascend.near_speed_mps
