"""What was sent in the loop's place, as records of the flight log, and told from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from perchctl.errors import InvalidValue
from perchctl.log.exact import from_exact, to_exact
from perchctl.log.fields import command_values
from perchctl.log.jsonl import json_line
from perchctl.mission import SentBy, SentCommand

SENT_NOTE = (
    "records of kind sent: a command that went to the vehicle in the loop's place, not rounded: "
    "the watchdog's (the loop was silent, or the operator's stop), a rescue's after an error, an "
    "order once more over a link that was lost, and the link's farewell"
)
APART_S = 2.0
"""What is farther apart is told by itself."""
_TELLS = {
    "position": "position setpoints",
    "thrust": "raw thrust",
    "land": "landing ordered",
    "stop": "motors stopped",
    "emergency": "motors cut",
}


def sent_line(sent: SentCommand) -> bytes:
    """One line of the log."""
    return json_line({"kind": "sent", **to_exact(sent)})


def sent_of(record: Mapping[str, Any]) -> SentCommand:
    """Back to the same bits. Errors: InvalidValue."""
    try:
        return from_exact(SentCommand, {k: v for k, v in record.items() if k != "kind"})
    except ValueError as error:
        raise InvalidValue(
            f"the log's record of what was sent at {record.get('t_s', '?')} s cannot be read "
            f"({error}): the log is damaged, or another version of perchctl wrote it"
        ) from None


def sent_values(sent: SentCommand) -> dict[str, Any]:
    """By the names of a tick's fields (`perchctl.log.fields.FIELDS`), and ``by``."""
    return {"t_s": sent.t_s, "by": sent.by, **command_values(sent.command)}


@dataclass(frozen=True)
class Takeover:
    """What one sender sent in one go. Times on the loop's clock; `sent`: commands by their name
    in a tick's `cmd`, in the order of their first, and how many of each."""

    by: SentBy
    start_s: float
    end_s: float
    sent: tuple[tuple[str, int], ...]

    @property
    def text(self) -> str:
        """``position setpoints (14), landing ordered (2)``"""
        return ", ".join(f"{_TELLS[name]} ({count})" for name, count in self.sent)


def takeovers_of(sent: Sequence[SentCommand]) -> tuple[Takeover, ...]:
    """In order."""
    goes: list[list[SentCommand]] = []
    for each in sorted(sent, key=lambda one: one.t_s):
        last = goes[-1][-1] if goes else None
        if last is None or last.by != each.by or each.t_s - last.t_s > APART_S:
            goes.append([])
        goes[-1].append(each)
    return tuple(_takeover(go) for go in goes)


def _takeover(go: Sequence[SentCommand]) -> Takeover:
    names = [str(command_values(each.command)["cmd"]) for each in go]
    counted = tuple((name, names.count(name)) for name in dict.fromkeys(names))
    return Takeover(go[0].by, go[0].t_s, go[-1].t_s, counted)
