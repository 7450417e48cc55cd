"""What the live page says of the operator's commands and of the flight's end: by the flight's own
events, not by what was clicked."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from perchctl.log import FlightSummary
from perchctl.mission import TERMINALS, Event, EventKind, Phase

Card = dict[str, Any]
GOOD = "perched"
_ORDERED = {"operator-land": "landing ordered", "operator-stop": "motors cut"}


def answered(events: Sequence[Event], pressed_s: float | None) -> str:
    """What the flight did for STOP, or for a Ctrl-C; empty where neither came.

    `pressed_s`: the turn of the loop in which STOP was there, on the loop's clock."""
    phases = [e for e in events if e.kind is EventKind.PHASE and e.phase is not None]
    ordered = [e for e in phases if e.row in _ORDERED]
    if not phases or (pressed_s is None and not ordered):
        return ""
    start_s = phases[0].t_s
    parts = [f"{_ORDERED[e.row]} at {e.t_s - start_s:.1f} s" for e in ordered]
    landing = next((e for e in phases if e.phase is Phase.LANDING), None)
    if not ordered and landing is not None:
        parts.append(f"it lands already, since {landing.t_s - start_s:.1f} s: {landing.reason}")
    last = phases[-1]
    if last.phase in TERMINALS and last.row not in _ORDERED:
        assert last.phase is not None
        parts.append(f"{last.phase.value} at {last.t_s - start_s:.1f} s: {last.reason}")
    if not parts:
        parts.append("STOP has come; the flight has not answered yet")
    return "; ".join(parts)


def summary_card(summary: FlightSummary, log: Path) -> Card:
    """How the flight ended, and where to look next."""
    rows = [["cause", summary.cause]] if summary.cause not in ("", summary.outcome) else []
    if summary.miss_m is not None:
        rows.append(["miss", f"{summary.miss_m * 1e3:.1f} mm"])
    if summary.contact is not None:
        rows.append(["contact", summary.contact.text])
    if summary.touchdown is not None and summary.touchdown.is_hard:
        rows.append(["vehicle", summary.touchdown.text])
    rows.append(["flight", f"{summary.duration_s:.1f} s, attempts {summary.attempts}"])
    if summary.battery_min_v is not None:
        rows.append(["battery", f"{summary.battery_min_v:.2f} V at its lowest"])
    if summary.locked:
        rows.append(["vehicle", "locked by its supervisor: inspect and restart it"])
    if summary.log_problem is not None:
        rows.append(["log lost", summary.log_problem])
    return _card(summary.outcome, summary.reason, rows, log)


def failed_card(error: BaseException, log: Path | None) -> Card:
    """Of a flight that ended in an error, or that never began; `log` where there is one."""
    return _card("failed", str(error) or type(error).__name__, [], log)


def _card(outcome: str, reason: str, rows: list[list[str]], log: Path | None) -> Card:
    if log is not None:
        path = log.resolve()
        rows += [["log", str(path)], ["report", f"perchctl log report {shlex.quote(str(path))}"]]
    return {"outcome": outcome.upper(), "good": outcome == GOOD, "reason": reason, "rows": rows}
