"""A flight told from its log: as lines of at most `COLUMNS` columns, and as one record."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from textwrap import wrap
from typing import Any

from perchctl.errors import NotFound, PerchError
from perchctl.log.jsonl import decode_line
from perchctl.log.measures import Held, Measures, holds_of, measures_of, shown
from perchctl.log.read import READABLE_VERSIONS, FlightLog, PhaseSpan, read_log
from perchctl.log.summary import FlightSummary, summarise_flight, summary_text

COLUMNS = 79
_HANG = 11
"""Where the text of a line begins, behind its name."""
_MOST_HOLDS = 12


def show_record(log: FlightLog) -> dict[str, Any]:
    """What `show_text` tells, for programs: SI, times from the flight's first turn."""
    measures = asdict(measures_of(log))
    return {
        "log": str(log.path),
        "version": log.header.get("version"),
        "perchctl": log.header.get("perchctl"),
        "started_utc": log.header.get("started_utc"),
        "uri": log.header.get("uri"),
        "source": log.header.get("source"),
        "profile": profile_name(log.header),
        "seed": log.header.get("seed"),
        "whole": not log.truncated,
        "ignored_bytes": log.ignored_bytes,
        **_end_record(log),
        **measures,
        "phases": [
            {
                "phase": span.phase,
                "start_s": _after(log, span.start_s),
                "duration_s": round(span.duration_s, 6),
                "reason": span.reason,
                "row": row_of(log, span),
            }
            for span in log.phases
        ],
        "holds": [
            {
                "start_s": _after(log, hold.start_s),
                "duration_s": round(hold.end_s - hold.start_s, 6),
                "phase": hold.phase,
                "reason": hold.reason,
            }
            for hold in holds_of(log)
        ],
        "sent": [
            {
                "by": go.by,
                "start_s": _after(log, go.start_s),
                "end_s": _after(log, go.end_s),
                "commands": dict(go.sent),
            }
            for go in log.takeovers
        ],
        "notes": [
            {"t_s": _after(log, float(event["t_s"])), "note": str(event.get("reason") or "")}
            for event in _notes(log)
        ],
    }


def _end_record(log: FlightLog) -> dict[str, Any]:
    end = summarise_flight(log)
    record = end.as_record()
    return {
        key: record.get(key)
        for key in ("outcome", "cause", "reason", "locked", "fell", "contact_aside_m",
                    "contact_sigma_m", "touchdown_mps", "touchdown_g", "mount_turn_deg",
                    "mount_turn_sigma_deg")
    } | {
        "advice": record.get("advice") or [],
        "lost_records": end.lost_records,
        "log_problem": end.log_problem,
    }  # fmt: skip


def show_text(log: FlightLog) -> str:
    """How it ended, its phases, what held it, and what is known of vision, link and battery."""
    measures = measures_of(log)
    return "\n".join(
        [
            *_head(log),
            *_named("record", _origin(log)),
            *_measured(measures),
            *_phase_lines(log),
            *_hold_lines(log, holds_of(log)),
            *_sent_lines(log),
            *_note_lines(log),
        ]
    )


def list_lines(logs: Sequence[Listed]) -> Iterator[str]:
    """One line a log, as wide as a terminal of 80 columns."""
    width = max([3, *(len(plain(each.path.name)) for each in logs)])
    width = min(width, 44)
    yield f"{'log':<{width}}  {'s':>6}  how it ended"
    room = COLUMNS - width - 10
    for each in logs:
        end = each.summary
        if end is None:
            seconds, how = "-", each.problem or ""
        else:
            seconds = f"{end.duration_s:.1f}"
            how = f"{end.outcome}: {end.reason}".rstrip(": ")
            if end.outcome == "perched":
                how = "perched" if end.miss_m is None else f"perched, {end.miss_m * 1e3:.1f} mm"
        name = _cut(plain(each.path.name), width)
        yield f"{name:<{width}}  {seconds:>6}  {_cut(plain(how), room)}".rstrip()


def list_record(each: Listed) -> dict[str, Any]:
    """The heading of a log as JSON's own types."""
    end = each.summary
    return {
        "log": str(each.path),
        "started_utc": each.header.get("started_utc"),
        "profile": profile_name(each.header),
        "seed": each.header.get("seed"),
        "outcome": None if end is None else end.outcome,
        "reason": None if end is None else end.reason,
        "duration_s": None if end is None else end.duration_s,
        "miss_m": None if end is None else end.miss_m,
        "problem": each.problem,
    }


def profile_name(header: Mapping[str, Any]) -> str | None:
    profile = header.get("profile")
    name = profile.get("name") if isinstance(profile, dict) else None
    return None if name is None else str(name)


def plain(text: str) -> str:
    """Without what a terminal would obey."""
    return "".join(c if c.isprintable() else "?" for c in text)


