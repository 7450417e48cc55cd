"""Your own link: here to a toy that follows setpoints, so that no radio is needed.

Fly it by `fly(profile, "own_link:Toy", "own_camera:UdpCamera")`. A real link hands each command to
its radio in `send`, and `telemetry` returns what has come down.
"""

from collections.abc import Callable

import numpy as np

from perchctl.vehicle import AUTO_ARM, CAN_FLY, FLYING, Command, Land, PositionSetpoint, Telemetry

PERIOD_S, SPEED_MPS, THRUST = 0.01, 0.5, 38000.0
READY = CAN_FLY | AUTO_ARM  # it arms itself


class Toy:
    """A `perchctl.VehicleLink`; made with the loop's clock and the profile's section `link`."""

    def __init__(self, clock: Callable[[], float], config: object) -> None:
        self._clock = clock
        self._sampled_s = clock()
        self._place = self._goal = np.zeros(3)  # in its world, x y z, m
        self._flies = self._lands = False

    def connect(self) -> None:
        self._sampled_s = self._clock()

    def decks(self) -> tuple[str, ...]:
        return ("bcFlow2",)  # it measures its position itself

    def telemetry(self) -> list[Telemetry]:
        samples = []
        while self._clock() - self._sampled_s >= PERIOD_S:
            self._sampled_s += PERIOD_S
            samples.append(self._step(SPEED_MPS * PERIOD_S))
        return samples

    def send(self, command: Command) -> None:
        self._flies = self._lands = isinstance(command, Land)
        if isinstance(command, PositionSetpoint):
            self._flies = True
            self._goal = np.array([command.x_m, command.y_m, command.z_m])
        elif isinstance(command, Land):
            self._goal = self._place * (1.0, 1.0, 0.0)

    def problem(self, now_s: float) -> str | None:
        return None

    def close(self) -> None:
        return None

    def _step(self, max_m: float) -> Telemetry:
        move_m = np.clip(self._goal - self._place, -max_m, max_m) * self._flies
        self._place = self._place + move_m
        (x, y, z), (vx, vy, vz) = self._place.tolist(), (move_m / PERIOD_S).tolist()
        self._flies = self._flies and not (self._lands and z < 0.01)
        bits, thrust = READY | FLYING * self._flies, THRUST * self._flies
        return Telemetry(
            t_s=self._sampled_s,
            position_m=(x, y, z),
            velocity_mps=(vx, vy, vz),
            roll_rad=0.0,
            pitch_rad=0.0,
            yaw_rad=0.0,
            acc_z_g=1.0,
            thrust=thrust,
            battery_v=4.0,
            supervisor=bits,
            height_variance_m2=1e-6,
            velocity_variance_m2ps2=1e-6,
        )
