"""A turn of the loop as a record of the flight log, whole and exact.

The record's keys are the fields of `perchctl.mission.watch.Turn`; nothing is rounded.
"""

from __future__ import annotations

from typing import Any

from perchctl.errors import InvalidValue
from perchctl.log.exact import from_exact, to_exact
from perchctl.log.jsonl import json_line
from perchctl.mission import Turn

TURN_NOTE = (
    "records of kind turn: all that a turn of the loop took in, knew and decided, not rounded; "
    "their times are on the loop's clock"
)


def turn_line(turn: Turn) -> bytes:
    """One line of the log."""
    record = {"kind": "turn", **to_exact(turn)}
    obs, samples = turn.observation, turn.taken.late or turn.taken.samples
    if obs is not None and samples and obs.telemetry is samples[-1]:
        del record["observation"]["telemetry"]  # it stands in the same line already
    return json_line(record)


def turn_of(record: dict[str, Any]) -> Turn:
    """Back to the same bits. Errors: InvalidValue."""
    try:
        return from_exact(Turn, {k: v for k, v in _with_telemetry(record).items() if k != "kind"})
    except ValueError as error:
        raise InvalidValue(
            f"the log's turn {record.get('number', '?')} cannot be read ({error}): the log is "
            f"damaged, or another version of perchctl wrote it"
        ) from None


def _with_telemetry(record: dict[str, Any]) -> dict[str, Any]:
    """The observation's is the newest of the turn, where it has none of its own."""
    obs, taken = record.get("observation"), record.get("taken")
    if not isinstance(obs, dict) or "telemetry" in obs or not isinstance(taken, dict):
        return record
    samples = taken.get("late") or taken.get("samples")
    if not isinstance(samples, list) or not samples:
        return record
    return record | {"observation": obs | {"telemetry": samples[-1]}}
