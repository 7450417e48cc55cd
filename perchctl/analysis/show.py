"""The output of `perchctl log show` for a flight: text of at most `COLUMNS` columns, or one JSON
record."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, fields, replace
from pathlib import Path
from textwrap import wrap
from typing import Any

from perchctl.analysis.flight import FlightAnalysis
from perchctl.errors import NotFound
from perchctl.record import FlightLog, PhaseSpan

COLUMNS = 79
_HANG = 11
"""Column at which the text of a line begins; the line's name is to the left of it."""


def show_record(flight: FlightAnalysis) -> dict[str, Any]:
    """The content of `show_text` as a JSON object, in SI units. Times are measured from the first
    iteration of the flight loop."""
    log, end, header = flight.log, flight.summary, flight.log.header
    return {
        "log": str(log.path),
        **{key: header.get(key) for key in ("version", "perchctl", "started_utc", "uri", "source")},
        "profile": log.profile_name,
        "seed": header.get("seed"),
        "fault": log.injected_fault,
        "whole": not log.truncated,
        "ignored_bytes": log.ignored_bytes,
        **end.as_record(),
        "lost_records": end.lost_records,
        "log_problem": end.log_problem,
        **asdict(flight.measures),
        "trim": None if flight.trim is None else asdict(flight.trim),
        "phases": [_times(stay) for stay in log.phases],
        "holds": [_times(hold) for hold in flight.position_holds],
        "sent": [_times(go) for go in flight.takeovers],
        "notes": [{"t_s": round(t_s, 6), "note": note} for t_s, note in flight.notes],
    }


def _times(part: Any) -> dict[str, Any]:
    start_s, end_s = (round(t_s, 6) + 0.0 for t_s in (part.start_s, part.end_s))
    times = {"start_s": start_s, "end_s": end_s, "duration_s": round(end_s - start_s, 6)}
    return {**asdict(part), **times}


def show_text(flight: FlightAnalysis) -> str:
    """Return a flight's outcome, figures, phases, holds and takeovers as text for a terminal."""
    lines = [*_end_lines(flight), *_named("record", _origin(flight.log))]
    if flight.log.injected_fault is not None:
        lines += _named("fault", f"injected: {flight.log.injected_fault}")
    lines += _measure_lines(flight)
    lines += _trim_lines(flight)
    phases = flight.log.phases
    for head, rows in (
        ("phase     why", [(stay, stay.phase, _why(stay)) for stay in phases]),
        (
            "held in   because (figures at the end of the hold)",
            [(hold, hold.phase, hold.reason) for hold in flight.position_holds],
        ),
        ("sent by   commands (count)", [(go, go.by, go.text) for go in flight.takeovers]),
    ):
        if rows:
            lines += ["", f"  at [s]  for [s]  {head}"]
        for part, name, text in rows:
            span = f"{part.start_s + 0.0:8.2f} {part.end_s - part.start_s:8.2f}"
            lines += with_hanging_indent(f"{span}  {printable_text(name):<9} ", text)
    if flight.notes:
        lines += ["", "  at [s]  note"]
    for at_s, note in flight.notes:
        lines += with_hanging_indent(f"{at_s:8.2f}  ", note)
    return "\n".join(lines)


def _why(stay: PhaseSpan) -> str:
    return f"{stay.reason} ({stay.row})" if stay.row else stay.reason


def _end_lines(flight: FlightAnalysis) -> Iterator[str]:
    log = flight.log
    end = replace(flight.summary, battery_min_v=None)
    yield from wrap(printable_text(end.headline), COLUMNS, subsequent_indent="  ")
    for name, text in end.rows():
        yield from _named(name, text)
    if log.summary is None:
        cause = "its end: the program may have been killed, or the disk may have failed"
        if not log.phases:
            cause = "nothing: the vehicle never took off, or the program was killed before take-off"
        yield from _named("log lost", cause)
    if log.ignored_bytes:
        yield from _named("log lost", f"its end, {log.ignored_bytes} unreadable bytes")


