"""Estimate the balance of a vehicle and its motors from a level hover.

The thrust f_i that the firmware demands from each motor follows from the motor's duty cycle, the
battery voltage and the thrust curve. A weak motor delivers less thrust than the firmware demands.
The shares a_i = 4 f_i / (f_1 + f_2 + f_3 + f_4) have a mean of 1 and, on an X frame whose motors
are `MOTOR_OFFSET_M` to the front and to the side, three patterns:

    M4 front left    M1 front right      pitch = (a_1 + a_4 - a_2 - a_3) / 4
               \\    /                    roll  = (a_3 + a_4 - a_1 - a_2) / 4
               /    \\                    yaw   = (a_2 + a_4 - a_1 - a_3) / 4
    M3 back left     M2 back right

- A centre of mass x forward and y left of the middle gives pitch = x / `MOTOR_OFFSET_M` and roll =
  y / `MOTOR_OFFSET_M`. Weaker motors at the front or on the left have the same effect. In free
  flight, the moment from either cause is always proportional to the thrust, so no flight can
  distinguish the two causes.
- In still air, the centre of mass does not affect the yaw pattern, which shows unequal motors or
  propellers, or a tilted motor.
- A draught adds a moment to pitch and roll (`WIND_ARM_M`), as if the centre of mass moved with the
  wind. Because it pushes off-centre (`DRAG_LEVER_M`), it also adds a moment to yaw, where the
  motors have little authority (`YAW_TORQUE_M`). The vehicle leans into a draught, but the
  estimated lean has a bias of the same size. The lean is therefore only used to widen the
  intervals, not to correct the estimate.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from perchctl.geometry import Array
from perchctl.record import FlightLog
from perchctl.sim import thrust_n
from perchctl.vehicle import MOST_CELL_V, MOST_DUTY

MOTOR_OFFSET_M = 0.0325
"""Distance from the middle to a motor, forward and sideways, m: arms of 46 mm at 45 degrees."""
WIND_ARM_M = 0.047
"""Ratio of moment to force in a horizontal draught, m: 0.75e-3 N.m and 0.016 N per m/s, from 104
recorded flights of a Crazyflie 2.1."""
DRAG_LEVER_M = 0.002
"""Distance from the centre of mass at which the force of a draught may act, m, one standard
deviation: an estimate from the usual offset of the centre of mass. Larger: wider intervals for the
yaw imbalance. Smaller: in a draught, the intervals are too narrow."""
YAW_TORQUE_M = 0.006
"""Reaction torque of a motor per unit of thrust, N.m per N."""
UNSEEN_LEAN_RAD = math.radians(0.3)
"""Lean into a draught that the bias of the estimated lean may hide, rad, one standard deviation.
Larger: wider intervals. Smaller: a draught is mistaken for an imbalance."""
HOVER_CLEARANCE_M = 0.3
"""Smallest distance from the floor and from the target at which samples are used, m. Smaller:
ground or ceiling effect disturbs the estimate."""
HOVER_SPEED_MPS = 0.15
"""Largest horizontal speed that counts as a hover, m/s. Larger: more samples, but the airspeed adds
a moment."""
HOVER_CLIMB_MPS = 0.3
"""Largest vertical speed that counts as a hover, m/s; it affects all motors equally."""
HOVER_LEAN_RAD = math.radians(4.0)
"""Largest lean that counts as a hover, rad. Larger: samples in which the vehicle accelerates are
used too."""
SAMPLE_PERIOD_S = 0.1
"""Period of the log packets with duty cycles, s (`perchctl.link.telemetry`, `SLOW_PERIOD_S`)."""
LEAST_SAMPLES = 20
"""Smallest number of samples for an estimate: 2 s of hover. Smaller: more flights have an estimate,
but with wide intervals."""
CORRELATED_SAMPLES = 10
"""Number of samples after which two samples are independent: 1 s, a few oscillations of the
attitude. Larger: the intervals are less certain. Smaller: the intervals are too narrow."""
HARMLESS_SHIFT_M = 0.0025
"""Shift of the centre of mass up to which no advice is given, m: recorded vehicles flew with shifts
of up to 2.4 mm."""
HARMLESS_YAW = 0.06
"""Yaw imbalance up to which no advice is given: one of two recorded vehicles flew with an imbalance
of 0.058, the other with 0.165."""

MOTOR_PLACES = ("front right", "back right", "back left", "front left")
"""Positions of M1..M4."""
_PATTERNS = np.array([(1.0, -1.0, -1.0, 1.0), (-1.0, -1.0, 1.0, 1.0), (-1.0, 1.0, -1.0, 1.0)]) / 4.0
_WAYS = (("forward", "backward"), ("to the left", "to the right"))


@dataclass(frozen=True)
class Trim:
    """The thrust demanded from the motors in level hover. A margin is half the width of a 95 %
    confidence interval.

    Attributes:
        hover_s: total time in hover that the estimate is based on.
        shares: thrust demanded from M1..M4, relative to the mean of the four.
        shift_m: offset of the centre of mass, forward and left, if all motors are equal.
        yaw_imbalance: fraction by which the thrust demanded from the front-left and back-right
            motors exceeds the mean; the other two motors are below the mean by the same fraction.
        advice: sentences with advice; none for a simulated vehicle, or if no interval excludes its
            harmless range.
    """

    hover_s: float
    shares: tuple[float, ...]
    shares_margin: tuple[float, ...]
    shift_m: tuple[float, float]
    shift_margin_m: tuple[float, float]
    yaw_imbalance: float
    yaw_margin: float
    advice: tuple[str, ...] = ()

    @property
    def motors_text(self) -> str:
        """The shares in words, and the data on which they are based."""
        each = ", ".join(
            f"{motor} {_percent(share - 1.0, margin)}"
            for motor, share, margin in zip(
                MOTOR_PLACES, self.shares, self.shares_margin, strict=True
            )
        )
        return f"{each} relative to the mean thrust (95 %, {self.hover_s:.1f} s of level hover)"

    @property
    def balance_text(self) -> str:
        """The shift in words, and the possible causes, which a flight cannot tell apart."""
        parts = zip(self.shift_m, self.shift_margin_m, _WAYS, strict=True)
        return (
            f"centre of mass {' and '.join(_shift(*part) for part in parts)}, if the motors are "
            "equal; weaker motors on that side look the same in flight"
        )

    @property
    def yaw_text(self) -> str:
        """The yaw imbalance in words, for the pair of motors with more thrust, and its possible
        causes."""
        pair, more = _yaw_pair(self.yaw_imbalance)
        return (
            f"{pair} {_percent(more, self.yaw_margin)}; caused by unequal motors or propellers, or "
            "by a tilted motor, not by the centre of mass"
        )


def estimate_trim(log: FlightLog, *, simulated: bool = False) -> Trim | None:
    """Estimate the motors' trim from the level hover in a flight's log.

    A sample is a log packet with duty cycles and voltage, received while the vehicle is in the air,
    slow, level, and away from the floor and the target. The interval takes the noise's
    autocorrelation into account (`mean_and_margin`). The estimate is wrong if the vehicle carries a
    swinging load, and near full duty, where a motor cannot deliver the demanded thrust. The
    estimate uses the thrust curve of a Crazyflie 2.1. At the voltage at which a Brushless of 40 to
    48 g hovers, the relative slopes of the two vehicles' curves agree to 7 %, so a share's
    difference from 1 is also accurate to 7 %.

    Returns None if the vehicle hovered for less than 2 s, or if the log contains no duty cycles
    because an older version of perchctl wrote it. Raises InvalidValue for a value that is not a
    number. `simulated`: give no advice.
    """
    duties = np.stack([log.column(f"duty_m{motor}") for motor in (1, 2, 3, 4)], axis=1)
    volts = log.column("battery_v")
    is_known = np.all(duties <= MOST_DUTY, axis=1) & (volts <= MOST_CELL_V)
    # Each tick contains the newest packet, so successive ticks with identical duty cycles contain
    # the same packet.
    is_new = np.any(np.diff(duties, axis=0, prepend=np.nan) != 0.0, axis=1)
    packets = np.flatnonzero(is_known & is_new)
    motor_v = duties[packets] / MOST_DUTY * volts[packets, np.newaxis]
    asked_n = np.vectorize(thrust_n, otypes=[np.float64])(motor_v)
    is_turning = np.all(asked_n > 0.0, axis=1)  # False while idling on the ground
    packets, asked_n = packets[is_turning], asked_n[is_turning]
    in_hover = _is_hovering(log)[packets]
    if np.count_nonzero(in_hover) < LEAST_SAMPLES:
        return None
    shares = asked_n / np.mean(asked_n, axis=1, keepdims=True)
    lean_rad = [np.mean(log.column(key)[packets][in_hover]) for key in ("pitch_rad", "roll_rad")]
    push = np.hypot(
        lean_rad, UNSEEN_LEAN_RAD
    )  # force of the draught, forward and left, relative to the weight
    draught = [*push * WIND_ARM_M / MOTOR_OFFSET_M, math.hypot(*push) * DRAG_LEVER_M / YAW_TORQUE_M]

    def estimate(series: Array, draught: float) -> tuple[float, float]:
        mean, margin = mean_and_margin(series, in_hover)
        return mean, math.hypot(margin, stats.norm.ppf(0.975) * draught)

    motors = [estimate(share, math.hypot(*draught)) for share in shares.T]
    pitch, roll, yaw = map(estimate, (shares @ _PATTERNS.T).T, draught)
    found = Trim(
        hover_s=round(int(np.count_nonzero(in_hover)) * SAMPLE_PERIOD_S, 1),
        shares=tuple(share for share, _ in motors),
        shares_margin=tuple(margin for _, margin in motors),
        shift_m=(MOTOR_OFFSET_M * pitch[0], MOTOR_OFFSET_M * roll[0]),
        shift_margin_m=(MOTOR_OFFSET_M * pitch[1], MOTOR_OFFSET_M * roll[1]),
        yaw_imbalance=yaw[0],
        yaw_margin=yaw[1],
    )
    return found if simulated else replace(found, advice=tuple(_advice(found)))


def mean_and_margin(series: Array, chosen: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the mean of the chosen values in an evenly sampled series, and half the width of its
    95 % confidence interval.

    The variance of the mean follows Newey and West (Econometrica 55, 1987), with autocovariances up
    to `CORRELATED_SAMPLES` and linearly decreasing weights. In a short series this variance is too
    small; Kiefer and Vogelsang's quantile compensates for this (Econometric Theory 21, 2005, table
    1). The interval is never narrower than Student's for independent values, although attitude
    control makes successive values negatively correlated. The interval is too narrow for noise that
    is correlated over more samples. `chosen`: (n,) booleans, at least `LEAST_SAMPLES` of them True.
    """
    count = int(np.count_nonzero(chosen))
    mean = float(np.mean(series[chosen]))
    off = np.where(chosen, series - mean, 0.0)
    longer = variance = float(np.sum(off**2)) / (count - 1)
    bandwidth = CORRELATED_SAMPLES + 1
    for lag in range(1, bandwidth):
        covariance = float(np.sum(off[lag:] * off[:-lag])) / (count - 1)
        longer += 2.0 * (1.0 - lag / bandwidth) * covariance
    share = min(1.0, bandwidth / count)
    quantile = 1.96 + share * (2.9694 + share * (0.4160 - 0.5324 * share))
    independent = float(stats.t.ppf(0.975, count - 1)) * math.sqrt(variance / count)
    return mean, max(independent, quantile * math.sqrt(max(0.0, longer) / count))


