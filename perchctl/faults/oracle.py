"""Whether a simulated flight went wrong, by the truth of the world and nothing else.

The oracle is given samples of the true vehicle (`Sample`) while the flight and the time
after it pass, is told when the program ended and what it claimed, and raises flags:

- *fell*: motors off, or free fall, above 0.1 m while the weight does not hang; a
  touchdown above 0.8 m/s. A vehicle that the magnet lets go of with its motors still is
  judged by how deep it falls until it is caught (`drop_limit_m`); the floor is too deep;
- *flies_on*: off the ground with turning motors 5 s after the program's end (what falls
  with still motors has fallen);
- *pressed*: full thrust against ceiling or floor for more than 4 s;
- *strayed*: truly beyond fence or height limit by more than 0.3 m. What a fault adds to the
  estimate as a slow drift is allowed on top: nothing on board can know it;
- *lied*: the program's claim contradicts where the vehicle is;
- *locked_needlessly*: locked in the end, although it was never crashed, tumbled or tilted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

Flag = Literal["fell", "flies_on", "pressed", "strayed", "lied", "locked_needlessly"]
FLAGS: tuple[Flag, ...] = get_args(Flag)
Claim = Literal["perched", "landed", "cut", "none"]
"""What a program says at its end: it hangs, it stands on the floor with the motors off,
the motors were cut in an emergency, or nothing of the kind."""

LOW_M = 0.1
"""Below this height nothing falls."""
OFF_S = 0.1
FREE_FALL_G, FREE_FALL_S = 0.2, 0.15
TOUCHDOWN_MPS = 0.8
UNPOWERED_G = 0.5
FAST_MPS = 0.45
"""Sinking faster than any order: falling, until slower again."""
CAUGHT_MPS, SLOW_AGAIN_S = 0.05, 0.3
FROM_HANGING_S = 1.0
PRESSED_S = 4.0
BEYOND_M = 0.3
ALONE_S = 5.0
TILTED_UP = math.cos(math.radians(55.0))
CLAIM_S = 0.5
"""A claim has to become true within this time (motors are cut 25 ms after the order)."""


class Sample(NamedTuple):
    """The truth of one moment, SI; height over the floor where the vehicle would stand at 0."""

    t_s: float
    x_m: float
    y_m: float
    height_m: float
    vz_mps: float
    up_z: float  # of the body's z axis: 1 level, -1 upside down
    acc_g: float  # size of the specific force
    motors_on: bool
    pressing: bool  # full thrust against something
    floor: bool
    hanging: bool  # the magnet holds the gear
    hold_ratio: float  # of the magnet's hold to the weight
    locked: bool
    ended_by_vehicle: bool  # crashed or tumbled, as the supervisor saw it
    drifted_m: float = 0.0  # how far a fault has led the estimate astray


@dataclass(frozen=True)
class Limits:
    fence_radius_m: float
    max_height_m: float


@dataclass(frozen=True)
class Verdict:
    """`flags` with when each was first raised; `drop_m` the deepest fall until caught, and
    `slip_ratio` the magnet's hold over the weight where that was a slip from the magnet."""

    flags: dict[Flag, float]
    drop_m: float
    slip_ratio: float | None


def drop_limit_m(hold_ratio: float) -> float:
    """The height that a slip may cost until it is caught."""
    if hold_ratio <= 0.3:
        return 0.15
    return 0.6 if hold_ratio <= 0.75 else 1.0


