"""A replay in words, and as the object of `--json`."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from perchctl.replay.compare import Difference
from perchctl.replay.run import Replay
from perchctl.replay.whatif import CAUTION, Change, Gate

_MOST_KEYS = 6


def replay_record(
    replay: Replay, gates: Sequence[Gate], changes: Sequence[Change]
) -> dict[str, Any]:
    """`ticks`, `differences` and `first_difference` are the planner's; `pictures` None without
    any, and else `shown`; `what_if` None where nothing was changed."""
    seen = replay.seen
    return {
        "log": str(replay.log.path),
        "same": replay.same,
        "ticks": replay.ticks,
        "differences": replay.differences,
        "first_difference": _difference_record(replay.first),
        "gap": replay.gap or None,
        "shown": None
        if replay.shown is None
        else {
            "turns": len(replay.shown.turns),
            "differences": replay.shown.differences,
            "first_difference": _difference_record(replay.shown.first),
        },
        "pictures": None
        if seen is None
        else {
            "frames": seen.frames,
            "frames_flown": seen.frames_flown,
            "ended": seen.ended or None,
            "differences": seen.differences,
            "first_difference": _difference_record(seen.first),
        },
        "what_if": None
        if not replay.changed
        else {
            "changed": list(replay.changed),
            "gates": [asdict(gate) for gate in gates],
            "rms": [asdict(change) for change in changes],
            "caution": CAUTION,
        },
        "notes": list(replay.notes),
    }


def replay_lines(replay: Replay, gates: Sequence[Gate], changes: Sequence[Change]) -> list[str]:
    """For people; `replay.notes` are told apart."""
    lines = [*_what_if_head(replay), *_planner_lines(replay), *_shown_lines(replay)]
    lines += _picture_lines(replay)
    if not replay.changed:
        return lines
    lines += [_gate_line(gate) for gate in gates]
    lines += [_change_line(change) for change in changes]
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
    recorded, replayed = json.dumps(first.recorded), json.dumps(first.replayed)
    return (
        f"tick {first.tick} at {first.t_s:.2f} s: {first.field} was {recorded}, {other} {replayed}"
    )


def _difference_record(first: Difference | None) -> dict[str, Any] | None:
    return None if first is None else asdict(first)


def _gate_line(gate: Gate) -> str:
    return f"gate:      {gate.name}: {_times(gate.flown_s)} as flown, {_times(gate.changed_s)} then"


def _times(times_s: Sequence[float]) -> str:
    if not times_s:
        return "never"
    more = {1: "", 2: " and once more"}.get(len(times_s), f" and {len(times_s) - 1} times more")
    return f"at {times_s[0]:.2f} s{more}"


def _change_line(change: Change) -> str:
    mm = ", ".join(f"{1e3 * v:.1f}" for v in (change.x_m, change.y_m, change.z_m))
    text = (
        f"rms:       {change.name}: {mm} mm and {math.degrees(change.yaw_rad):.2f} deg over "
        f"{change.turns} turns"
    )
    if change.only_flown or change.only_changed:
        text += f"; {change.only_flown} only as flown, {change.only_changed} only then"
    return text
