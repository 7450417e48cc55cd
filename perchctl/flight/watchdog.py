"""What is sent while the flight loop is silent, and the operator's stop: decided here, sent by the
link (`Link.guard`) from where the loop's hanging does not reach.

From `REPEAT_AFTER_S` of silence on the last position is held: never above where the vehicle is,
so it neither climbs nor presses. While it sinks, a setpoint above stays: it brakes. From
`safety.loop_late_land_s` on, or when the operator asks for it, or where the loop was already on
its way down or had put the weight on the magnet, the `perchctl.mission.lander` goes on in the
loop's place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from perchctl.mission import Observation, Operator, Phase, PlannerState, step_landing
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
    is_cut,
    knows_its_position,
)

REPEAT_AFTER_S = 0.3
"""The vehicle levels out by itself at 0.5 s (docs/firmware.md, "When setpoints stop")."""
STOP_AFTER_S = 0.1
"""For so long the operator's stop is left to the loop, whose row records it."""
CUT_PERIOD_S, MAX_CUTS = 0.1, 50
SINKING_MPS = -0.1
STILL_MPS = 0.06


@dataclass(frozen=True, eq=False)
class LastTick:
    """The last tick of the loop whose command was sent.

    `due_s`: when the next one is due, from which the loop measures its lateness. `command`: the
    last that was streamed.
    """

    due_s: float
    state: PlannerState
    command: Command
    obs: Observation


class Watchdog:
    """A `perchctl.link.protocol.Guard`. `tick`, `rescuing` and `end` are called by the loop's
    thread, `poll` by the link's; each writes its own fields.

    `position_age_s` tells at a time how old the newest position from outside is. `overruled_s` is
    how late the loop was when a landing was decided for it, else 0.
    """

    def __init__(
        self,
        profile: Profile,
        operator: Callable[[], Operator],
        position_age_s: Callable[[float], float] = lambda now_s: 0.0,
    ) -> None:
        self._profile = profile
        self._land_s = profile.safety.loop_late_land_s
        self._operator = operator
        self._position_age_s = position_age_s
        self._last: LastTick | None = None
        self._closing = False
        self._motors_off = False
        self.overruled_s = 0.0
        self._cut_ordered = False
        self._cut_s, self._cuts = -CUT_PERIOD_S, 0
        self._streamed: Command | None = None
        self._history: History | None = None
        self._held: PositionSetpoint | None = None
        self._way_down: PlannerState | None = None

    # --- the loop's side ---------------------------------------------------------------

    def tick(self, due_s: float, state: PlannerState, command: Command, obs: Observation) -> None:
        """A tick of the loop is done, its command on its way."""
        if isinstance(command, (PositionSetpoint, RawThrust)):
            self._streamed = command
        if isinstance(command, EmergencyStop):
            self._cut_ordered = True
        self._last = LastTick(due_s, state, self._streamed or command, obs)

    def rescuing(self) -> None:
        """The loop has ended by an error; what is left is the operator's stop."""
        self._closing = True

    def end(self, *, motors_off: bool) -> None:
        """The flight is over; `motors_off` where that is proven."""
        self._closing, self._motors_off = True, motors_off

    @property
    def state(self) -> PlannerState | None:
        """The planner's, after the last tick that was sent; None before the first."""
        return None if self._last is None else self._last.state

    # --- the link's side ---------------------------------------------------------------

    def poll(
        self, now_s: float, newest: Telemetry | None, waiting: Sequence[Telemetry] = ()
    ) -> Command | None:
        """What has to be sent now in the loop's place, if anything."""
        last = self._last
        if self._cut_ordered:
            return self._cut(now_s, newest)
        if last is None or self._motors_off:
            return None
        operator, silent_s = self._operator(), now_s - last.obs.t_s
        if operator is Operator.STOP and (self._closing or silent_s > STOP_AFTER_S):
            self._cut_ordered = True
            return self._cut(now_s, newest)
        if self._closing:
            return None
        if silent_s < REPEAT_AFTER_S:
            self._history = self._held = self._way_down = None
            return None
        late_s = now_s - last.due_s
        overruled = operator is Operator.LAND or late_s > self._land_s
        if overruled:
            self.overruled_s = max(self.overruled_s, late_s)
        obs = self._observed(now_s, last, newest, waiting)
        if overruled or self._way_down is not None or _is_on_its_way_down(last.state):
            return self._land(obs, last)
        return self._hold(now_s, last, newest)

    def _cut(self, now_s: float, newest: Telemetry | None) -> Command | None:
        """The emergency stop, until the vehicle is seen to be locked. Bounded."""
        due = now_s - self._cut_s >= CUT_PERIOD_S - 1e-9
        if is_cut(newest, now_s) or not due or self._cuts >= MAX_CUTS:
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
        """What is known now: the newest telemetry, and no picture."""
        if self._history is None:
            self._history = History((last.obs.telemetry,), imu=last.obs.imu)
        new = [*waiting, *([] if newest is None else [newest])]
        self._history = history = add_samples(self._history, new, self._profile.safety)
        age_s = self._position_age_s(now_s)
        if self._profile.positioning.by == "target":  # no sight is sent without the loop
            age_s = last.obs.position_age_s + now_s - last.obs.t_s
        return Observation(
            t_s=now_s,
            telemetry=history.newest or last.obs.telemetry,
            jumped=history.jumped,
            turned_rad=history.turned_rad,
            loop_late_s=now_s - last.obs.t_s,
            position_age_s=age_s,
            imu=history.imu,
            felt=last.obs.felt,
            mismatch=last.obs.mismatch,
        )

    def _land(self, obs: Observation, last: LastTick) -> Command | None:
        """The way down, from the loop's own state on."""
        state = self._way_down or last.state
        self._way_down, command = step_landing(state, obs, self._profile)
        return None if isinstance(command, Idle) else command

    def _hold(self, now_s: float, last: LastTick, newest: Telemetry | None) -> Command | None:
        """The last safe setpoint."""
        known = newest if knows_its_position(newest, now_s) else None
        if self._held is None and known is not None:
            match last.command:
                case RawThrust(thrust) if abs(known.velocity_mps[2]) < STILL_MPS:
                    return RawThrust(thrust)  # the press, which a change of mode would end
                case PositionSetpoint(z_m=z_m):
                    if z_m > known.position_m[2] and known.velocity_mps[2] < SINKING_MPS:
                        return last.command
        if not isinstance(last.command, (PositionSetpoint, RawThrust)):
            return None
        if self._held is None:
            self._held = _held_place(last, known)
        return self._held


def _is_on_its_way_down(state: PlannerState) -> bool:
    """Also where the weight is on the magnet: its release goes on under watch."""
    return state.phase is Phase.LANDING or (
        state.phase is Phase.COMPLETE
        and (state.released_s is not None or state.stopped_s is not None)
    )


def _held_place(last: LastTick, known: Telemetry | None) -> PositionSetpoint:
    """The last setpoint's place, or the vehicle's, and not above where the vehicle is."""
    sample = known or last.obs.telemetry
    x, y, z = sample.position_m
    match last.command:
        case PositionSetpoint(z_m=z_m):
            return replace(last.command, z_m=min(z_m, z))
        case _:
            return PositionSetpoint(x, y, z, sample.yaw_rad)
