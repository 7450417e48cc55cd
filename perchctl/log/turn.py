"""A turn of the loop as a record of the flight log, whole and exact.

The record's keys are the fields of `perchctl.mission.turn.Turn`; nothing is rounded.
"""

from __future__ import annotations

from typing import Any

from perchctl.errors import InvalidValue
from perchctl.log.exact import from_exact, to_exact
from perchctl.log.jsonl import line_of
from perchctl.mission.turn import Turn

TURN_NOTE = (
    "records of kind turn: all that a turn of the loop took in, knew and decided, not rounded; "
    "their times are on the loop's clock"
)


def turn_line(turn: Turn) -> bytes:
    """One line of the log."""
    return line_of({"kind": "turn", **to_exact(turn)})


def turn_of(record: dict[str, Any]) -> Turn:
    """Back to the same bits. Errors: InvalidValue."""
    try:
        return from_exact(Turn, {k: v for k, v in record.items() if k != "kind"})
    except ValueError as error:
        raise InvalidValue(
            f"the log's turn {record.get('number', '?')} cannot be read ({error}): the log is "
            f"damaged, or another version of perchctl wrote it"
        ) from None
