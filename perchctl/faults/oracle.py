"""The oracle: decide from the simulator's ground truth alone whether a simulated flight went wrong.

For each kind of failure, the oracle raises a flag (docs/campaigns.md, "Faults").
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

from perchctl.mission import Event, FlightReport, Outcome, Phase, RestState

Claim = str
"""A claim that `Oracle._is_true` can verify. A claim that the vehicle hangs or stands implies that
its motors are off. `not seen down` claims that no telemetry has shown the vehicle at rest with its
motors off."""
Flag = str
FLAGS: dict[Flag, str] = {
    "crashed": "perchctl ended with an exception that no fault injected",
    "fell": "fell, touched down faster than 0.8 m/s, or slipped too far down",
    "slid": "touched down at more than 0.5 m/s sideways",
    "flies_on": "motors on in the air after the vehicle should have landed",
    "endless": "did not end within 240 s",
    "stop_not_obeyed": "motors still on 0.5 s after the command to cut them",
    "pressed": "pressed against ceiling or floor for more than 4 s",
    "strayed": "more than 1 m from where it should be, or too high",
    "lied": "perchctl reported a false state at the end",
    "locked_needlessly": "locked without a crash, tumble or excess tilt",
}
"""The flags and their meanings, the most serious first."""

LEAST_FALL_HEIGHT_M = 0.1
"""Height up to which no motion counts as a fall, m."""
OFF_S = 0.1
WEIGHTLESS_G = 0.2
"""Specific force below which a vehicle falls freely. Larger: a descent with little thrust counts as
a fall."""
WEIGHTLESS_S = 0.15
"""Time for which the vehicle must fall freely, s. Larger: short falls are missed."""
TOUCHDOWN_MPS, TOUCHDOWN_ASIDE_MPS = 0.8, 0.5
UNPOWERED_G = 0.5
FAST_MPS = 0.45
"""Sink rate above which the vehicle counts as falling until it is slower again, m/s; no commanded
descent is this fast."""
FALL_CAUGHT_MPS = 0.05
"""Sink rate below which a fall is over at once, m/s."""
SLOW_AGAIN_S = 0.3
"""A fall also ends once the sink rate has been below `FAST_MPS` for this time, s. Larger: the
descent that follows counts as part of the fall."""
USUAL_THRUST_RESERVE = 0.165
"""Thrust reserve of a vehicle of 42 g with the motors of the data sheet; a quarter of the simulated
vehicles have less, because the weakest motor counts. Larger: deeper falls of ordinary vehicles are
accepted."""
LEAST_THRUST_RESERVE = 0.05
"""Smallest thrust reserve with which a vehicle can catch itself at all. Smaller: a vehicle that can
hardly fly may fall to the floor."""
FROM_HANGING_S = 1.0
PRESSED_S, RELEASED_S = 4.0, 0.2
"""A vehicle that bounces off the ceiling for less than `RELEASED_S` still counts as pressing."""
ASTRAY_M, TOO_HIGH_M = 1.0, 0.3
ALONE_S = 5.0
TILT_WITHIN_DEG = 10.0
"""A claim of excess tilt is accepted if the tilt came at least this close to the limit."""
CLAIM_S = 0.5
"""Time within which a claim must become true, s. Motors are cut 25 ms after the command."""
SAY_OFF: frozenset[Claim] = frozenset(
    {"held off the target", "hangs", "stands", "hangs or stands", "motors off"}
)
SEEN_S = 6.0
"""Once telemetry of a vehicle at rest has arrived for this time, s, the program must have noticed
that the vehicle is at rest."""
STOP_S = 0.5
"""The motors must be off within this time after the command to cut them, s."""
SECOND_PRESS_S = 0.3
"""A second press only counts if it comes at least this long after the first, s (docs/safety.md)."""
KEY_HELD_S = 1.0
"""The presses of a repeating key count as one press until this long after the first, s."""
REPEAT_WITHIN_S = 0.23
"""A second press does not count if a third follows within this time, s, as it does when a key
repeats."""
REPEAT_SPREAD_S = 0.021
"""Largest difference between the intervals of a key that repeats, s: the simulated clock delivers a
press up to 10 ms early or late. Larger: presses by hand are mistaken for a repeating key, and the
stop that they command need not be obeyed."""


class Sample(NamedTuple):
    """The vehicle's true state at one time, in SI units; a vehicle on the floor has height 0."""

    t_s: float
    x_m: float
    y_m: float
    height_m: float
    vz_mps: float
    body_up_z: float  # z component of the body's z axis: 1 level, -1 upside down
    acc_g: float  # magnitude of the specific force
    motors_on: bool
    pressing: bool  # the motors push the vehicle against ceiling or floor
    on_floor: bool
    hanging: bool  # the magnet holds the gear
    hold_ratio: float  # the magnet's holding force divided by the weight
    locked: bool
    supervisor_ended: bool  # the supervisor has detected a crash or tumble
    horizontal_mps: float = 0.0
    thrust_reserve: float = math.inf  # largest thrust divided by the weight, minus 1
    uplink: bool = True  # True if a packet from the program would arrive
    # distance from where the vehicle should be, minus the drift that the fault may cause
    astray_m: float = 0.0
    miss_m: float = 0.0  # horizontal distance of the gear from the target's centre
    below_m: float = 0.0  # distance of the gear below the plane of the printed target
    descent_overdue: bool = False
    telemetry_ok: bool = True  # telemetry arrives in time and is correct


