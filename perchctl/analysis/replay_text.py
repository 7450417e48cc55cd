"""A replay in words, and as the object of `--json`; with another profile also when its gates
would have fallen, and how far poses and filter would have differed."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from perchctl.analysis.decide import Decided, Difference, decide
from perchctl.analysis.replayer import Replay, Seen
from perchctl.analysis.sense import Sensed
from perchctl.geometry import Array, wrap_rad
from perchctl.mission import Condition

CAUTION = (
    "after the first difference the world would have answered differently: from there on this is "
    "what the planner would have said to another flight's telemetry and pictures"
)
SHOWN_DIGITS = 6
_MOST_KEYS = 6


def replay_record(replay: Replay) -> dict[str, Any]:
    """The replay as JSON's own types.

    `ticks`, `differences` and `first_difference` are the planner's; `pictures` is None without
    any, and else `shown`; `what_if` is None where nothing was changed.
    """
    seen, shown, what_if = replay.seen, replay.shown, None
    if replay.changed:
        what_if = {
            "changed": list(replay.changed),
            "gates": [asdict(gate) for gate in changed_gates(replay)],
            "rms": [asdict(change) for change in pose_changes(replay)],
            "caution": CAUTION,
        }
    return {
        "log": str(replay.log.path),
        "same": replay.same,
        "ticks": replay.ticks,
        **_differences(replay),
        "gap": replay.gap or None,
        "shown": None if shown is None else {"turns": len(shown.turns), **_differences(shown)},
        "pictures": None
        if seen is None
        else {
            "frames": seen.frames,
            "frames_flown": seen.frames_flown,
            "ended": seen.ended or None,
            **_differences(seen),
        },
        "what_if": what_if,
        "notes": list(replay.notes),
    }


def _differences(found: Replay | Seen) -> dict[str, Any]:
    first = None if found.first is None else asdict(found.first)
    return {"differences": found.differences, "first_difference": first}


def replay_lines(replay: Replay) -> list[str]:
    """For people; `replay.notes` are told apart."""
    lines = [*_what_if_head(replay), *_planner_lines(replay), *_shown_lines(replay)]
    lines += _picture_lines(replay)
    if not replay.changed:
        return lines
    lines += [gate_text(gate) for gate in changed_gates(replay)]
    lines += [_change_line(change) for change in pose_changes(replay)]
    if replay.first is not None:
        lines.append(f"mind:      {CAUTION}")
    return lines


def _what_if_head(replay: Replay) -> list[str]:
    keys = replay.changed
    if not keys:
        return []
    more = f" and {len(keys) - _MOST_KEYS} more" if len(keys) > _MOST_KEYS else ""
    return [f"changed:   {', '.join(keys[:_MOST_KEYS])}{more}"]


def _planner_lines(replay: Replay) -> list[str]:
    what_if, ticks = bool(replay.changed), f"{replay.ticks} turns"
    if replay.first is None:
        same = "all with the same commands"
        if what_if:
            same = "no command would have been another"
            if replay.shown is not None:
                same += ", with the target as it was estimated"
        if replay.gap:
            same += ", up to where the log has lost a turn"
        return [f"planner:   {ticks}, {same}"]
    if not replay.differences:
        what = "would only be" if what_if else "is only"
        lead = f"planner:   {ticks}, what was not sent {what} decided otherwise"
        return [lead, f"first:     {difference_text(replay.first, what_if)}"]
    would = "would be decided otherwise" if what_if else "are decided otherwise"
    return [
        f"planner:   {ticks}, {replay.differences} {would}",
        f"first:     {difference_text(replay.first, what_if)}",
    ]


def _shown_lines(replay: Replay) -> list[str]:
    """Only a difference is worth a line: that there is none is the planner's line's to say."""
    found, what_if = replay.shown, bool(replay.changed)
    if found is None or found.first is None:
        return []
    would = "would show" if what_if else "show"
    return [
        f"telemetry: {found.differences} turns {would} the planner something else",
        f"first:     {difference_text(found.first, what_if)}",
    ]


def _picture_lines(replay: Replay) -> list[str]:
    seen = replay.seen
    if seen is None:
        return []
    frames = f"{seen.frames} frames"
    if seen.ended:
        frames = f"seen up to frame {seen.frames} of {seen.frames_flown}"
    if seen.first is None:
        poses = ", all with the same poses, to the bit" if seen.frames else ""
        return [f"pictures:  {frames}{poses}"]
    return [
        f"pictures:  {frames}, {seen.differences} turns see something else",
        f"first:     {difference_text(seen.first, bool(replay.changed))}",
    ]


def difference_text(first: Difference, what_if: bool = False) -> str:
    """``tick 512 at 10.24 s: command.z_m was 1.25, the replay has 1.26``"""
    other = "would be" if what_if else "the replay has"
    recorded, replayed = (json.dumps(_rounded(v)) for v in (first.recorded, first.replayed))
    if recorded == replayed:  # they differ in the last bits
        recorded, replayed = json.dumps(first.recorded), json.dumps(first.replayed)
    return (
        f"tick {first.tick} at {first.t_s:.2f} s: {first.field} was {recorded}, {other} {replayed}"
    )


def _rounded(value: Any) -> Any:
    """JSON's own types with every number to `SHOWN_DIGITS`."""
    if isinstance(value, float):
        return float(f"{value:.{SHOWN_DIGITS}g}")
    if isinstance(value, list):
        return [_rounded(each) for each in value]
    if isinstance(value, dict):
        return {key: _rounded(each) for key, each in value.items()}
    return value


