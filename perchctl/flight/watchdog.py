"""What is sent when the flight loop falls silent, and the operator's stop: decided here, sent
by the link (`Link.guard`) from where the loop's hanging does not reach.

What is safe to send again, by the last command (silence: since that command):

- a position setpoint, from `REPEAT_AFTER_S` on: the same place, but never above where the
  vehicle is, so it neither climbs nor presses. While it sinks, a setpoint above stays: it
  brakes.
- raw thrust of the release: the same, as long as fresh telemetry shows it hanging still; what
  slips is caught as the planner catches it. It is never landed while it hangs: a landing ends
  with the motors off, whatever the magnet carries, and still motors under a living stream can
  spin again at once. Without fresh telemetry it is held where it was last seen: that also
  catches.
- raw thrust of the press: the same while it stands still in contact (a change of mode costs
  more height than the second until the landing), else held.
- nothing after the motors were stopped for good, or while the vehicle lands by itself.

From `safety.loop_late_land_s` on, or when the operator asks for it, a landing. From the
ceiling it first peels off by a setpoint below; where the magnet holds all the same, the
whole weight is put on it, and what hangs is stopped. Without fresh telemetry the landing is
ordered all the same: what hangs cannot be told from what flies.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from perchctl.link.evidence import is_cut, is_placed, motors_may_run
from perchctl.mission.landing import (
    LEAST_ORDERS,
    MAX_ORDERS,
    PEEL_BELOW_M,
    PEEL_BLIND_S,
    PEELED_M,
    REPEAT_ORDER_S,
    own_landing,
)
from perchctl.mission.release import (
    CATCH_LIMIT_S,
    CATCH_STILL_ABOVE_M,
    STILL_THRUST,
    STOP_PERIOD_S,
    STOPS,
    THRUST_MIN,
)
from perchctl.mission.state import Operator, Phase, PlannerState
from perchctl.profile import Profile
from perchctl.vehicle import (
    HL_ACTIVE,
    Command,
    EmergencyStop,
    PositionSetpoint,
    RawThrust,
    StopMotors,
    Telemetry,
)

REPEAT_AFTER_S = 0.3
"""The vehicle levels out by itself at 0.5 s (docs/firmware.md, "When setpoints stop")."""
STOP_AFTER_S = 0.1
"""For so long the operator's stop is left to the loop, whose row records it."""
CUT_PERIOD_S, MAX_CUTS = 0.1, 50
SINKING_MPS = -0.1
SLIP_M = 0.008  # below where it was held; less is the estimate's noise
STILL_MPS = 0.06


@dataclass(frozen=True)
class Turn:
    """The last turn of the loop that sent its command, and what it knew.

    Attributes:
        due_s: when the next turn is due; the loop measures its lateness from there.
        held_m: height of the body where the ceiling holds it, None away from the ceiling.
        placed: whether the estimate's height and speed prove anything (`Context.placed`).
        position_age_s: of the newest position from outside; 0 where none is awaited.
    """

    t_s: float
    due_s: float
    command: Command
    telemetry: Telemetry
    ground_z_m: float
    started_s: float
    held_m: float | None
    stopped: bool
    by_itself: bool
    placed: bool = True
    position_age_s: float = 0.0