def drop_limit_m(hold_ratio: float, thrust_reserve: float = math.inf) -> float:
    """The depth, m, to which the vehicle may fall after slipping off the magnet. `hold_ratio` is
    the magnet's holding force divided by the weight, and `thrust_reserve` the largest thrust
    divided by the weight, minus 1.

    Half of the limit is for the fall until the thrust has returned, and half for braking. The
    braking distance is inversely proportional to the thrust reserve, so with less than
    `USUAL_THRUST_RESERVE`, the vehicle may fall deeper. After a slip from a magnet that held almost
    nothing, the motors are running, and the fall ends before it has to be braked.
    """
    if hold_ratio <= 0.3:
        return 0.15
    braking = USUAL_THRUST_RESERVE / max(thrust_reserve, LEAST_THRUST_RESERVE)
    return (0.6 if hold_ratio <= 0.75 else 1.0) * (0.5 + 0.5 * max(1.0, braking))


def emergency_stop_s(presses_s: Sequence[float]) -> float | None:
    """Return the time at which these presses of Ctrl-C command an emergency stop, or None.

    The presses come from a hand, or from a key that repeats faster than a hand can."""
    for number, press_s in enumerate(presses_s):
        after_s, later_s = press_s - presses_s[0], presses_s[number + 1 : number + 2]
        if after_s >= KEY_HELD_S:
            return press_s
        alone = not later_s or later_s[0] - press_s > REPEAT_WITHIN_S
        if number == 1 and after_s >= SECOND_PRESS_S and alone:
            return press_s + REPEAT_WITHIN_S
        if number >= 2 and not _are_repeats(presses_s[: number + 1]):
            return press_s
    return None


def _are_repeats(presses_s: Sequence[float]) -> bool:
    delay_s, *periods_s = (later_s - earlier_s for earlier_s, later_s in pairwise(presses_s))
    return delay_s > 2.0 * max(periods_s) and max(periods_s) - min(periods_s) <= REPEAT_SPREAD_S


class _Lasting:
    def __init__(self, for_s: float) -> None:
        self._for_s, self._since_s = for_s, math.inf

    def update(self, holds: bool, t_s: float) -> bool:
        self._since_s = min(self._since_s, t_s) if holds else math.inf
        return self.holds(t_s)

    def holds(self, t_s: float) -> bool:
        return t_s - self._since_s >= self._for_s - 1e-9


@dataclass
class _Fall:
    """A fall in progress. `limit_m`: how deep it may become after a slip off the magnet."""

    top_m: float
    limit_m: float = math.inf
    slow: _Lasting = field(default_factory=lambda: _Lasting(SLOW_AGAIN_S))


