"""A flight as `perchctl log show` prints it: lines of at most `COLUMNS` columns, or one record; and
the logs of a folder, a line each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from textwrap import wrap
from typing import Any

from perchctl.analysis.flight import FlightAnalysis
from perchctl.errors import NotFound, PerchError
from perchctl.record import FlightLog, FlightSummary, read_log

COLUMNS = 79
_HANG = 11
"""Where the text of a line begins, behind its name."""
_MOST_ROWS = 12
_END_KEYS = (
    "outcome", "cause", "reason", "locked", "fell", "contact_aside_m", "contact_sigma_m",
    "touchdown_mps", "touchdown_g", "mount_turn_deg", "mount_turn_sigma_deg",
)  # fmt: skip


def show_record(flight: FlightAnalysis) -> dict[str, Any]:
    """Return all that `show_text` shows, for programs: SI, times from the flight's first turn."""
    log, end, header = flight.log, flight.summary, flight.log.header
    ended = end.as_record()
    return {
        "log": str(log.path),
        **{key: header.get(key) for key in ("version", "perchctl", "started_utc", "uri", "source")},
        "profile": log.profile_name,
        "seed": header.get("seed"),
        "whole": not log.truncated,
        "ignored_bytes": log.ignored_bytes,
        **{key: ended.get(key) for key in _END_KEYS},
        "advice": ended.get("advice") or [],
        "lost_records": end.lost_records,
        "log_problem": end.log_problem,
        **asdict(flight.measures),
        "phases": [
            {
                "phase": stay.phase,
                "start_s": _rounded(stay.start_s),
                "duration_s": _rounded(stay.duration_s),
                "reason": stay.reason,
                "row": stay.row or None,
            }
            for stay in flight.log.phases
        ],
        "holds": [
            {
                "start_s": _rounded(hold.start_s),
                "duration_s": _rounded(hold.duration_s),
                "phase": hold.phase,
                "reason": hold.reason,
            }
            for hold in flight.holds
        ],
        "sent": [
            {
                "by": go.by,
                "start_s": _rounded(log.since(go.start_s)),
                "end_s": _rounded(log.since(go.end_s)),
                "commands": dict(go.sent),
            }
            for go in flight.takeovers
        ],
        "notes": [{"t_s": _rounded(t_s), "note": note} for t_s, note in flight.notes],
    }


def show_text(flight: FlightAnalysis) -> str:
    """Return how a flight ended, its figures, its phases, and what held it or took over, as lines
    for a terminal."""
    log = flight.log
    lines = [*_end_lines(flight), *_named("record", _origin(log)), *_measure_lines(flight)]
    if flight.log.phases:
        lines += ["", "  at [s]  for [s]  phase     why"]
    for stay in flight.log.phases:
        why = stay.reason + (f" ({stay.row})" if stay.row else "")
        lines += hung(f"{_span(stay.start_s, stay.duration_s)}{plain(stay.phase):<9} ", why)
    lines += _table(
        "  at [s]  for [s]  held in   because",
        [
            (f"{_span(hold.start_s, hold.duration_s)}{plain(hold.phase):<9} ", hold.reason)
            for hold in flight.holds
        ],
    )
    lines += _table(
        "  at [s]  for [s]  sent by    in the loop's place",
        [
            (f"{_span(log.since(go.start_s), go.end_s - go.start_s)}{go.by:<10} ", go.text)
            for go in flight.takeovers
        ],
    )
    lines += _table("  at [s]  note", [(f"{_rounded(at):8.2f}  ", n) for at, n in flight.notes])
    return "\n".join(lines)


def _table(head: str, rows: Sequence[tuple[str, str]]) -> Iterator[str]:
    """Yield a table's first rows, each with its begin and its text; nothing without rows."""
    if not rows:
        return
    yield ""
    yield head
    for begin, text in rows[:_MOST_ROWS]:
        yield from hung(begin, text)
    if len(rows) > _MOST_ROWS:
        yield " " * len(rows[0][0]) + f"and {len(rows) - _MOST_ROWS} more: --json has all"


def _span(start_s: float, duration_s: float) -> str:
    return f"{_rounded(start_s):8.2f} {duration_s:8.2f}  "


def _end_lines(flight: FlightAnalysis) -> Iterator[str]:
    """Yield the lines that `fly` ends with, but for the phases, which come as a table."""
    log = flight.log
    end = replace(flight.summary, phases=(), battery_min_v=None)
    first, *others = end.text().splitlines()
    yield from wrap(plain(first), COLUMNS, subsequent_indent="  ")
    for line in others:
        name, _, text = line.partition(":")
        yield from _named(name, text.strip())
    if log.summary is None:
        yield from _named("log lost", "its end: the program was killed, or the disk failed")
    if log.ignored_bytes:
        yield from _named("log lost", f"its tail, {log.ignored_bytes} unreadable bytes")


