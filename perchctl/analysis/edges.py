"""A flight's edges, read off its log: commands of others, external positions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from perchctl.analysis.sight import percentile
from perchctl.mission import SentBy
from perchctl.record import FlightLog


def runs_of(log: FlightLog, key: str) -> list[tuple[float, float, str]]:
    """Find the stretches over which a text field stayed the same: from, to, text. Empty texts make
    no stretch."""
    found: list[tuple[float, float, str]] = []
    began_s, text = 0.0, ""
    for t_s, now in zip((*log.t_s, log.end_s), (*log.texts(key), None), strict=True):
        if now == text:
            continue
        if text:
            found.append((began_s, float(t_s), text))
        began_s, text = float(t_s), now or ""
    return found


# --- what was sent in the loop's place ------------------------------------------------------

APART_S = 2.0
"""Commands of one sender that are farther apart are two goes."""
_TELLS = {
    "position": "position setpoints",
    "thrust": "raw thrust",
    "land": "landing ordered",
    "stop": "motors stopped",
    "emergency": "motors cut",
}


@dataclass(frozen=True)
class Takeover:
    """What one sender sent in one go. Times are on the loop's clock; `sent` counts the commands by
    their name in a tick's `cmd`, in the order of their first."""

    by: SentBy
    start_s: float
    end_s: float
    sent: tuple[tuple[str, int], ...]

    @property
    def text(self) -> str:
        """``position setpoints (14), landing ordered (2)``"""
        return ", ".join(f"{_TELLS[name]} ({count})" for name, count in self.sent)


def takeovers_of(sent: Sequence[Mapping[str, Any]]) -> tuple[Takeover, ...]:
    """Group what was sent by sender and time, oldest first; `sent` are a log's `sent_values`."""
    goes: list[list[Mapping[str, Any]]] = []
    for each in sorted(sent, key=lambda one: float(one["t_s"])):
        last = goes[-1][-1] if goes else None
        if last is None or last["by"] != each["by"] or each["t_s"] - last["t_s"] > APART_S:
            goes.append([])
        goes[-1].append(each)
    return tuple(
        Takeover(go[0]["by"], go[0]["t_s"], go[-1]["t_s"],
                 tuple(Counter(each["cmd"] for each in go).items()))
        for go in goes
    )  # fmt: skip


# --- external positions ---------------------------------------------------------------------


@dataclass(frozen=True)
class ExternalHealth:
    """External positions as they were sent to the vehicle.

    Attributes:
        sent: how many were sent.
        age_most_s: 99 of 100 were younger than that when they were sent.
        apart_most_m: distance of the newest one and the vehicle's own estimate, in 95 of 100
            turns below that.
        stops: stretches in which none was sent: from, to, why.
    """

    sent: int
    age_most_s: float
    apart_most_m: float
    stops: tuple[tuple[float, float, str], ...]


def external_of(log: FlightLog) -> ExternalHealth | None:
    """Read the external positions of a flight; None where the vehicle's decks measured it."""
    sent = log.column("pos_sent")
    if not np.isfinite(sent).any():
        return None
    offsets = [log.column(f"pos_{axis}_m") - log.column(f"{axis}_m") for axis in "xyz"]
    stopped = np.array([bool(text) for text in log.texts("pos_note")])
    apart = np.where(stopped, np.nan, np.linalg.norm(np.stack(offsets, 1), axis=1))
    return ExternalHealth(
        int(np.nanmax(sent)),
        percentile(log.column("pos_age_s"), 99),
        percentile(apart, 95),
        tuple(runs_of(log, "pos_note")),
    )
