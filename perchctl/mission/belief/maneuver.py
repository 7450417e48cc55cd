"""Describe the maneuver that the planner flies: the context in which the belief reads its
evidence."""

from __future__ import annotations

from dataclasses import dataclass

from perchctl.mission.belief.motion import Vector
from perchctl.values import replace
from perchctl.vehicle import PositionSetpoint


@dataclass(frozen=True, kw_only=True)
class Maneuver:
    """The purpose of the flight in this phase, as far as the evidence depends on it.

    The same reading has different meanings in different maneuvers: a motionless vehicle at low
    thrust hangs after a press, but stands on the floor in a descent. Each phase declares its
    maneuver; the belief knows no phases.

    Attributes:
        in_free_air: nothing but air should touch the vehicle. The belief learns the velocity bias
            and checks the mounting, and a stale position makes the vehicle hold (`hold_reason`).
        is_camera_guided: the camera guides the vehicle. Old telemetry, a jump of the estimate, a
            large variance or a late loop make it hold.
        needs_pictures: the vehicle must not continue without pictures; an old picture makes it
            hold.
        learns_hover_thrust: the vehicle flies quietly, so that its thrust measures hover thrust.
        climbs_to_target: the vehicle climbs to the target. Close to the target, hover thrust is not
            learned because the ground effect of the ceiling supports part of the weight.
        presses: the vehicle is meant to touch the target. With the target alone, the position of
            the last sighting may prove a contact. Such a maneuver is neither in free air nor guided
            by the camera, so that no hold applies: it would leave the vehicle pressed.
        retreats: the vehicle leaves the position where an attempt ended. If something still holds
            it there, its offset from the target is that of the last touch.
        descends: the vehicle descends. If something supports it, it hangs if it is still where the
            descent began, and stands on the floor if it has come down.
    """

    in_free_air: bool = False
    is_camera_guided: bool = False
    needs_pictures: bool = False
    learns_hover_thrust: bool = False
    climbs_to_target: bool = False
    presses: bool = False
    retreats: bool = False
    descends: bool = False


@dataclass(frozen=True, kw_only=True)
class SentOrders:
    """The orders that the planner has sent so far; the belief knows no other state of the
    planner.

    Times are on the loop's clock; positions are in the world frame of the state estimate.
    """

    maneuver: Maneuver
    maneuver_start_m: Vector = (0.0, 0.0, 0.0)  # position where the maneuver began
    setpoint: PositionSetpoint | None = None
    raw_thrust: int | None = None  # last order; None in position mode
    release_began_s: float | None = None  # start of the release by raw thrust
    motor_stop_ordered_at_s: float | None = None  # first order to stop the motors
    # time at which a descent by raw thrust detected the floor
    floor_detected_at_s: float | None = None

    @property
    def is_level_descent(self) -> bool:
        """True while the vehicle descends by raw thrust with its motors turning."""
        return self.maneuver.descends and self.raw_thrust is not None and self.is_under_power

    @property
    def is_under_power(self) -> bool:
        """True until raw thrust begins to transfer the vehicle's weight to the magnet (the
        release), or the motors are ordered to stop."""
        return self.release_began_s is None and self.motor_stop_ordered_at_s is None

    def with_frame_shift(
        self, shifted_setpoint: PositionSetpoint | None, by_m: Vector
    ) -> SentOrders:
        """Return the same orders after the estimate's world frame has moved by `by_m`: the position
        at which the maneuver began is shifted by it, and the setpoint is `shifted_setpoint`, which
        is in the new frame."""
        x, y, z = self.maneuver_start_m
        return replace(
            self,
            setpoint=shifted_setpoint,
            maneuver_start_m=(x + by_m[0], y + by_m[1], z + by_m[2]),
        )
