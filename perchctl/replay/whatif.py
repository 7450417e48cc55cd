"""What another profile would have changed: poses, filter, and when the gates would have fallen."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from perchctl.geometry import Array, wrap_rad
from perchctl.log import flown_profile
from perchctl.mission import Condition
from perchctl.replay.decide import Decided, decide
from perchctl.replay.run import Replay
from perchctl.replay.sense import Sensed

CAUTION = (
    "after the first difference the world would have answered differently: from there on this is "
    "what the planner would have said to another flight's telemetry and pictures"
)


@dataclass(frozen=True)
class Gate:
    """A condition of the mission, and when it became true; or a row of its table, and when it
    was taken. Seconds since the log began."""

    name: str
    flown_s: tuple[float, ...]
    changed_s: tuple[float, ...]


@dataclass(frozen=True)
class Change:
    """By how much poses from one source, or the filter's, differ: root of the mean square.

    `turns`: those with both; `only_flown`, `only_changed`: those with one.
    """

    name: str
    turns: int
    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float
    only_flown: int
    only_changed: int


def changed_gates(replay: Replay) -> list[Gate]:
    """Those that would have fallen at other times. The other side is decided anew, too, by the
    flown profile: what a log does not hold is compared as well."""
    turns = [each.turn for each in replay.decided]
    flown = list(decide(turns, flown_profile(replay.log.header)))
    one, other = _falls(flown, replay.log.start_s), _falls(replay.decided, replay.log.start_s)
    names = [*one, *(name for name in other if name not in one)]
    gates = [Gate(n, tuple(one.get(n, ())), tuple(other.get(n, ()))) for n in names]
    return [gate for gate in gates if gate.flown_s != gate.changed_s]


def pose_changes(replay: Replay) -> list[Change]:
    """Of each source of poses, and of the filter; empty without pictures."""
    if replay.seen is None:
        return []
    seen = replay.seen.turns
    names = sorted({n for each in seen for n in (*each.turn.poses, *each.poses)})
    found = [_change(name, list(_of_source(seen, name))) for name in names]
    return [*found, _change("filter", list(_of_filter(seen)))]


def _falls(decided: Iterable[Decided], t0_s: float) -> dict[str, list[float]]:
    times: dict[str, list[float]] = {}
    before: frozenset[Condition] = frozenset()
    row = ""
    for each in decided:
        if each.turn.role != "flown" or each.state is None:
            continue
        t_s, state = each.turn.t_s - t0_s, each.state
        now = frozenset(state.since)
        for condition in sorted(now - before, key=lambda c: c.value):
            times.setdefault(condition.value, []).append(t_s)
        if state.row != row:
            times.setdefault(f"row {state.row}", []).append(t_s)
        before, row = now, state.row
    return times


_Place = tuple[Array, float]


def _of_source(seen: Sequence[Sensed], name: str) -> Iterator[tuple[_Place | None, _Place | None]]:
    for each in seen:
        one, other = each.turn.poses.get(name), each.poses.get(name)
        yield (
            None if one is None else (one.e_m, one.e_yaw_rad),
            None if other is None else (other.e_m, other.e_yaw_rad),
        )


def _of_filter(seen: Sequence[Sensed]) -> Iterator[tuple[_Place | None, _Place | None]]:
    for each in seen:
        if each.turn.observation is None or each.observation is None:
            continue
        one, other = each.turn.observation.target, each.observation.target
        yield (
            None if one is None or not one.tracked else (one.e_m, one.e_yaw_rad),
            None if other is None or not other.tracked else (other.e_m, other.e_yaw_rad),
        )


def _change(name: str, pairs: list[tuple[_Place | None, _Place | None]]) -> Change:
    both = [(a, b) for a, b in pairs if a is not None and b is not None]
    off = np.array([[*(b[0] - a[0]), wrap_rad(b[1] - a[1])] for a, b in both]).reshape(-1, 4)
    rms = [math.sqrt(float(np.mean(column**2))) if both else 0.0 for column in off.T]
    only_flown = sum(a is not None and b is None for a, b in pairs)
    only_changed = sum(a is None and b is not None for a, b in pairs)
    x_m, y_m, z_m, yaw_rad = rms
    return Change(name, len(both), x_m, y_m, z_m, yaw_rad, only_flown, only_changed)
