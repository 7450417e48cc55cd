"""What is known of how a flight ended: where it met the target, and how hard it met the floor.

Neither needs a simulator: the one is the program's own error, the other is felt.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from perchctl.mission.context import Context
from perchctl.mission.state import Phase

HARD_MPS = 0.6
"""No way down that goes as it should ends faster."""
LATEST_S = 5.0
"""From the touchdown to where the motors were off: what was felt earlier was no floor."""
SAME_HEIGHT_M = 0.3
"""A blow that was felt higher up than where the vehicle is now was none by the floor."""


@dataclass(frozen=True)
class ContactError:
    """Horizontal distance of the gear from the target's axis as contact was proven, and the
    standard deviation of what is known of it."""

    aside_m: float
    sigma_m: float

    @property
    def text(self) -> str:
        return f"{1e3 * self.aside_m:.1f} +- {1e3 * self.sigma_m:.1f} mm off centre"


def contact_error_of(c: Context) -> ContactError | None:
    """Of what hangs; None of what does not, and where the contact was never placed."""
    aside_m, sigma_m = c.state.contact_aside_m, c.state.contact_sigma_m
    if c.state.phase is not Phase.PERCHED or aside_m is None or not math.isfinite(sigma_m):
        return None
    return ContactError(aside_m, sigma_m)


@dataclass(frozen=True)
class Touchdown:
    """The floor was met at that speed, downwards; `peak_g` is the largest acceleration that a
    sample of the telemetry shows, one each 10 ms."""

    speed_mps: float
    peak_g: float

    @property
    def is_hard(self) -> bool:
        return self.speed_mps > HARD_MPS

    @property
    def text(self) -> str:
        """One sentence without its end."""
        how = "touched down hard" if self.is_hard else "touched down"
        return f"{how}: {self.speed_mps:.1f} m/s, {self.peak_g:.1f} g"


def touchdown_of(c: Context) -> Touchdown | None:
    """The newest blow from below, where it may have been the floor's; None where none was felt.

    Its speed is the estimate's where that is believed, else as reckoned by the accelerometer."""
    tel, imu, reckoning = c.obs.telemetry, c.obs.imu, c.state.reckoning
    blow = imu.blow
    if c.state.phase is Phase.PERCHED or min(tel.t_s, imu.off_s) - blow.t_s > LATEST_S:
        return None
    if c.placed and c.state.blind_s is None and blow.z_m - tel.position_m[2] > SAME_HEIGHT_M:
        return None
    by_feel = c.state.blind_s is not None or c.state.astray
    speed_mps = -(reckoning.struck_mps if by_feel else blow.estimated_mps)
    return Touchdown(max(0.0, speed_mps), blow.peak_g)