class Oracle:
    """Judges a flight by the profile's limits, from samples of the true state at most 20 ms apart.
    A gear within `magnet_radius_m` of the target's centre counts as on the target.

    Attributes:
        flags: each raised flag with the time at which it was first raised, in chronological order.
        drop_m: depth of the deepest fall, from its top to the catch or the floor.
        astray_m: the largest `Sample.astray_m` in the air.
        newest: the newest sample, or None.
    """

    def __init__(
        self, max_height_m: float, max_tilt_deg: float = 55.0, magnet_radius_m: float = 0.025
    ) -> None:
        self.flags: dict[Flag, float] = {}
        self.drop_m = self.astray_m = 0.0
        self.newest: Sample | None = None
        self._max_height_m, self._magnet_radius_m = max_height_m, magnet_radius_m
        self._tilted_up_z = math.cos(math.radians(max_tilt_deg))
        self._tilt_up_z = math.cos(math.radians(max_tilt_deg - TILT_WITHIN_DEG))
        self._hung: Sample | None = None  # last sample in which the vehicle was hanging
        self._unpowered, self._weightless = _Lasting(OFF_S), _Lasting(WEIGHTLESS_S)
        self._press_s = -math.inf  # time of the newest sample in which the vehicle was pressing
        self._pressed = _Lasting(PRESSED_S)
        self._calm_height_m = 0.0  # height when the vehicle was last not sinking fast
        self._fall: _Fall | None = None
        self._hops = False  # a blow has thrown it off the floor while its motors were off
        self._weak_s = -math.inf  # last time at which the thrust was too small to slow the fall
        self._before: Sample | None = None
        self._least_up_z = 1.0
        self._supervisor_ended = False
        self._may_lock = False
        self._claims: dict[Claim, float] = {}  # claims not confirmed yet, with their times
        self._seen_down = _Lasting(SEEN_S)  # at rest with motors off while telemetry arrives
        self._said_off = False  # a claim that the motors are off was confirmed
        self._presses_s: list[float] = []
        self._muted_s = -math.inf  # last time at which no packet could reach the vehicle
        self._end_s = math.inf

    def add_claims(self, claims: Iterable[Claim], t_s: float) -> None:
        """Record claims that the program made at `t_s`."""
        self._claims |= dict.fromkeys(claims, t_s)

    def note_ctrl_c(self, t_s: float) -> None:
        self._presses_s.append(t_s)

    def note_program_end(self, t_s: float, *, crashed: bool = False, endless: bool = False) -> None:
        """Record when the program ended. `crashed`: it ended with an exception that was not
        injected. `endless`: it was killed because the flight took too long."""
        self._end_s = t_s
        if crashed:
            self._raise("crashed", t_s)
        if endless:
            self._raise("endless", t_s)

    @property
    def stop_s(self) -> float | None:
        """The time at which Ctrl-C commands the emergency stop, or None."""
        return emergency_stop_s(self._presses_s)

    def update(self, sample: Sample) -> None:
        self.newest = sample
        if sample.hanging:
            self._hung = sample
        self._least_up_z = min(self._least_up_z, sample.body_up_z)
        self._supervisor_ended = self._supervisor_ended or sample.supervisor_ended
        self._watch_unpowered(sample)
        self._watch_fall(sample)
        self._watch_touchdown(sample)
        self._watch_pressing(sample)
        self._watch_place(sample)
        self._watch_end(sample)
        self._watch_claims(sample)
        self._watch_stop(sample)
        self._watch_lock(sample)
        self._before = sample

    @property
    def is_airborne(self) -> bool:
        """True if the vehicle is flying or falling."""
        s = self.newest
        return s is not None and _airborne(s) and not (s.hanging and not s.motors_on)

    def _raise(self, flag: Flag, t_s: float) -> None:
        self.flags.setdefault(flag, t_s)

    def _from_hanging(self, s: Sample) -> bool:
        """True if the vehicle was hanging at most `FROM_HANGING_S` ago."""
        return self._hung is not None and s.t_s - self._hung.t_s <= FROM_HANGING_S

    def _watch_unpowered(self, s: Sample) -> None:
        free = _airborne(s) and not s.hanging and not self._from_hanging(s)
        unpowered = self._unpowered.update(free and not s.motors_on, s.t_s)
        weightless = self._weightless.update(free and s.acc_g < WEIGHTLESS_G, s.t_s)
        if unpowered or weightless:
            self._raise("fell", s.t_s)

    def _watch_fall(self, s: Sample) -> None:
        if _airborne(s) and not s.hanging and (not s.motors_on or s.acc_g < UNPOWERED_G):
            self._weak_s = s.t_s
        sinking = -s.vz_mps
        if self._fall is None:
            if sinking <= FAST_MPS or not _airborne(s):
                self._calm_height_m = s.height_m
                return
            self._fall = _Fall(self._calm_height_m)
            if self._hung is not None and self._from_hanging(s):
                limit_m = drop_limit_m(self._hung.hold_ratio, s.thrust_reserve)
                self._fall = _Fall(self._hung.height_m, limit_m)
        fall = self._fall
        drop_m = fall.top_m - s.height_m
        self.drop_m = max(self.drop_m, drop_m)
        unpowered = s.t_s - self._weak_s <= FROM_HANGING_S
        if unpowered and (drop_m > fall.limit_m or s.on_floor):
            self._raise("fell", s.t_s)
        slow_again = fall.slow.update(sinking < FAST_MPS, s.t_s)
        caught = sinking < FALL_CAUGHT_MPS or slow_again
        if s.on_floor or caught:
            self._fall = None
            self._calm_height_m = s.height_m

    def _watch_touchdown(self, s: Sample) -> None:
        """Judge a touchdown by the sample before it, because the floor has already reduced the
        speed in the sample after it. A vehicle that a blow throws off the floor while its motors
        are off has not flown."""
        before = self._before
        if before is not None and before.on_floor and not s.on_floor:
            self._hops = not (before.motors_on or s.motors_on)
        self._hops = self._hops and not s.motors_on
        if before is None or before.on_floor or not s.on_floor or self._hops:
            return
        if -before.vz_mps > TOUCHDOWN_MPS:
            self._raise("fell", s.t_s)
        if before.horizontal_mps > TOUCHDOWN_ASIDE_MPS:
            self._raise("slid", s.t_s)

    def _watch_pressing(self, s: Sample) -> None:
        if s.pressing:
            self._press_s = s.t_s
        if self._pressed.update(s.t_s - self._press_s <= RELEASED_S, s.t_s) and s.pressing:
            self._raise("pressed", s.t_s)

    def _watch_place(self, s: Sample) -> None:
        if not _airborne(s):
            return
        self.astray_m = max(self.astray_m, s.astray_m)
        if s.astray_m > ASTRAY_M or s.height_m > self._max_height_m + TOO_HIGH_M:
            self._raise("strayed", s.t_s)

    def _watch_end(self, s: Sample) -> None:
        left_alone = s.t_s >= self._end_s + ALONE_S
        if (left_alone or s.descent_overdue) and s.motors_on and _airborne(s):
            self._raise("flies_on", s.t_s)

    def _watch_claims(self, s: Sample) -> None:
        """Check the claims that are not confirmed yet. Motors that were claimed to be off must not
        turn again."""
        if self._said_off and s.motors_on:
            self._raise("lied", s.t_s)
        at_rest = not s.motors_on and (s.hanging or not _airborne(s))
        self._seen_down.update(at_rest and s.telemetry_ok, s.t_s)
        for claim, claimed_s in list(self._claims.items()):
            if self._is_true(claim, s):
                del self._claims[claim]
                self._said_off = self._said_off or claim in SAY_OFF
            elif s.t_s >= claimed_s + CLAIM_S:
                del self._claims[claim]
                self._raise("lied", s.t_s)

    def _is_true(self, claim: Claim, s: Sample) -> bool:
        hangs = s.hanging and not s.motors_on
        off_m = math.hypot(s.miss_m, s.below_m)
        # A vehicle that is lying on its side or its back does not count as standing.
        stands = not s.motors_on and not _airborne(s) and s.body_up_z > self._tilted_up_z
        truths = {
            "hangs on the target": hangs and s.miss_m <= self._magnet_radius_m,
            "held off the target": hangs and off_m > self._magnet_radius_m,
            "hangs": hangs,
            "stands": stands,
            "hangs or stands": hangs or stands,
            "motors off": not s.motors_on,
            "locked": s.locked,
            "ended by the supervisor": self._supervisor_ended,
            "tilted": self._least_up_z < self._tilt_up_z,
            "not seen down": not self._seen_down.holds(s.t_s),
        }
        return truths[claim]

    def _watch_stop(self, s: Sample) -> None:
        """Check that an emergency stop is obeyed, but only while packets can reach the vehicle."""
        if not s.uplink:
            self._muted_s = s.t_s
        stop_s = self.stop_s
        if stop_s is None or stop_s > self._end_s:
            return
        if s.motors_on and s.t_s > max(stop_s, self._muted_s) + STOP_S:
            self._raise("stop_not_obeyed", s.t_s)

    def _watch_lock(self, s: Sample) -> None:
        """Check whether a lock of the vehicle was justified by what happened before it; a later
        tumble does not justify it."""
        if s.supervisor_ended or s.body_up_z < self._tilted_up_z:
            self._may_lock = True
        if s.locked and not self._may_lock:
            self._raise("locked_needlessly", s.t_s)