class Oracle:
    """Samples in, at most 20 ms apart; flags out."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self.flags: dict[Flag, float] = {}
        self.drop_m = 0.0
        self._slip_ratio: float | None = None
        self.newest: Sample | None = None
        self._hung: Sample | None = None  # last sample that hung
        self._off_s: float | None = None
        self._free_s: float | None = None
        self._pressed_s: float | None = None
        self._calm_height_m = 0.0  # where it last did not sink fast
        self._fall: _Fall | None = None
        self._weak_s: float | None = None  # when it was last without the thrust to slow down
        self._sink_mps = 0.0
        self._was_down = True
        self._may_lock = False
        self._claim: tuple[float, Claim] = (math.inf, "none")
        self._claim_open = False
        self._end_s = math.inf

    def claims(self, claim: Claim, t_s: float) -> None:
        """What the program said, and when."""
        self._claim = (t_s, claim)
        self._claim_open = True

    def ended(self, t_s: float) -> None:
        """The program is gone from here on."""
        self._end_s = t_s

    def verdict(self) -> Verdict:
        """After the last sample."""
        return Verdict(dict(self.flags), self.drop_m, self._slip_ratio)

    def see(self, s: Sample) -> None:
        self.newest = s
        if s.hanging:
            self._hung = s
        self._watch_unpowered(s)
        self._watch_fall(s)
        self._watch_touchdown(s)
        self._watch_pressing(s)
        self._watch_place(s)
        self._watch_end(s)
        self._watch_lock(s)

    @property
    def in_the_air(self) -> bool:
        s = self.newest
        return s is not None and _airborne(s) and not (s.hanging and not s.motors_on)

    def _raise(self, flag: Flag, t_s: float) -> None:
        self.flags.setdefault(flag, t_s)

    def _from_hanging(self, s: Sample) -> bool:
        """Whether it hung a moment ago: let go, and about to be caught."""
        return self._hung is not None and s.t_s - self._hung.t_s <= FROM_HANGING_S

    def _watch_unpowered(self, s: Sample) -> None:
        free = _airborne(s) and not s.hanging and not self._from_hanging(s)
        self._off_s = _since(self._off_s, free and not s.motors_on, s.t_s)
        self._free_s = _since(self._free_s, free and s.acc_g < FREE_FALL_G, s.t_s)
        if _lasts(self._off_s, OFF_S, s.t_s) or _lasts(self._free_s, FREE_FALL_S, s.t_s):
            self._raise("fell", s.t_s)

    def _watch_fall(self, s: Sample) -> None:
        """A fall begins where it sinks faster than ordered, and ends caught or on the floor."""
        if _airborne(s) and not s.hanging and (not s.motors_on or s.acc_g < UNPOWERED_G):
            self._weak_s = s.t_s
        sinking = -s.vz_mps
        if self._fall is None:
            if sinking <= FAST_MPS or not _airborne(s):
                self._calm_height_m = s.height_m
                return
            hung = self._hung if self._from_hanging(s) else None
            top_m = self._calm_height_m if hung is None else hung.height_m
            self._fall = _Fall(top_m, None if hung is None else hung.hold_ratio)
        fall = self._fall
        drop_m = fall.top_m - s.height_m
        if drop_m > self.drop_m:
            self.drop_m, self._slip_ratio = drop_m, fall.slip_ratio
        unpowered = self._weak_s is not None and s.t_s - self._weak_s <= FROM_HANGING_S
        too_deep = fall.slip_ratio is not None and drop_m > drop_limit_m(fall.slip_ratio)
        if unpowered and (too_deep or s.floor):
            self._raise("fell", s.t_s)
        fall.slow_s = _since(fall.slow_s, sinking < FAST_MPS, s.t_s)
        caught = sinking < CAUGHT_MPS or _lasts(fall.slow_s, SLOW_AGAIN_S, s.t_s)
        if s.floor or caught:
            self._fall = None
            self._calm_height_m = s.height_m

    def _watch_touchdown(self, s: Sample) -> None:
        if s.floor and not self._was_down and self._sink_mps > TOUCHDOWN_MPS:
            self._raise("fell", s.t_s)
        self._was_down = s.floor
        self._sink_mps = -s.vz_mps

    def _watch_pressing(self, s: Sample) -> None:
        self._pressed_s = _since(self._pressed_s, s.pressing, s.t_s)
        if _lasts(self._pressed_s, PRESSED_S, s.t_s):
            self._raise("pressed", s.t_s)

    def _watch_place(self, s: Sample) -> None:
        beyond_m = BEYOND_M + s.drifted_m
        aside = math.hypot(s.x_m, s.y_m) > self._limits.fence_radius_m + beyond_m
        if _airborne(s) and (aside or s.height_m > self._limits.max_height_m + beyond_m):
            self._raise("strayed", s.t_s)

    def _watch_end(self, s: Sample) -> None:
        claimed_s, claim = self._claim
        if self._claim_open and _is_true(claim, s):
            self._claim_open = False
        elif self._claim_open and s.t_s >= claimed_s + CLAIM_S:
            self._claim_open = False
            self._raise("lied", s.t_s)
        if s.t_s >= self._end_s + ALONE_S and s.motors_on and _airborne(s):
            self._raise("flies_on", s.t_s)

    def _watch_lock(self, s: Sample) -> None:
        """What comes after the lock, as the tumble of what was cut in the air, is no reason."""
        if s.ended_by_vehicle or s.up_z < TILTED_UP:
            self._may_lock = True
        if s.locked and not self._may_lock:
            self._raise("locked_needlessly", s.t_s)


@dataclass
class _Fall:
    """`slip_ratio`: the magnet's hold over the weight; None for what is no slip."""

    top_m: float
    slip_ratio: float | None
    slow_s: float | None = None


def _airborne(s: Sample) -> bool:
    return not s.floor and s.height_m > LOW_M


def _is_true(claim: Claim, s: Sample) -> bool:
    match claim:
        case "perched":
            return s.hanging and not s.motors_on
        case "landed":
            return not s.motors_on and not _airborne(s)
        case "cut":
            return not s.motors_on
        case "none":
            return True


def _since(since_s: float | None, holds: bool, t_s: float) -> float | None:
    if not holds:
        return None
    return t_s if since_s is None else since_s


def _lasts(since_s: float | None, for_s: float, t_s: float) -> bool:
    return since_s is not None and t_s - since_s >= for_s - 1e-9
