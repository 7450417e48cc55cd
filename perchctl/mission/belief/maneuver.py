"""Describe the maneuver that the planner flies: the context in which the belief interprets its
evidence."""

from __future__ import annotations

from dataclasses import dataclass

from perchctl.mission.belief.motion import Vector
from perchctl.values import replace
from perchctl.vehicle import PositionSetpoint


@dataclass(frozen=True, kw_only=True)
class Maneuver:
    """What the vehicle is meant to do in a phase, as far as this affects how evidence is
    interpreted.

    The same reading has different meanings in different maneuvers: a motionless vehicle at low
    thrust is hanging after a press, but is on the floor in a descent. Each phase declares its
    maneuver, so the belief does not need to know the phase.

    Attributes:
        is_in_free_air: nothing but air should touch the vehicle. The belief learns the velocity
            bias and checks the mounting, and a stale position makes the vehicle hold
            (`hold_reason`).
        is_camera_guided: the camera guides the vehicle. Old telemetry, a jump of the estimate, a
            large variance or a late loop make it hold.
        requires_pictures: the vehicle must not continue without pictures; an old picture makes it
            hold.
        learns_hover_thrust: the vehicle flies quietly, so that its thrust measures hover thrust.
        climbs_to_target: the vehicle climbs to the target. Close to the target, hover thrust is not
            learned because the ground effect of the ceiling supports part of the weight.
        presses_against_target: the vehicle is meant to touch the target. With the target as the
            only position source, a contact may be proven without a valid position, by dead
            reckoning since the last sighting. Such a maneuver is neither in free air nor guided by
            the camera, so no hold applies: a hold would leave the vehicle pressed.
        retreats_after_attempt: the vehicle leaves the position where an attempt ended. If something
            is still holding the vehicle there, its offset from the target is the offset of the last
            touch.
        descends_to_floor: the vehicle descends. A supported vehicle is hanging if it is still where
            the descent began, and is on the floor if it has come down.
    """

    is_in_free_air: bool = False
    is_camera_guided: bool = False
    requires_pictures: bool = False
    learns_hover_thrust: bool = False
    climbs_to_target: bool = False
    presses_against_target: bool = False
    retreats_after_attempt: bool = False
    descends_to_floor: bool = False


@dataclass(frozen=True, kw_only=True)
class CommandHistory:
    """The commands that the planner has sent so far. The belief knows nothing else about the
    planner.

    Times are on the loop's clock, and None until the command or event has happened; positions are
    in the world frame of the state estimate. `setpoint` is None if none applies, and
    `commanded_raw_thrust` (0..65535) is None in position mode. `floor_detected_at_s` is the time at
    which a descent by raw thrust detected the floor.
    """

    maneuver: Maneuver
    maneuver_start_position_m: Vector = (0.0, 0.0, 0.0)  # position where the maneuver began
    setpoint: PositionSetpoint | None = None
    commanded_raw_thrust: int | None = None  # last command; None in position mode
    weight_transfer_began_at_s: float | None = None  # start of the transfer by raw thrust
    motor_stop_commanded_at_s: float | None = None  # first command to stop the motors
    # time at which a descent by raw thrust detected the floor
    floor_detected_at_s: float | None = None

    @property
    def is_descending_by_raw_thrust(self) -> bool:
        """True while the vehicle descends by raw thrust with its motors turning."""
        return (
            self.maneuver.descends_to_floor
            and self.commanded_raw_thrust is not None
            and self.is_before_weight_transfer_and_motor_stop
        )

    @property
    def is_before_weight_transfer_and_motor_stop(self) -> bool:
        """True until raw thrust begins to transfer the vehicle's weight to the magnet (the second
        stage of the release) or the motors are commanded to stop."""
        return self.weight_transfer_began_at_s is None and self.motor_stop_commanded_at_s is None

    def with_frame_shift(
        self, setpoint_in_new_frame: PositionSetpoint | None, shift_m: Vector
    ) -> CommandHistory:
        """Return the same commands after the estimate's coordinates have jumped by `shift_m` (new =
        old + shift). `shift_m` is added to the maneuver's start position, and the setpoint becomes
        `setpoint_in_new_frame`."""
        x, y, z = self.maneuver_start_position_m
        return replace(
            self,
            setpoint=setpoint_in_new_frame,
            maneuver_start_position_m=(x + shift_m[0], y + shift_m[1], z + shift_m[2]),
        )