def _airborne(s: Sample) -> bool:
    return not s.on_floor and s.height_m > LEAST_FALL_HEIGHT_M


# --- Convert the program's final messages to claims about the vehicle, which are true or false ---


Claims = set[Claim]
ROW_CLAIMS: dict[str, Claims] = {
    "operator-stop": {"motors off"},
    "hung-but-locked": {"hangs", "locked"},
    "locked": {"locked", "motors off"},
    "tumbled": {"ended by the supervisor", "motors off"},
    "crashed": {"ended by the supervisor", "motors off"},
    "tilted": {"tilted", "motors off"},
    "perched": {"hangs on the target"},
    "hung": {"hangs"},
    "landed": {"stands"},
    "held-elsewhere": {"held off the target"},
    "hangs-or-stands": {"hangs or stands"},
    "landing-timeout": {"not seen down"},
}
"""The claims in the sentence of each transition that ends a flight."""
PHASE_CLAIMS: dict[Phase, Claims] = {Phase.PERCHED: {"hangs"}, Phase.LANDED: {"stands"}}
OUTCOME_CLAIMS: dict[Outcome, Claims] = {
    Outcome.PERCHED: {"hangs on the target"},
    Outcome.HOVERED: {"stands"},
    Outcome.TARGET_NOT_FOUND: {"stands"},
    Outcome.ATTEMPTS_USED_UP: {"hangs or stands"},
    Outcome.SAFETY: set(),
    Outcome.EMERGENCY: {"motors off"},
    Outcome.ENDED_BY_OPERATOR: {"hangs or stands"},
}
"""The claims implied by the meaning of each outcome's exit code (`perchctl.errors.EXIT_CODES`)."""
NOT_KNOWN, UNCONFIRMED = "hangs-or-stands", "landing-timeout"
"""Two transitions that end a flight while perchctl does not know whether the vehicle is hanging
or on the floor, or whether it came down at all."""
RESCUE_CLAIMS: dict[RestState, Claims] = {
    RestState.STANDS: {"stands"},
    RestState.HANGS: {"hangs"},
    RestState.HELD: {"held off the target"},
    RestState.UNKNOWN: {"hangs or stands"},
    RestState.END_UNCONFIRMED: {"not seen down"},
}
"""The claims in a rescue's note, keyed by what the rescue found."""
REFUSAL_CLAIMS: Claims = {"stands"}
"""A refusal claims that no motor has started."""


def last_transition(report: FlightReport) -> str:
    """The name of the transition that ended the flight; empty without a transition."""
    return report.history[-1].transition_name if report.history else ""


def report_claims(report: FlightReport) -> Claims:
    """All claims that a report makes about the vehicle."""
    claims = ROW_CLAIMS.get(last_transition(report), set()) | PHASE_CLAIMS.get(report.phase, set())
    locked = {"locked"} if report.is_locked_by_supervisor else set()
    return claims | OUTCOME_CLAIMS[report.outcome] | locked


def rescue_claims(event: Event) -> Claims:
    """The claims made by a rescue's event; an empty set for any other event."""
    return set() if event.rest_state is None else RESCUE_CLAIMS[event.rest_state]
