"""What the planner has the vehicle do: the context in which its evidence is read."""

from __future__ import annotations

from dataclasses import dataclass

from perchctl.mission.belief.motion import Vector
from perchctl.values import replace
from perchctl.vehicle import PositionSetpoint


@dataclass(frozen=True, kw_only=True)
class Maneuver:
    """What the vehicle is flown to do, as far as evidence depends on it.

    The same reading means something else in another maneuver: a vehicle that stands still on little
    thrust hangs after a press, and stands on the floor in a descent. Each phase declares its
    maneuver; the belief knows no phases.

    Attributes:
        in_the_open: nothing but air should touch the vehicle. The velocity's bias and the mounting
            are learned, and a stale position holds it (`hold_reason`).
        by_camera: it is moved by what the camera sees. Old telemetry, a jump of the estimate, a
            large variance or a late loop hold it.
        needs_pictures: it must not go on without them: so does an old picture.
        learns_hover: it flies quietly, so that its thrust teaches the hover thrust.
        nears_target: it climbs up to the target, near which hover thrust is not learned: the air
            under the ceiling carries a part of it.
        presses: it is meant to touch the target. By the target alone a contact may be proven by the
            place of the last sighting. Nothing holds it: a hold would leave it pressed.
        retreats: it moves away from where an attempt ended, so that the last touch still counts.
        descends: it comes down. What carries it may be the floor, and hanging is told from standing
            by where it began.
    """

    in_the_open: bool = False
    by_camera: bool = False
    needs_pictures: bool = False
    learns_hover: bool = False
    nears_target: bool = False
    presses: bool = False
    retreats: bool = False
    descends: bool = False


@dataclass(frozen=True, kw_only=True)
class Sent:
    """What the planner has ordered until now, all that the belief knows of it.

    Times are on the loop's clock, places in the world of the state estimate.
    """

    maneuver: Maneuver
    began_m: Vector = (0.0, 0.0, 0.0)  # where the maneuver began
    setpoint: PositionSetpoint | None = None
    raw_thrust: int | None = None  # ordered last; None in position mode
    released_s: float | None = None  # begin of the release by raw thrust
    stopped_s: float | None = None  # first order to stop the motors
    floor_felt_s: float | None = None  # a descent by thrust felt the floor

    @property
    def is_level_descent(self) -> bool:
        """True while it comes down by raw thrust, its motors turning."""
        return self.maneuver.descends and self.raw_thrust is not None and self.is_motor_borne

    @property
    def is_motor_borne(self) -> bool:
        """True until the release by raw thrust begins or the motors are stopped."""
        return self.released_s is None and self.stopped_s is None

    def moved(self, setpoint: PositionSetpoint | None, by_m: Vector) -> Sent:
        """The same orders after the estimate's world has moved, with the setpoint that is left."""
        x, y, z = self.began_m
        return replace(self, setpoint=setpoint, began_m=(x + by_m[0], y + by_m[1], z + by_m[2]))