def gate_text(gate: Gate) -> str:
    """When a gate fell as flown, and when it would have."""
    return f"gate:      {gate.name}: {_times(gate.flown_s)} as flown, {_times(gate.changed_s)} then"


def _times(times_s: Sequence[float]) -> str:
    if not times_s:
        return "never"
    more = {1: "", 2: " and once more"}.get(len(times_s), f" and {len(times_s) - 1} times more")
    return f"at {times_s[0]:.2f} s{more}"


def _change_line(change: Change) -> str:
    mm = ", ".join(f"{1e3 * v:.1f}" for v in (change.x_m, change.y_m, change.z_m))
    return (
        f"rms:       {change.name}: {mm} mm and {math.degrees(change.yaw_rad):.2f} deg over "
        f"{change.turns} turns"
    )


# --- What another profile would have changed ------------------------------------------------


@dataclass(frozen=True)
class Gate:
    """A condition of the mission, and when it became true; or a row of its table, and when it
    was taken. Seconds since the log began."""

    name: str
    flown_s: tuple[float, ...]
    changed_s: tuple[float, ...]


@dataclass(frozen=True)
class Change:
    """By how much poses from one source, or the filter's, differ: root of the mean square over
    the `turns` with both."""

    name: str
    turns: int
    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float


def changed_gates(replay: Replay) -> list[Gate]:
    """Those that would have fallen at other times. The other side is decided anew, too, by the
    flown profile: what a log does not hold is compared as well."""
    turns = [each.turn for each in replay.decided]
    flown = list(decide(turns, replay.log.flown_profile))
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


def _of_source(seen: Sequence[Sensed], name: str) -> Iterator[tuple[_Place, _Place]]:
    for each in seen:
        one, other = each.turn.poses.get(name), each.poses.get(name)
        if one is not None and other is not None:
            yield (one.e_m, one.e_yaw_rad), (other.e_m, other.e_yaw_rad)


def _of_filter(seen: Sequence[Sensed]) -> Iterator[tuple[_Place, _Place]]:
    for each in seen:
        if each.turn.observation is None or each.observation is None:
            continue
        one, other = each.turn.observation.target, each.observation.target
        if one is not None and other is not None and one.tracked and other.tracked:
            yield (one.e_m, one.e_yaw_rad), (other.e_m, other.e_yaw_rad)


def _change(name: str, pairs: list[tuple[_Place, _Place]]) -> Change:
    off = np.array([[*(b[0] - a[0]), wrap_rad(b[1] - a[1])] for a, b in pairs]).reshape(-1, 4)
    x_m, y_m, z_m, yaw_rad = (math.sqrt(np.mean(v**2)) if pairs else 0.0 for v in off.T)
    return Change(name, len(pairs), x_m, y_m, z_m, yaw_rad)