def _origin(log: FlightLog) -> str:
    header = log.header
    started = header.get("started_utc")
    parts = [
        log.setup_text,
        _positions_text(log),
        f"{header.get('uri', '?')} with {header.get('source', '?')}",
        "" if not started else f"started {utc_text(started)}",
        f"perchctl {header.get('perchctl', '?')}, log format version {header.get('version')}",
    ]
    return ", ".join(part for part in parts if part)


def _positions_text(log: FlightLog) -> str:
    """Return which positioning system measured the position. The flight may not have used the
    system that its profile names, because a fault or an option can replace that system."""
    section = (log.header.get("profile") or {}).get("positioning") or {}
    return f"positions by {section['by']}" if "by" in section else ""


def utc_text(started_utc: Any) -> str:
    """The `started_utc` of a log header as readable text."""
    return str(started_utc).replace("T", " ").replace("+00:00", " UTC")


_MEASURES = (
    (
        "settled",
        "settled_xy_rms_m",
        "{settled_xy_rms_m} mm lateral and {settled_yaw_rms_rad} deg heading error "
        "(RMS) in the last second before contact",
    ),
    (
        "frames",
        "frames",
        "{frames}, {frames_unseen} without the target; {frame_rate_hz} Hz, "
        "{frame_age_s} ms old; {frame_gaps} gaps of {frame_gaps_s} s in total",
    ),
    (
        "battery",
        "battery_min_v",
        "{battery_min_v} V at the lowest; {battery_start_v} V at the start, "
        "{battery_end_v} V at the end",
    ),
    (
        "loop",
        "turns",
        "{turns} ticks; 99 % of them at most {late_p99_s} ms late, with telemetry "
        "at most {telemetry_age_p99_s} ms old",
    ),
)
"""Name of each line, the figure that must be known for the line to be printed, and its text."""


def _measure_lines(flight: FlightAnalysis) -> Iterator[str]:
    measures = flight.measures
    texts = {f.name: measures.value_text(f.name) for f in fields(measures)}
    for name, needed, line in _MEASURES:
        if getattr(measures, needed):
            yield from _named(name, line.format_map(texts))


def _trim_lines(flight: FlightAnalysis) -> Iterator[str]:
    trim = flight.trim
    if trim is None:
        return
    yield from _named("motors", trim.motors_text)
    yield from _named("balance", trim.balance_text)
    yield from _named("yaw", trim.yaw_text)
    for sentence in trim.advice:
        yield from _named("advice", sentence)


def printable_text(text: str) -> str:
    """Return the text with control characters, which a terminal would execute, replaced by
    ``?``."""
    return "".join(c if c.isprintable() else "?" for c in text)


def _named(name: str, text: str) -> list[str]:
    return with_hanging_indent(f"{name + ':':<{_HANG}}", text)


def with_hanging_indent(prefix: str, text: str) -> list[str]:
    """Wrap the text into lines. The first line begins with `prefix`; the others are indented by its
    width."""
    room = " " * len(prefix)
    lines = wrap(
        printable_text(text),
        COLUMNS,
        initial_indent=prefix,
        subsequent_indent=room,
        break_on_hyphens=False,
    )
    return lines or [prefix.rstrip()]


# --- The logs in a folder, newest first, and how each flight ended ---


def newest_logs(folder: Path, limit: int | None = None) -> list[Path]:
    """The folder's flight logs (``flight_*.jsonl``, ``.jsonl.gz``), at most `limit`, sorted
    by the time of their last record, newest first. Errors: NotFound."""
    if not folder.is_dir():
        raise NotFound(f"folder {folder} does not exist: name a flight log, or its folder")
    paths = [*folder.glob("flight_*.jsonl"), *folder.glob("flight_*.jsonl.gz")]
    if not paths:
        raise NotFound(
            f"folder {folder} contains no flight log (flight_*.jsonl): name a log or another folder"
        )
    return sorted(paths, key=_age_key, reverse=True)[:limit]


def _age_key(path: Path) -> tuple[int, str]:
    return (path.stat().st_mtime_ns if path.exists() else 0), path.name
