"""Land without the flight loop: the watchdog acts if the loop is silent, and the rescue after an
error.

The watchdog decides what the link sends (`Link.set_guard`), in a thread that a hanging loop cannot
block. Before the loop's first tick the vehicle is not flying, and the watchdog only obeys the
operator's command: it cuts the motors or disarms. After `REPEAT_AFTER_S` of silence, the watchdog
holds the last position, but never a position above the vehicle, so that the vehicle neither climbs
nor presses against the ceiling. The exception is a vehicle that is sinking: it keeps a setpoint
above its own position, which slows its descent. The lander of `perchctl.mission` takes over after
`safety.loop_late_land_s`, on the operator's command, or if the vehicle was already descending or
its weight was already on the magnet. With decks or motion capture, the lander commands the
firmware's own landing at once, three to six times, because a late loop cannot steer. With the
target as the only position source, the vehicle descends level.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from perchctl.flight.clock import Clock
from perchctl.flight.preflight import disarm_on_word
from perchctl.link import Link
from perchctl.mission import (
    Observation,
    OperatorRequest,
    Phase,
    PlannerState,
    RestState,
    RestStateReport,
    SentCommand,
    VisualInertialMotion,
    report_rest_state,
    step_landing,
)
from perchctl.perception import History, add_samples
from perchctl.profile import Profile
from perchctl.values import replace
from perchctl.vehicle import (
    Command,
    EmergencyStop,
    Idle,
    PositionSetpoint,
    RawThrust,
    Telemetry,
    has_fresh_position,
    is_emergency_stopped,
)

REPEAT_AFTER_S = 0.3  # the vehicle levels out by itself at 0.5 s
# time in which the loop can still obey the operator's stop itself, so that the log contains it
STOP_AFTER_S = 0.1
CUT_PERIOD_S, MAX_CUTS = 0.1, 50
RESCUE_SINK_MPS = -0.1
RESCUE_STILL_MPS = 0.06
LOOK_S = 0.5  # a rescue ends once telemetry has shown the motors off for this long


@dataclass(frozen=True, eq=False)
class LastTick:
    """The last tick of the loop whose command was sent."""

    next_due_s: float  # when the next tick is due; the loop's lateness is measured from this time
    state: PlannerState
    command: Command  # the last setpoint that was sent
    obs: Observation


class Watchdog:
    """Decides what the link sends while the loop is silent: its `poll` is the link's guard.

    `tick`, `note_rescue` and `end` are called by the loop's thread, `poll` by the link's. Each
    field is written by only one of the two threads, so no lock is needed.

    `position_age_s` returns the age of the newest external position at a given time. `overruled_s`
    is how late the loop was when the watchdog began a landing in its place; 0 if it never did.
    """

    def __init__(
        self,
        profile: Profile,
        operator: Callable[[], OperatorRequest],
        position_age_s: Callable[[float], float] = lambda now_s: 0.0,
    ) -> None:
        self._profile = profile
        self._operator = operator
        self._position_age_s = position_age_s
        self._on_ground = disarm_on_word(operator)
        # Written by the loop's thread:
        self._last: LastTick | None = None
        self._streamed: Command | None = None
        self._loop_has_cut = False
        self._closing = False
        self._motors_off = False
        # Written by the link's thread:
        self.overruled_s = 0.0
        self._cut_ordered = False
        self._cut_s, self._cuts = -CUT_PERIOD_S, 0
        self._history: History | None = None
        self._held: PositionSetpoint | None = None
        self._way_down: PlannerState | None = None

    # --- the loop's side ---

    def tick(
        self, next_due_s: float, state: PlannerState, command: Command, obs: Observation
    ) -> None:
        """Record a tick whose command is being sent. The next tick is due at `next_due_s`."""
        if isinstance(command, (PositionSetpoint, RawThrust)):
            self._streamed = command
        if isinstance(command, EmergencyStop):
            self._loop_has_cut = True
        self._last = LastTick(next_due_s, state, self._streamed or command, obs)

    def note_rescue(self) -> None:
        """Record that the loop has ended with an error. From then on, `poll` only obeys the
        operator's stop."""
        self._closing = True

    def end(self, *, motors_off: bool) -> None:
        """Record that the flight is over. `motors_off` is True if the motors are known to be
        off."""
        self._closing, self._motors_off = True, motors_off

    @property
    def state(self) -> PlannerState | None:
        """The planner's state after the last tick that was sent; None before the first."""
        return None if self._last is None else self._last.state

    # --- the link's side ---

    def poll(
        self, now_s: float, newest: Telemetry | None, waiting: Sequence[Telemetry] = ()
    ) -> Command | None:
        """Return the command to send in the loop's place, or None. `waiting` are the unread
        telemetry samples."""
        last = self._last
        if self._loop_has_cut or self._cut_ordered:
            return self._cut(now_s, newest)
        operator = self._operator()
        if last is None:
            return self._before_first_tick(operator, now_s, newest)
        if self._motors_off:
            return None
        silent_s = now_s - last.obs.t_s
        if operator is OperatorRequest.CUT_MOTORS and (self._closing or silent_s > STOP_AFTER_S):
            self._cut_ordered = True
            return self._cut(now_s, newest)
        if self._closing:
            return None
        if silent_s < REPEAT_AFTER_S:
            self._history = self._held = self._way_down = None
            return None
        late_s = now_s - last.next_due_s
        overruled = (
            operator is OperatorRequest.LAND or late_s > self._profile.safety.loop_late_land_s
        )
        if overruled:
            self.overruled_s = max(self.overruled_s, late_s)
        obs = self._observed(now_s, last, newest, waiting)
        if overruled or self._way_down is not None or _is_on_its_way_down(last.state):
            return self._land(obs, last)
        return self._hold(now_s, last, newest)

    def _before_first_tick(
        self, operator: OperatorRequest, now_s: float, newest: Telemetry | None
    ) -> Command | None:
        """Obey the operator's command if the loop's first iteration hangs or fails, so that the
        loop does not read it. That iteration may already have sent its own command. A stop
        therefore cuts the motors, and a landing disarms the vehicle only on the ground."""
        if operator is OperatorRequest.CUT_MOTORS:
            self._cut_ordered = True
            return self._cut(now_s, newest)
        return self._on_ground(now_s, newest)

    def _cut(self, now_s: float, newest: Telemetry | None) -> Command | None:
        """Return the emergency stop until telemetry shows that the vehicle is locked, with a
        timeout."""
        due = now_s - self._cut_s >= CUT_PERIOD_S - 1e-9
        if is_emergency_stopped(newest, now_s) or not due or self._cuts >= MAX_CUTS:
            return None
        self._cut_s, self._cuts = now_s, self._cuts + 1
        return EmergencyStop()

    def _observed(
        self,
        now_s: float,
        last: LastTick,
        newest: Telemetry | None,
        waiting: Sequence[Telemetry],
    ) -> Observation:
        if self._history is None:
            self._history = History((last.obs.telemetry,), imu=last.obs.imu)
        new = [*waiting, *([] if newest is None else [newest])]
        self._history = history = add_samples(self._history, new, self._profile.safety)
        age_s = self._position_age_s(now_s)
        if self._profile.positioning.source.is_target:  # only the loop sends positions
            age_s = last.obs.external_position_age_s + now_s - last.obs.t_s
        return Observation(
            t_s=now_s,
            telemetry=history.newest or last.obs.telemetry,
            has_estimated_position_jumped=history.jumped,
            heading_jump_rad=history.turned_rad,
            tick_start_delay_s=now_s - last.obs.t_s,
            external_position_age_s=age_s,
            imu=history.imu,
            visual_inertial_motion=last.obs.visual_inertial_motion,
            camera_imu_mismatch=last.obs.camera_imu_mismatch,
        )

    def _land(self, obs: Observation, last: LastTick) -> Command | None:
        state = self._way_down or last.state
        self._way_down, command = step_landing(state, obs, self._profile)
        return None if isinstance(command, Idle) else command

    def _hold(self, now_s: float, last: LastTick, newest: Telemetry | None) -> Command | None:
        known = newest if has_fresh_position(newest, now_s) else None
        if self._held is None and known is not None:
            match last.command:
                case RawThrust(thrust) if abs(known.velocity_mps[2]) < RESCUE_STILL_MPS:
                    return RawThrust(thrust)  # other modes would not press against the ceiling
                case PositionSetpoint(z_m=z_m):
                    if z_m > known.position_m[2] and known.velocity_mps[2] < RESCUE_SINK_MPS:
                        return last.command
        if not isinstance(last.command, (PositionSetpoint, RawThrust)):
            return None
        if self._held is None:
            self._held = _held_place(last, known)
        return self._held


