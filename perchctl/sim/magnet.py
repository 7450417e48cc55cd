"""The magnet: what pulls the gear's tip towards the ceiling, and whether it holds.

It acts within `MAGNET_RADIUS_M` of the target's centre on an upright vehicle, fully at
contact, and falls to zero over `MAGNET_RANGE_M` of gap. The first contact may be weaker
than the later ones (`Scenario.first_contact_force_n`); it is over when the tip has
engaged and come off again.
"""

from __future__ import annotations

import math

from perchctl.sim.scenario import Scenario

MAGNET_RADIUS_M = 0.025
MAGNET_RANGE_M = 0.003
MAGNET_TOUCH_M = 0.001


class Magnet:
    """One magnet gear under one ceiling; evaluated once a control period."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._came_off = False
        self.engaged = False
        self.target_xy_m = scenario.target_xy_m
        self.let_go = False  # for good: it pulls no more

    def pull_n(self, tip_m: tuple[float, float, float], *, upright: bool) -> float:
        """The pull on the gear's tip at `tip_m`, world axes."""
        scenario = self._scenario
        gap_m = max(0.0, scenario.ceiling_z_m - tip_m[2])
        target_x, target_y = self.target_xy_m
        miss_m = math.hypot(tip_m[0] - target_x, tip_m[1] - target_y)
        if scenario.no_target or not upright or gap_m >= MAGNET_RANGE_M or miss_m > MAGNET_RADIUS_M:
            return self.out_of_reach()
        self._note(gap_m)
        return 0.0 if self.let_go else self.hold_n * (1.0 - gap_m / MAGNET_RANGE_M) ** 2

    @property
    def hold_n(self) -> float:
        """What it holds at contact, unless it has let go."""
        scenario = self._scenario
        if scenario.first_contact_force_n is not None and not self._came_off:
            return scenario.first_contact_force_n
        return scenario.magnet_force_n

    def out_of_reach(self) -> float:
        """No pull, and none held."""
        self._note(MAGNET_RANGE_M)
        return 0.0

    def _note(self, gap_m: float) -> None:
        if gap_m < MAGNET_TOUCH_M:
            self.engaged = True
        elif self.engaged and gap_m > 2 * MAGNET_TOUCH_M:
            self.engaged = False
            self._came_off = True
