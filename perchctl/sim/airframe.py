"""The airframes of simulated vehicles: their firmware's device type and parameters, and their
motors.

Figures are the firmware's own platform defaults (release 2026.08), measured on a thrust stand; each
build of the firmware is for one airframe.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class ThrustCurve:
    """The thrust of one motor as a function of its mean voltage, which is duty cycle times battery
    voltage.

    Attributes:
        coefficients: coefficients of the cubic polynomial in that voltage: N, N/V, N/V^2, N/V^3.
        most_n: thrust at the full command.
        least_n: a command below this gives no thrust.
    """

    coefficients: tuple[float, float, float, float]
    most_n: float
    least_n: float


@dataclass(frozen=True)
class Airframe:
    """A kind of vehicle.

    Attributes:
        device_type: the name that its firmware announces.
        thrust: thrust curve of one motor.
        arms_itself: True if it needs no arming request (auto-arming).
        idle_pwm: smallest duty cycle of each motor while the vehicle is armed, 0..65535; 0 if it
            arms itself.
        spin_up_s: time from the arming request until its motors turn steadily enough to fly; if
            that takes longer than 2 s, the firmware disarms the vehicle.
        thrust_base: its height controller's guess of the hover thrust, 0..65535.
        rate_gains: its controller's gains for roll and pitch rate (P, I, D).
        parameters: firmware parameters that differ from a Crazyflie 2.1's at boot.
    """

    device_type: str
    thrust: ThrustCurve
    arms_itself: bool = True
    idle_pwm: float = 0.0
    spin_up_s: float = 0.0
    thrust_base: float = 36000.0
    rate_gains: tuple[float, float, float] = (250.0, 500.0, 2.5)
    parameters: dict[str, float] = field(default_factory=dict)


CRAZYFLIE_21 = Airframe(
    "Crazyflie 2.1",
    ThrustCurve(
        (
            -0.02476537915958403,
            0.06523793527519485,
            -0.026792504967750107,
            0.006776789303971145,
        ),
        most_n=0.12,
        least_n=0.012817578393224994,
    ),
)
"""With the propellers of the 2.1+; the firmware has the same name for both."""

CRAZYFLIE_21_BRUSHLESS = Airframe(
    "Crazyflie 2.1 Brushless",
    ThrustCurve(
        (
            -0.014058926705279723,
            0.04265273261724981,
            0.0018327760144017432,
            0.0020576974784587178,
        ),
        most_n=0.2,
        least_n=0.02136263065537499,
    ),
    arms_itself=False,
    idle_pwm=7000.0,
    spin_up_s=0.3,
    thrust_base=30000.0,
    rate_gains=(200.0, 400.0, 2.5),
    parameters={"pm.lowVoltage": 3.35, "posCtlPid.thrustBase": 30000.0},
)