def _is_on_its_way_down(state: PlannerState) -> bool:
    """True while the vehicle descends, and also while its weight is on the magnet, because the
    monitored release continues."""
    return state.phase is Phase.LANDING or (
        state.phase is Phase.COMPLETE
        and (
            state.weight_transfer_began_at_s is not None
            or state.motor_stop_commanded_at_s is not None
        )
    )


def _held_place(last: LastTick, known: Telemetry | None) -> PositionSetpoint:
    """Return the last setpoint or, failing that, the vehicle's position, never higher than the
    vehicle."""
    sample = known or last.obs.telemetry
    x, y, z = sample.position_m
    match last.command:
        case PositionSetpoint(z_m=z_m):
            return replace(last.command, z_m=min(z_m, z))
        case _:
            return PositionSetpoint(x, y, z, sample.yaw_rad)


# --- After an error: the last resort on every error path ---


def rescue(
    link: Link,
    clock: Clock,
    profile: Profile,
    operator: Callable[[], OperatorRequest],
    state: PlannerState | None,
    history: History,
    position_age_s: Callable[[float], float] = lambda now_s: 0.0,
    on_sent: Callable[[SentCommand], None] = lambda sent: None,
    motion: VisualInertialMotion | None = None,
) -> RestStateReport:
    """Land a vehicle that is still flying, without planner, camera and log, within the time that a
    normal landing takes. Return where the vehicle came to rest.

    Args:
        state: the planner's last state; None before its first tick.
        history: the telemetry so far.
        position_age_s: returns the age of the newest external position at a given time; if the
            target is the positioning system, no more positions are sent.
        on_sent: called with each command that has been sent.
        motion: the last motion on which images and accelerometer agreed.
    """

    def send(command: Command) -> None:
        with suppress(Exception):  # if the link itself fails, still try to send the next command
            link.send(command)
            on_sent(SentCommand(clock.now(), "rescue", command))

    by_target = profile.positioning.source.is_target
    start_s, period_s = clock.now(), 1.0 / profile.link.loop_hz
    while (now_s := clock.now()) < start_s + profile.planner.landing.timeout_s:
        if operator() is OperatorRequest.CUT_MOTORS:
            send(EmergencyStop())  # the link's guard repeats it
            return RestStateReport(RestState.END_UNCONFIRMED)
        with suppress(Exception):
            history = add_samples(history, link.telemetry(), profile.safety)
        problem: str | None = "the link raised an error"
        with suppress(Exception):
            problem = link.problem(now_s)
        newest = history.newest
        if newest is not None:
            obs = Observation(
                t_s=now_s,
                telemetry=newest,
                link_problem=problem,
                has_estimated_position_jumped=history.jumped,
                heading_jump_rad=history.turned_rad,
                external_position_age_s=math.inf if by_target else position_age_s(now_s),
                imu=history.imu,
                visual_inertial_motion=motion,
            )
            state, command = step_landing(state, obs, profile)
            if not isinstance(command, Idle):
                send(command)
            rest = report_rest_state(state, obs, profile, LOOK_S)
            if rest is not None:
                return rest
        clock.wait_until(now_s + period_s)
    return RestStateReport(RestState.END_UNCONFIRMED)