class Watchdog:
    """A `perchctl.link.protocol.Guard`. `turn`, `rescuing` and `end` are called by the loop's
    thread, `poll` by the link's; each writes its own fields.

    `overruled_s` is how late the loop was when a landing was decided for it, else 0.
    """

    def __init__(self, profile: Profile, operator: Callable[[], Operator]) -> None:
        self._landing = profile.planner.landing
        self._land_s = profile.safety.loop_late_land_s
        self._top_m = profile.safety.max_height_m
        self._proof_age_s = profile.safety.proof_age_s
        self._carried_g = 1.0 - profile.planner.perch.contact_acc_g
        self._complete = profile.planner.complete
        self._operator = operator
        self._turn: Turn | None = None
        self._closing = False
        self._motors_off = False
        self.overruled_s = 0.0
        self._cut_ordered = False
        self._cut_s, self._cuts = -CUT_PERIOD_S, 0
        self._streamed: Command | None = None
        self._revived()

    # --- the loop's side ---------------------------------------------------------------

    def turn(
        self,
        now_s: float,
        due_s: float,
        state: PlannerState,
        command: Command,
        newest: Telemetry,
        *,
        placed: bool = True,
        position_age_s: float = 0.0,
    ) -> None:
        """A turn of the loop is done, its command on its way."""
        if isinstance(command, (PositionSetpoint, RawThrust)):
            self._streamed = command
        if isinstance(command, EmergencyStop):
            self._cut_ordered = True
        held_m = state.contact_z_m
        if held_m is None and state.phase is Phase.PERCH:
            held_m = newest.position_m[2]
        self._turn = Turn(
            now_s,
            due_s,
            self._streamed or command,
            newest,
            state.ground_m[2] if state.ground_m else 0.0,
            state.started_s,
            held_m,
            state.stopped_s is not None,
            state.phase is Phase.LANDING and state.orders > 0,
            placed,
            position_age_s,
        )

    def rescuing(self) -> None:
        """The loop has ended by an error; what is left is the operator's stop."""
        self._closing = True

    def end(self, *, motors_off: bool) -> None:
        """The flight is over; `motors_off` where that is proven."""
        self._closing, self._motors_off = True, motors_off

    @property
    def held_m(self) -> float | None:
        """Height of the body where the ceiling holds it, as of the last turn."""
        return None if self._turn is None else self._turn.held_m

    def blind_s(self, now_s: float) -> float:
        """For how long no position from outside has come, by what the last turn knew; 0 where it
        had one: `own_landing`."""
        turn = self._turn
        if turn is None or turn.placed:
            return 0.0
        return turn.position_age_s + now_s - turn.t_s

    # --- the link's side ---------------------------------------------------------------

    def poll(self, now_s: float, newest: Telemetry | None) -> Command | None:
        """What has to be sent now in the loop's place, if anything."""
        turn = self._turn
        if self._cut_ordered:
            return self._cut(now_s, newest)
        if turn is None or self._motors_off:
            return None
        operator, silent_s = self._operator(), now_s - turn.t_s
        if operator is Operator.STOP and (self._closing or silent_s > STOP_AFTER_S):
            self._cut_ordered = True
            return self._cut(now_s, newest)
        if self._closing or turn.stopped:
            return None
        if silent_s < REPEAT_AFTER_S:
            self._revived()
            return None
        known = newest if is_placed(newest, now_s) else None
        late_s = now_s - turn.due_s
        if operator is Operator.LAND or late_s > self._land_s:
            self.overruled_s = max(self.overruled_s, late_s)
            return self._land(now_s, turn, known)
        return None if turn.by_itself else self._hold(now_s, turn, known)

    def _revived(self) -> None:
        self._held: PositionSetpoint | None = None
        self._peel: PositionSetpoint | None = None
        self._peel_s = 0.0
        self._released_s: float | None = None
        self._stop_s, self._stops = -STOP_PERIOD_S, 0
        self._slipped_s: float | None = None
        self._ordered_s, self._orders = -REPEAT_ORDER_S, 0

    def _cut(self, now_s: float, newest: Telemetry | None) -> Command | None:
        """The emergency stop, until the vehicle is seen to be locked. Bounded."""
        due = now_s - self._cut_s >= CUT_PERIOD_S - 1e-9
        if is_cut(newest, now_s) or not due or self._cuts >= MAX_CUTS:
            return None
        self._cut_s, self._cuts = now_s, self._cuts + 1
        return EmergencyStop()

    def _hold(self, now_s: float, turn: Turn, known: Telemetry | None) -> Command | None:
        """The last safe setpoint."""
        caught = self._caught(now_s, turn, known)
        if caught is not None:
            return caught
        match turn.command:
            case RawThrust(thrust) if known is not None and self._held is None:
                if thrust <= THRUST_MIN or abs(known.velocity_mps[2]) < STILL_MPS:
                    return RawThrust(thrust)  # level: a tilt held on would only speed it up
            case PositionSetpoint(z_m=z_m) if known is not None and self._held is None:
                if z_m > known.position_m[2] and known.velocity_mps[2] < SINKING_MPS:
                    return turn.command
            case PositionSetpoint() | RawThrust():
                pass
            case _:
                return None
        if self._held is None:
            self._held = _held_place(turn, known)
        return self._held

    def _land(self, now_s: float, turn: Turn, known: Telemetry | None) -> Command | None:
        """A landing, as soon as the vehicle is away from the ceiling."""
        caught = self._caught(now_s, turn, known)
        if caught is not None:
            return caught
        if self._stops and known is None:
            return None  # an order would spin the motors of what hangs up again
        free = self._orders > 0 or turn.by_itself or self._slipped_s is not None
        if not free and known is not None and turn.held_m is not None:
            if isinstance(turn.command, RawThrust) and turn.command.thrust <= THRUST_MIN:
                return turn.command
            if not turn.placed or known.position_m[2] > turn.held_m - PEELED_M:
                if self._peel is None:
                    x, y, z = known.position_m
                    self._peel = PositionSetpoint(x, y, z - PEEL_BELOW_M, known.yaw_rad)
                    self._peel_s = now_s
                in_vain = now_s - self._peel_s > PEEL_BLIND_S
                return self._let_go(now_s, known) if in_vain else self._peel
        if known is not None and not motors_may_run(known, now_s):
            return None
        enough = turn.by_itself or self._orders >= LEAST_ORDERS
        if enough and known is not None and known.has(HL_ACTIVE):
            return None
        due = now_s - self._ordered_s >= REPEAT_ORDER_S - 1e-9
        if not due or self._orders >= MAX_ORDERS:
            return None
        self._ordered_s, self._orders = now_s, self._orders + 1
        flown_s = now_s - turn.started_s
        newest, blind_s = known or turn.telemetry, self.blind_s(now_s)
        return own_landing(self._landing, turn.ground_z_m, flown_s, newest, blind_s)

    def _let_go(self, now_s: float, known: Telemetry) -> Command | None:
        """The magnet holds on the least thrust of position mode: the whole weight is put on it
        and watched, as the planner does, then the motors are stopped. Late telemetry ends no
        watch."""
        if self._released_s is None:
            self._released_s = now_s
        since_s, complete = now_s - self._released_s, self._complete
        late = now_s - known.t_s + known.behind_s > self._proof_age_s
        if since_s < complete.ramp_s + complete.hang_s or (late and not self._stops):
            part = min(1.0, since_s / complete.ramp_s)
            return RawThrust(int(THRUST_MIN + part * (STILL_THRUST - THRUST_MIN)))
        if self._stops >= STOPS or now_s - self._stop_s < STOP_PERIOD_S - 1e-9:
            return None
        self._stop_s, self._stops = now_s, self._stops + 1
        return StopMotors()

    def _caught(self, now_s: float, turn: Turn, known: Telemetry | None) -> Command | None:
        """Far above as long as what has slipped off the magnet sinks; None when there is
        nothing to catch, or no more."""
        released = isinstance(turn.command, RawThrust) and turn.command.thrust <= THRUST_MIN
        released = released or self._released_s is not None
        if known is None or turn.held_m is None or not released or self._orders:
            return None
        x, y, z = known.position_m
        sink_mps = known.velocity_mps[2]
        if self._slipped_s is None:
            # An estimate that slides sinks at 1 g; what falls does not.
            if not turn.placed and known.acc_z_g >= self._carried_g:
                return None
            if turn.held_m - z <= SLIP_M or sink_mps >= -self._complete.slip_mps:
                return None
            self._slipped_s = now_s
        if self._held is not None or sink_mps >= 0.0 or now_s - self._slipped_s > CATCH_LIMIT_S:
            if self._held is None:
                self._held = PositionSetpoint(x, y, z, known.yaw_rad)
            return None
        top_m = turn.ground_z_m + self._top_m
        return PositionSetpoint(x, y, min(z + CATCH_STILL_ABOVE_M, top_m), known.yaw_rad)


def _held_place(turn: Turn, known: Telemetry | None) -> PositionSetpoint:
    """The last setpoint's place, or the vehicle's, and not above where the vehicle is."""
    sample = known or turn.telemetry
    x, y, z = sample.position_m
    match turn.command:
        case PositionSetpoint(sx, sy, sz, yaw):
            return PositionSetpoint(sx, sy, min(sz, z), yaw)
        case _:
            return PositionSetpoint(x, y, z, sample.yaw_rad)