def _origin(log: FlightLog) -> str:
    header = log.header
    started, seed = header.get("started_utc"), header.get("seed")
    parts = [
        f"profile {log.profile_name or '?'}",
        "" if seed is None else f"seed {seed}",
        f"{header.get('uri', '?')} with {header.get('source', '?')}",
        "" if not started else f"begun {utc_text(started)}",
        f"perchctl {header.get('perchctl', '?')}, version {header.get('version')}",
    ]
    return ", ".join(part for part in parts if part)


def utc_text(started_utc: Any) -> str:
    """Return a header's `started_utc` as people read it."""
    return str(started_utc).replace("T", " ").replace("+00:00", " UTC")


def _measure_lines(flight: FlightAnalysis) -> Iterator[str]:
    m, of = flight.measures, flight.measures.text
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


def plain(text: str) -> str:
    """Return the text without characters that a terminal would obey."""
    return "".join(c if c.isprintable() else "?" for c in text)


def _rounded(seconds: float) -> float:
    return round(seconds, 6) + 0.0


def _named(name: str, text: str) -> list[str]:
    return list(hung(f"{name + ':':<{_HANG}}", text))


def hung(begin: str, text: str) -> Iterator[str]:
    """Yield the text behind its begin, its further lines below it."""
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
_LISTED = (
    "log", "started_utc", "profile", "seed", "outcome", "reason", "duration_s", "miss_m", "problem",
)  # fmt: skip


def newest_logs(folder: Path, most: int | None = None) -> list[Path]:
    """Return the folder's flight logs by the time of their last record, the newest first.

    What only ends like one is not among them. Errors: NotFound.
    """
    try:
        paths = list(folder.iterdir())
    except FileNotFoundError:
        raise NotFound(
            f"there is no folder {folder} with flight logs: name a log, or its folder"
        ) from None
    except NotADirectoryError:
        raise NotFound(f"{folder} is a file, not a folder") from None
    except OSError as error:
        raise NotFound(f"the folder {folder} cannot be read: {error.strerror}") from None
    logs = sorted(filter(_is_log, paths), key=_age_key, reverse=True)
    if not logs:
        raise NotFound(f"the folder {folder} holds no flight log: name a log, or another folder")
    return logs[:most]


def list_logs(folder: Path, most: int | None = None) -> list[dict[str, Any]]:
    """Return the newest logs of a folder, each with how it ended, as JSON's own types. For a file
    that cannot be read `problem` says why, and the rest is None. Errors: NotFound."""
    return [list_log(path) for path in newest_logs(folder, most)]


def list_log(path: Path) -> dict[str, Any]:
    """Return one log of a folder, by its header and end. Never raises for a file that is bad."""
    found: dict[str, Any] = dict.fromkeys(_LISTED) | {"log": str(path)}
    try:
        log = read_log(path)
        end = FlightSummary.of(log)
    except PerchError as error:
        return found | {"problem": str(error).removeprefix(f"{path}: ")}
    except (TypeError, ValueError) as error:
        return found | {"problem": f"it holds what is no flight's ({error})"}
    return found | {
        "started_utc": log.header.get("started_utc"),
        "profile": log.profile_name,
        "seed": log.header.get("seed"),
        "outcome": end.outcome,
        "reason": end.reason,
        "duration_s": end.duration_s,
        "miss_m": end.miss_m,
    }


def list_text(logs: Sequence[Mapping[str, Any]]) -> str:
    """Return the records of `list_logs`, a line each, as wide as a terminal of 80 columns."""
    names = [plain(Path(each["log"]).name) for each in logs]
    width = min(44, max([3, *map(len, names)]))
    lines = [f"{'log':<{width}}  {'s':>6}  how it ended"]
    for name, each in zip(names, logs, strict=True):
        seconds = "-" if each["duration_s"] is None else f"{each['duration_s']:.1f}"
        how = _cut(plain(_how(each)), COLUMNS - width - 10)
        lines.append(f"{_cut(name, width):<{width}}  {seconds:>6}  {how}".rstrip())
    return "\n".join(lines)


def _how(listed: Mapping[str, Any]) -> str:
    """Return how a flight ended, or why its log cannot be read."""
    if listed["problem"] is not None:
        return str(listed["problem"])
    if listed["outcome"] == "perched":
        miss_m = listed["miss_m"]
        return "perched" if miss_m is None else f"perched, {miss_m * 1e3:.1f} mm"
    return f"{listed['outcome']}: {listed['reason']}".rstrip(": ")


def _is_log(path: Path) -> bool:
    """True if a file is a flight log, by its begin; where that is lost, by its name."""
    if not path.name.endswith(SUFFIXES) or path.is_dir():
        return False
    if path.name.startswith(_NAME):
        return True
    try:
        with path.open("rb") as stream:
            begin = stream.read(len(_BEGIN))
    except OSError:  # another file of the folder: one that is gone by now, or may not be read
        return False
    return begin == _BEGIN or begin.startswith(_PACKED)


def _age_key(path: Path) -> tuple[int, str]:
    try:
        return path.stat().st_mtime_ns, path.name
    except OSError:
        return 0, path.name