def row_of(log: FlightLog, span: PhaseSpan) -> str | None:
    """The row of the mission's table that led into the phase; None where the log has none."""
    for event in log.events:
        is_it = event.get("event") == "phase" and event.get("phase") == span.phase
        if is_it and math.isclose(float(event["t_s"]), span.start_s, abs_tol=1e-6):
            return event.get("row")
    return None


def _head(log: FlightLog) -> Iterator[str]:
    """The lines that `fly` ends with, but for the phases, which come as a table."""
    end = replace(summarise_flight(log), phases=(), battery_min_v=None)
    first, *others = summary_text(end).splitlines()
    yield from wrap(plain(first), COLUMNS, subsequent_indent="  ")
    for line in others:
        name, _, text = line.partition(":")
        yield from _named(name, text.strip())
    if log.summary is None:
        yield from _named("log lost", "its end: the program was killed, or the disk failed")
    if log.turn_records and not log.records:
        yield from _named(
            "ticks",
            f"left out of this log; its {len(log.turn_records)} turns are whole: perchctl log "
            f"replay decides them again",
        )
    if log.ignored_bytes:
        yield from _named("log lost", f"its tail, {log.ignored_bytes} unreadable bytes")


def _origin(log: FlightLog) -> str:
    header = log.header
    started, seed = header.get("started_utc"), header.get("seed")
    parts = [
        f"profile {profile_name(header) or '?'}",
        "" if seed is None else f"seed {seed}",
        f"{header.get('uri', '?')} with {header.get('source', '?')}",
        "" if not started else f"begun {str(started).replace('T', ' ').replace('+00:00', ' UTC')}",
        f"perchctl {header.get('perchctl', '?')}, version {header.get('version')}",
    ]
    return ", ".join(part for part in parts if part)


def _measured(m: Measures) -> Iterator[str]:
    def of(name: str) -> str:
        return shown(m, name)

    if m.settled_xy_rms_m is not None:
        yield from _named(
            "settled",
            f"{of('settled_xy_rms_m')} mm aside and {of('settled_yaw_rms_rad')} deg RMS in the "
            f"last second before the contact",
        )
    if m.frames:
        gaps = "no gap"
        if m.frame_gaps:
            gaps = "1 gap of" if m.frame_gaps == 1 else f"{of('frame_gaps')} gaps of"
            gaps += f" {of('frame_gaps_s')} s" + (" together" if m.frame_gaps > 1 else "")
        yield from _named(
            "frames",
            f"{of('frames')}, {of('frames_unseen')} without the target; {of('frame_rate_hz')} Hz, "
            f"{of('frame_age_s')} ms old; {gaps}; corners' misfit {of('corner_rms_px')} px",
        )
    if m.battery_min_v is not None:
        ends = ""
        if m.battery_start_v is not None:
            ends = f"; {of('battery_start_v')} V at the start, {of('battery_end_v')} V at the end"
        yield from _named("battery", f"{of('battery_min_v')} V at its lowest{ends}")
    if m.turns:
        yield from _named(
            "loop",
            f"{of('turns')} turns, late by {of('late_p99_s')} ms, telemetry "
            f"{of('telemetry_age_p99_s')} ms old (99 % at most)",
        )


def _phase_lines(log: FlightLog) -> Iterator[str]:
    if not log.phases:
        return
    yield ""
    yield "  at [s]  for [s]  phase     why"
    for span in log.phases:
        row = row_of(log, span)
        why = span.reason + (f" ({row})" if row else "")
        at_s, for_s = _after(log, span.start_s), span.duration_s
        yield from hung(f"{at_s:8.2f} {for_s:8.2f}  {plain(span.phase):<9} ", why)


def _hold_lines(log: FlightLog, holds: Sequence[Held]) -> Iterator[str]:
    if not holds:
        return
    yield ""
    yield "  at [s]  for [s]  held in   because"
    for hold in holds[:_MOST_HOLDS]:
        at_s, for_s = _after(log, hold.start_s), hold.end_s - hold.start_s
        yield from hung(f"{at_s:8.2f} {for_s:8.2f}  {plain(hold.phase):<9} ", hold.reason)
    if len(holds) > _MOST_HOLDS:
        yield f"                   and {len(holds) - _MOST_HOLDS} more: --json has all"


def _sent_lines(log: FlightLog) -> Iterator[str]:
    if not log.takeovers:
        return
    yield ""
    yield "  at [s]  for [s]  sent by    in the loop's place"
    for go in log.takeovers[:_MOST_HOLDS]:
        at_s, for_s = _after(log, go.start_s), go.end_s - go.start_s
        yield from hung(f"{at_s:8.2f} {for_s:8.2f}  {go.by:<10} ", go.text)
    if len(log.takeovers) > _MOST_HOLDS:
        yield f"                   and {len(log.takeovers) - _MOST_HOLDS} more: --json has all"


