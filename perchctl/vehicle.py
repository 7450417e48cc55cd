"""Types that planner, link, simulator and log share: telemetry and commands."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

# Supervisor bits (docs/firmware.md, "Supervisor").
CAN_ARM, ARMED, AUTO_ARM, CAN_FLY, FLYING, TUMBLED, LOCKED, CRASHED = (1 << i for i in range(8))
HL_ACTIVE, HL_FINISHED, HL_DISABLED, DECK_FAULT = (1 << i for i in range(8, 12))

LOW_POWER = 3  # pm.state
FULL_THRUST = 65535
NO_BATTERY_READING_V = 1.0
"""Below this nothing is measured: the battery is unknown, not empty (fault 7)."""
MOST_CELL_V = 5.0
"""No single cell has more: above this nothing is measured either."""


@dataclass(frozen=True)
class Telemetry:
    """The vehicle's newest state, SI and right-handed (see `perchctl.geometry`).

    `t_s` is on the loop's clock; `thrust` is the commanded 0..65535; `acc_x_g`, `acc_y_g` and
    `acc_z_g` are the specific force along the body's axes (0, 0, +1 at rest on the ground).
    `behind_s`: by how much position and velocity, which come by a packet of their own, are older
    than `t_s`. `start`: how often the vehicle has started anew since it was first heard.
    """

    t_s: float
    position_m: tuple[float, float, float]
    velocity_mps: tuple[float, float, float]
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    acc_z_g: float
    thrust: float
    battery_v: float
    supervisor: int
    battery_state: int = 0  # pm.state; 3 = low power
    position_variance_m2: float | None = None  # largest of the estimator's three
    climb_variance_m2ps2: float | None = None  # of the estimated vertical speed
    behind_s: float = 0.0
    acc_x_g: float = 0.0
    acc_y_g: float = 0.0
    start: int = 0

    def has_bit(self, supervisor_bit: int) -> bool:
        return bool(self.supervisor & supervisor_bit)


# --- What a vehicle may be doing, by its newest telemetry: what is old is unknown, and what is
# unknown counts as flying. By it a link is left, and a rescue and the watchdog land.


FRESH_S = 0.3
"""Telemetry that is older says nothing of the motors."""


def is_fresh(newest: Telemetry | None, now_s: float) -> bool:
    """True if the newest telemetry is at most `FRESH_S` old."""
    return newest is not None and now_s - newest.t_s <= FRESH_S


def has_fresh_position(newest: Telemetry | None, now_s: float) -> bool:
    """True if telemetry is fresh with position and velocity, which come by their own packet."""
    if newest is None or now_s - newest.t_s + newest.behind_s > FRESH_S:
        return False
    return all(math.isfinite(v) for v in (*newest.position_m, *newest.velocity_mps))


def may_be_flying(newest: Telemetry | None, now_s: float) -> bool:
    """True if a zero setpoint could drop the vehicle, or lock it: the flying bit outlives
    the motors by 2 s (docs/firmware.md, "When setpoints stop")."""
    return newest is None or not is_fresh(newest, now_s) or newest.has_bit(FLYING)


def is_emergency_stopped(newest: Telemetry | None, now_s: float) -> bool:
    """True if an emergency stop took effect: locked, with the motors off."""
    if newest is None or not is_fresh(newest, now_s):
        return False
    return newest.has_bit(LOCKED) and newest.thrust < 1


@dataclass(frozen=True)
class ExternalPosition:
    """The vehicle's position as measured from outside, for its estimator; not a command.

    `position_m` is in the world of the state estimate. `quaternion` (w, x, y, z) turns body axes
    to world axes; None where only the position is known.
    """

    position_m: tuple[float, float, float]
    quaternion: tuple[float, float, float, float] | None = None


SendPosition = Callable[[ExternalPosition], object]
"""Sends one to the vehicle's estimator; returns False where it did not go out."""

POSITION_DECKS = ("bcFlow2", "bcFlow", "bcLighthouse4", "bcLoco", "bcDWM1000")
"""Those that measure a position, or a speed over ground, by the firmware's `deck` parameters."""


@dataclass(frozen=True)
class Idle:
    """Send nothing (on the ground, or while the vehicle lands by itself)."""


@dataclass(frozen=True)
class PositionSetpoint:
    """Absolute position of the body in the world of the state estimate."""

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float


@dataclass(frozen=True)
class RawThrust:
    """A raw thrust 0..65535 at an attitude, level by default, without position control.

    Roll to the right and pitch nose down are positive, as in telemetry.
    """

    thrust: int
    roll_rad: float = 0.0
    pitch_rad: float = 0.0


@dataclass(frozen=True)
class StopMotors:
    """Stop setpoint followed by the notify that keeps the supervisor from locking."""


@dataclass(frozen=True)
class Land:
    """High-level landing to `height_m` in the world: sent once, then flown by the vehicle alone."""

    height_m: float
    duration_s: float


@dataclass(frozen=True)
class EmergencyStop:
    """Cut the motors now and lock: the operator's order, or a useless attitude."""


Command = Idle | PositionSetpoint | RawThrust | StopMotors | Land | EmergencyStop


def is_battery_reading(volts: float) -> bool:
    """True if a battery cell can have that voltage; False for NaN."""
    return NO_BATTERY_READING_V <= volts <= MOST_CELL_V
