"""A replay in words, and as the object of `--json`; with another profile also when its gates
would have fallen."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from perchctl.analysis.decide import Decided, Difference, decide
from perchctl.analysis.replayer import Replay, Seen

CAUTION = (
    "after the first difference the world would have answered differently: from there on this is "
    "what the planner would have said to another flight's telemetry and pictures"
)
SHOWN_DIGITS = 6
_MOST_KEYS = 6


def replay_record(replay: Replay) -> dict[str, Any]:
    """Return the replay as JSON's own types.

    `ticks`, `differences` and `first_difference` are the planner's; `pictures` is None without
    any, `what_if` where nothing was changed.
    """
    seen, what_if = replay.seen, None
    if replay.changed:
        what_if = {
            "changed": list(replay.changed),
            "gates": [asdict(gate) for gate in changed_gates(replay)],
            "caution": CAUTION,
        }
    return {
        "log": str(replay.log.path),
        "same": replay.same,
        "ticks": replay.ticks,
        **_differences(replay),
        "gap": replay.gap or None,
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
    """Return the replay's lines for people, without `replay.notes`."""
    lines = [*_planner_lines(replay), *_picture_lines(replay)]
    if not replay.changed:
        return lines
    lines += [gate_text(gate) for gate in changed_gates(replay)]
    if replay.first is not None:
        lines.append(f"mind:      {CAUTION}")
    return lines


def _planner_lines(replay: Replay) -> list[str]:
    keys, turns, first = replay.changed, f"planner:   {replay.ticks} turns", replay.first
    more = f" and {len(keys) - _MOST_KEYS} more" if len(keys) > _MOST_KEYS else ""
    head = [f"changed:   {', '.join(keys[:_MOST_KEYS])}{more}"] if keys else []
    if first is not None:
        count = replay.differences or "what was not sent"
        verb = "is" if count in (1, "what was not sent") else "are"
        return [
            *head,
            f"{turns}, {count} {verb} decided otherwise",
            f"first:     {difference_text(first)}",
        ]
    same = "all with the same commands"
    if keys and replay.seen is None:
        same += ", from what was seen and measured then"
    if replay.gap:
        same += ", up to where the log has lost a turn"
    return [*head, f"{turns}, {same}"]


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
        f"first:     {difference_text(seen.first)}",
    ]


def difference_text(first: Difference) -> str:
    """``tick 512 at 10.24 s: command.z_m was 1.25, the replay has 1.26``"""
    recorded, replayed = (json.dumps(_rounded(v)) for v in (first.recorded, first.replayed))
    if recorded == replayed:  # they differ in the last bits
        recorded, replayed = json.dumps(first.recorded), json.dumps(first.replayed)
    return (
        f"tick {first.tick} at {first.t_s:.2f} s: {first.field} was {recorded}, the replay has "
        f"{replayed}"
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
    """Return when a gate fell as flown, and when it would have."""
    return f"gate:      {gate.name}: {_times(gate.flown_s)} as flown, {_times(gate.changed_s)} then"


def _times(times_s: Sequence[float]) -> str:
    if not times_s:
        return "never"
    more = {1: "", 2: " and once more"}.get(len(times_s), f" and {len(times_s) - 1} times more")
    return f"at {times_s[0]:.2f} s{more}"


# --- What another profile would have changed ------------------------------------------------


@dataclass(frozen=True)
class Gate:
    """A condition of the mission, and when it became true; or a row of its table, and when it
    was taken. Seconds since the log began."""

    name: str
    flown_s: tuple[float, ...]
    changed_s: tuple[float, ...]


def changed_gates(replay: Replay) -> list[Gate]:
    """Return the gates that would have fallen at other times. The flown side is decided anew, too,
    by the flown profile: what a log does not hold is compared as well."""
    turns = [each.turn for each in replay.decided]
    flown = list(decide(turns, replay.log.flown_profile))
    one, other = _falls(flown, replay.log.start_s), _falls(replay.decided, replay.log.start_s)
    names = [*one, *(name for name in other if name not in one)]
    gates = [Gate(n, tuple(one.get(n, ())), tuple(other.get(n, ()))) for n in names]
    return [gate for gate in gates if gate.flown_s != gate.changed_s]


def _falls(decided: Iterable[Decided], t0_s: float) -> dict[str, list[float]]:
    times: dict[str, list[float]] = {}
    before: frozenset[Any] = frozenset()
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