def _is_hovering(log: FlightLog) -> NDArray[np.bool_]:
    """Return for each tick whether the vehicle hovers level in free air."""
    z_m, target_z_m = log.column("z_m"), log.column("tz_m")
    seen_m = target_z_m[np.isfinite(target_z_m)]
    top_m = np.median(seen_m) - HOVER_CLEARANCE_M if seen_m.size else math.inf
    ground_m = z_m[0] if z_m.size else math.nan
    level_mps = np.hypot(log.column("vx_mps"), log.column("vy_mps"))
    lean_rad = np.hypot(log.column("roll_rad"), log.column("pitch_rad"))
    return np.asarray(
        (z_m > ground_m + HOVER_CLEARANCE_M)
        & (z_m < top_m)
        & (level_mps < HOVER_SPEED_MPS)
        & (np.abs(log.column("vz_mps")) < HOVER_CLIMB_MPS)
        & (lean_rad < HOVER_LEAN_RAD)
    )


def _advice(trim: Trim) -> Iterator[str]:
    away = [
        _shift(shift_m, margin_m, ways)
        for shift_m, margin_m, ways in zip(trim.shift_m, trim.shift_margin_m, _WAYS, strict=True)
        if abs(shift_m) - margin_m > HARMLESS_SHIFT_M
    ]
    if away:
        yield (
            f"the vehicle flies as if its centre of mass were {' and '.join(away)}: move the "
            "battery the other way and fly again; if the battery is already in the middle, check "
            "the propellers on that side"
        )
    if abs(trim.yaw_imbalance) - trim.yaw_margin > HARMLESS_YAW:
        pair, more = _yaw_pair(trim.yaw_imbalance)
        yield (
            f"the motors {pair} need {_percent(more, trim.yaw_margin)} thrust to hold the "
            "heading, regardless of the battery's position: check their propellers, and check "
            "that every motor is upright"
        )


def _yaw_pair(imbalance: float) -> tuple[str, float]:
    """Return the pair of motors with the higher demanded thrust, and by how much it is higher."""
    pairs = ("front left and back right", "front right and back left")
    return pairs[imbalance < 0.0], abs(imbalance)


def _shift(shift_m: float, margin_m: float, ways: tuple[str, str]) -> str:
    return f"{1e3 * abs(shift_m):.1f} +- {1e3 * margin_m:.1f} mm {ways[shift_m < 0.0]}"


def _percent(share: float, margin: float) -> str:
    return f"{100.0 * share:+.1f} +- {100.0 * margin:.1f} %"
