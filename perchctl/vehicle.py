"""Types shared by planner, link, simulator and log: telemetry and commands."""

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
"""Voltage below which a reading means that nothing was measured: the battery is unknown, not empty
(fault 7)."""
MOST_CELL_V = 4.4
"""Largest possible voltage of a single cell: a full high-voltage cell rests at 4.35 V, and readings
have an error of 1 %. A higher reading prevents take-off, and is ignored in flight."""

MOST_DUTY = 65535
"""Full duty cycle of a motor: the firmware counts in steps of 1 / 65535."""
AIRFRAMES = ("Crazyflie 2.0", "Crazyflie 2.1", "Crazyflie 2.1+", "Crazyflie 2.1 Brushless")
"""Device types, by the firmware's names, for which perchctl's thrust and battery figures hold
(docs/hardware.md, "Which vehicles")."""
DISARM_IT = (
    "keep away from its propellers, end the program that armed it, or wait 30 s until it disarms "
    "itself"
)
"""Advice for a vehicle that another program has armed."""


@dataclass(frozen=True)
class Telemetry:
    """The vehicle's newest state, SI and right-handed (see `perchctl.geometry`).

    `t_s` is on the loop's clock; `thrust` is the commanded thrust, 0..65535; `acc_x_g`, `acc_y_g`
    and `acc_z_g` are the specific force along the body's axes (0, 0, +1 at rest on the ground).
    `behind_s` is how much older than `t_s` the position and velocity are, which arrive in a
    separate packet; `battery_behind_s` and `variance_behind_s` are the same for the battery and the
    variances, and infinite before their first packet. `start` is the number of times that the
    vehicle has restarted since its first packet arrived.

    The variances are those reported by the vehicle's estimator; None if it reports none. With a
    deck that only measures the speed over ground, as a Flow deck does, nothing measures the
    horizontal position, and `position_variance_m2` stays at 100 m^2 (docs/firmware.md,
    "Variances"); only `height_variance_m2` is meaningful then.

    `motor_duty` is the duty cycle of M1 (front right), M2 (back right), M3 (back left) and M4
    (front left), 0..65535, as old as the battery reading; None if the vehicle does not report it.
    No decision in a flight depends on `motor_duty`.
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
    position_variance_m2: float | None = None  # of the estimated position: largest of three axes
    climb_variance_m2ps2: float | None = None  # of the estimated speed along the body's z axis
    behind_s: float = 0.0
    acc_x_g: float = 0.0
    acc_y_g: float = 0.0
    start: int = 0
    battery_behind_s: float = 0.0
    variance_behind_s: float = 0.0
    velocity_variance_m2ps2: float | None = None  # of the estimated velocity: largest of three axes
    height_variance_m2: float | None = None  # of the estimated height
    motor_duty: tuple[int, int, int, int] | None = None

    def has_bit(self, supervisor_bit: int) -> bool:
        return bool(self.supervisor & supervisor_bit)


# --- The vehicle's state according to its newest telemetry. If the telemetry is old, the state is
# unknown, and the vehicle counts as flying. Closing the link, the rescue and the watchdog depend on
# this state.


FRESH_S = 0.3
"""Age above which telemetry no longer shows whether the motors are running, s."""


def is_fresh(newest: Telemetry | None, now_s: float) -> bool:
    """True if the newest telemetry is at most `FRESH_S` old."""
    return newest is not None and now_s - newest.t_s <= FRESH_S


def has_fresh_position(newest: Telemetry | None, now_s: float) -> bool:
    """True if telemetry is fresh, including position and velocity, which arrive in a separate
    packet."""
    if newest is None or now_s - newest.t_s + newest.behind_s > FRESH_S:
        return False
    return all(math.isfinite(v) for v in (*newest.position_m, *newest.velocity_mps))


def may_be_flying(newest: Telemetry | None, now_s: float) -> bool:
    """True if a zero setpoint could drop the vehicle, or lock it. The flying bit stays set for 2 s
    after the motors stop (docs/firmware.md, "When setpoints stop")."""
    return newest is None or not is_fresh(newest, now_s) or newest.has_bit(FLYING)


def is_disarmed(newest: Telemetry) -> bool:
    """True if the vehicle is waiting for an arming request: it does not arm itself, its motors are
    off, and nothing else prevents flight (docs/firmware.md, "Arming")."""
    return newest.has_bit(CAN_ARM) and not newest.has_bit(ARMED | AUTO_ARM)


def is_armed_by_request(supervisor: int) -> bool:
    """True if a vehicle that does not arm itself is armed according to the supervisor's bits. The
    propellers of such a vehicle turn even on the ground."""
    return bool(supervisor & ARMED) and not supervisor & AUTO_ARM


def is_emergency_stopped(newest: Telemetry | None, now_s: float) -> bool:
    """True if an emergency stop took effect: locked, with the motors off."""
    if newest is None or not is_fresh(newest, now_s):
        return False
    return newest.has_bit(LOCKED) and newest.thrust < 1


@dataclass(frozen=True)
class ExternalPosition:
    """The vehicle's position as measured by an external system, for the vehicle's estimator; not a
    command.

    `position_m` is in the world of the state estimate. `quaternion` (w, x, y, z) rotates body axes
    to world axes; None if only the position is known.
    """

    position_m: tuple[float, float, float]
    quaternion: tuple[float, float, float, float] | None = None


SendPosition = Callable[[ExternalPosition], object]
"""Sends an external position to the vehicle's estimator; returns False if it was not sent."""

FLOW_DECKS = ("bcFlow2", "bcFlow")
"""Decks that measure the speed over ground and the height, by the names of the firmware's `deck`
parameters."""
ABSOLUTE_DECKS = ("bcLighthouse4", "bcLoco", "bcDWM1000")
"""Decks that measure the position."""
POSITION_DECKS = (*FLOW_DECKS, *ABSOLUTE_DECKS)


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
    """A stop setpoint, followed by the notify message that prevents the supervisor from locking."""


@dataclass(frozen=True)
class Land:
    """High-level landing to `height_m` in the world: sent once, then carried out by the
    firmware."""

    height_m: float
    duration_s: float


@dataclass(frozen=True)
class EmergencyStop:
    """Cut the motors now and lock the vehicle: on the operator's command, or if the attitude is
    unusable."""


@dataclass(frozen=True)
class Arm:
    """Arm a vehicle that does not arm itself, or disarm it; on the ground only.

    While it is armed, its propellers turn (docs/firmware.md, "Idle propellers"). Disarming it in
    the air cuts the motors.
    """

    armed: bool


Command = Idle | PositionSetpoint | RawThrust | StopMotors | Land | EmergencyStop | Arm


def is_battery_reading(volts: float) -> bool:
    """True if this is a possible voltage of a battery cell; False for NaN."""
    return NO_BATTERY_READING_V <= volts <= MOST_CELL_V