def _note_lines(log: FlightLog) -> Iterator[str]:
    notes = _notes(log)
    if not notes:
        return
    yield ""
    yield "  at [s]  note"
    for event in notes[:_MOST_HOLDS]:
        at_s = _after(log, float(event["t_s"]))
        yield from hung(f"{at_s:8.2f}  ", str(event.get("reason") or ""))
    if len(notes) > _MOST_HOLDS:
        yield f"          and {len(notes) - _MOST_HOLDS} more: --json has all"


def _notes(log: FlightLog) -> list[dict[str, Any]]:
    return [event for event in log.events if event.get("event") == "note"]


def _after(log: FlightLog, t_s: float) -> float:
    return round(log.since(t_s), 6) + 0.0


def _named(name: str, text: str) -> list[str]:
    return list(hung(f"{name + ':':<{_HANG}}", text))


def hung(begin: str, text: str) -> Iterator[str]:
    """The text behind its begin, its further lines below it."""
    room = " " * len(begin)
    lines = wrap(
        plain(text), COLUMNS, initial_indent=begin, subsequent_indent=room, break_on_hyphens=False
    )
    yield from lines or [begin.rstrip()]


def _cut(text: str, room: int) -> str:
    return text if len(text) <= room else f"{text[: room - 3]}..."


# --- Which logs a folder holds, the newest first, and how each ended: without reading them whole


SUFFIXES = (".jsonl", ".jsonl.gz")
_BEGIN = b'{"kind":"header","format":"perchctl-flight-log"'
_NAME = "flight_"
_PACKED = b"\x1f\x8b"
_TAIL_BYTES = 1 << 16


@dataclass(frozen=True)
class Listed:
    """One log of a folder. Of a file that cannot be read `problem` says why, and the rest is
    empty."""

    path: Path
    header: dict[str, Any]
    summary: FlightSummary | None
    problem: str | None = None


def newest_logs(folder: Path, most: int | None = None) -> list[Path]:
    """The folder's flight logs by the time of their last record, the newest first.

    What only ends like one is not among them. Errors: NotFound.
    """
    try:
        names = [name for name in os.listdir(folder) if name.endswith(SUFFIXES)]
    except FileNotFoundError:
        raise NotFound(
            f"there is no folder {folder} with flight logs: name a log, or the folder with "
            f"--log-dir"
        ) from None
    except NotADirectoryError:
        raise NotFound(f"{folder} is a file, not a folder: name it as FILE") from None
    except OSError as error:
        raise NotFound(f"the folder {folder} cannot be read: {error.strerror}") from None
    aged = [(_changed_ns(folder / name), name) for name in names]
    logs: list[Path] = []
    for _, name in sorted(aged, reverse=True):
        if most is not None and len(logs) >= most:
            break
        if _is_log(folder / name):
            logs.append(folder / name)
    if not logs:
        raise NotFound(
            f"the folder {folder} holds no flight log: name a log, or another folder with --log-dir"
        )
    return logs


def list_log(path: Path) -> Listed:
    """A log's header and end. Never raises for a file that is bad."""
    try:
        quick = _from_both_ends(path)
        if quick is not None:
            return quick
        log = read_log(path)
        return Listed(path, log.header, summarise_flight(log))
    except PerchError as error:
        return Listed(path, {}, None, str(error).removeprefix(f"{path}: "))
    except (TypeError, ValueError) as error:
        return Listed(path, {}, None, f"it holds what is no flight's ({error})")


def _from_both_ends(path: Path) -> Listed | None:
    """None where the end is not a summary: such a log has to be read whole."""
    try:
        with path.open("rb") as stream:
            first = stream.readline()
            stream.seek(max(len(first), os.fstat(stream.fileno()).st_size - _TAIL_BYTES))
            last = stream.read().splitlines()[-2:]
        header, end = decode_line(first), decode_line(last[-1])
        if end.get("kind") == "recording":
            end = decode_line(last[0]) | {k: v for k, v in end.items() if k != "kind"}
    except (OSError, ValueError, IndexError):
        return None
    if end.get("kind") != "summary" or not first.startswith(_BEGIN):
        return None
    if header.get("version") not in READABLE_VERSIONS:
        return None
    return Listed(path, header, summarise_flight(FlightLog(path, header, [], [], end, False)))


def _is_log(path: Path) -> bool:
    """By its begin; by its name where that is lost, as a flight that left nothing is one, too."""
    if path.name.startswith(_NAME):
        return True
    try:
        with path.open("rb") as stream:
            begin = stream.read(len(_BEGIN))
    except OSError:
        return False
    return begin == _BEGIN or begin.startswith(_PACKED)


def _changed_ns(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0
