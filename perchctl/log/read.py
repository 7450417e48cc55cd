"""Reading a flight log back, whatever became of its last line."""

from __future__ import annotations

import contextlib
import gzip
import json
import math
import os
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from io import BufferedReader
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from perchctl import __version__
from perchctl.errors import InvalidValue, NotFound
from perchctl.geometry import Array
from perchctl.log.exact import decode_line, from_exact
from perchctl.log.fields import (
    FIELDS,
    FORMAT,
    READABLE_VERSIONS,
    SCHEMA_VERSION,
    command_values,
)
from perchctl.log.header import (
    computer_differences,
    flown_camera,
    flown_mask,
    flown_profile,
)
from perchctl.log.write import path_beside
from perchctl.mission import SentCommand, Turn
from perchctl.profile import Profile
from perchctl.vision import CameraModel

Times = TypeVar("Times", float, Array)
MOST_LOG_BYTES = 300_000_000
"""Of a log, unpacked: three quarters of an hour of flight at 0.115 MB/s. What a packed file of a
megabyte unfolds to may otherwise fill the memory."""
_GZIP = b"\x1f\x8b"
_BEGIN_BYTES = _TAIL_BYTES = 1 << 16


@dataclass(frozen=True)
class PhaseSpan:
    """One stay in a phase; times on the loop's clock."""

    phase: str
    start_s: float
    end_s: float
    reason: str = ""

    @property
    def duration_s(self) -> float:
        return self.end_s - self.start_s


@dataclass(frozen=True, eq=False)
class FlightLog:
    """One flight as it was written.

    Attributes:
        records: the ticks, each with all keys of `FIELDS` (None where missing).
        truncated: the flight did not get to write its summary, or the tail is cut.
        ignored_bytes: length of the unreadable tail.
    """

    path: Path
    header: dict[str, Any]
    records: list[dict[str, Any]]
    events: list[dict[str, Any]]
    summary: dict[str, Any] | None
    truncated: bool
    ignored_bytes: int = 0
    turn_records: list[dict[str, Any]] = field(default_factory=list)
    sent_records: list[dict[str, Any]] = field(default_factory=list)

    @cached_property
    def turns(self) -> list[Turn]:
        """All turns of the loop, exact; empty in a log of version 1 or 2. Errors: InvalidValue."""
        return [turn_of(record) for record in self.turn_records]

    @cached_property
    def sent(self) -> list[SentCommand]:
        """What was sent in the loop's place; empty before version 4. Errors: InvalidValue."""
        return [sent_of(record) for record in self.sent_records]

    def column(self, key: str) -> Array:
        """A field over the ticks, shape (n,); NaN where it is missing.

        Raises InvalidValue for a value that is no number.
        """
        try:
            values = [np.nan if r.get(key) is None else float(r[key]) for r in self.records]
        except (TypeError, ValueError):
            raise InvalidValue(f"{self.path}: {key} is not a number in every record") from None
        return np.array(values, dtype=np.float64)

    def texts(self, key: str) -> list[str]:
        """A field over the ticks as text, empty where it is missing."""
        return [str(record.get(key) or "") for record in self.records]

    @property
    def t_s(self) -> Array:
        """Times of the ticks since the flight's first turn, shape (n,)."""
        return self.since(self.column("t_s"))

    @property
    def end_s(self) -> float:
        """Time of the last tick since the flight's first turn; 0 without any."""
        return self.since(float(self.records[-1]["t_s"])) if self.records else 0.0

    def setting(self, key: str) -> Any:
        """The flown profile's value of a dotted key, as JSON has it; None where there is none."""
        value = self.header.get("profile")
        for name in key.split("."):
            value = value.get(name) if isinstance(value, Mapping) else None
        return value

    def number(self, key: str) -> float | None:
        """The flown profile's value of a dotted key; None where that is no finite number."""
        value = self.setting(key)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return None
        return float(value) if math.isfinite(value) else None

    @property
    def flown_profile(self) -> Profile:
        """The profile that was flown, but for passwords. Errors: InvalidValue."""
        return flown_profile(self.header)

    @property
    def flown_camera(self) -> CameraModel | None:
        """The calibration that was flown; None in a log that has none. Errors: InvalidValue."""
        return flown_camera(self.header)

    def flown_mask(self, camera: CameraModel) -> NDArray[np.bool_] | None:
        """(height, width), True where the gear covers; None without a mask. Errors:
        InvalidValue."""
        return flown_mask(self.header, camera)

    @property
    def computer_differences(self) -> str:
        """In what the flight's computer differed from this one, in words; empty where it did not,
        or where the log does not say."""
        return computer_differences(self.header)

    @property
    def profile_name(self) -> str | None:
        """The flown profile's name; None where the header holds none."""
        name = self.setting("name")
        return None if name is None else str(name)

    @property
    def start_s(self) -> float:
        """The loop's time of the first flown turn, which every output takes for 0; 0 without."""
        flown = (r for r in self.turn_records if r.get("role") == "flown")
        first = self.records[0] if self.records else next(flown, None)
        return 0.0 if first is None else float(first["t_s"])

    def since(self, t_s: Times) -> Times:
        """Times on the loop's clock, counted from the first flown turn as all outputs do."""
        return t_s - self.start_s

    @cached_property
    def phases(self) -> tuple[PhaseSpan, ...]:
        """The phases flown through, in order; each lasts until the next begins."""
        spans: list[PhaseSpan] = []
        for record in self.records:
            t_s, phase = float(record["t_s"]), str(record.get("phase") or "")
            if spans and spans[-1].phase == phase:
                last = spans[-1]
                spans[-1] = PhaseSpan(phase, last.start_s, t_s, last.reason)
                continue
            if spans:
                last = spans[-1]
                spans[-1] = PhaseSpan(last.phase, last.start_s, t_s, last.reason)
            spans.append(PhaseSpan(phase, t_s, t_s, str(record.get("reason") or "")))
        return tuple(spans)


def read_log(path: Path | str) -> FlightLog:
    """Read a flight log; an unreadable tail is ignored and counted.

    Raises NotFound when there is no such file, and InvalidValue, with the line,
    when it is not a flight log or is damaged elsewhere than at its end.
    """
    path = Path(path)
    lines = _lines(path)
    header = _header(path, lines)
    good: list[dict[str, Any]] = []
    bad: tuple[int, str] | None = None  # first unreadable line
    ignored = 0
    for number, line in enumerate(lines[1:], start=2):
        try:
            record = _checked(decode_line(line))
        except ValueError as error:
            bad = bad or (number, str(error))
            ignored += len(line)
            continue
        if bad is not None:
            raise InvalidValue(
                f"{path}: line {bad[0]}: not a record of a flight log ({bad[1]}), and records "
                f"follow it: the file is damaged, take the original"
            )
        good.append(record)
    summary = next((r for r in good if r["kind"] == "summary"), None)
    recording = next((r for r in good if r["kind"] == "recording"), {})
    blank = dict.fromkeys(FIELDS)
    return FlightLog(
        path=path,
        header=header,
        records=[blank | _without_kind(r) for r in good if r["kind"] == "tick"],
        events=[_without_kind(r) for r in good if r["kind"] == "event"],
        summary=None if summary is None else _without_kind(summary | recording),
        truncated=summary is None or ignored > 0,
        ignored_bytes=ignored,
        turn_records=[r for r in good if r["kind"] == "turn"],
        sent_records=[r for r in good if r["kind"] == "sent"],
    )


def read_ends(path: Path) -> FlightLog:
    """A log's header and summary alone, without reading it whole, where it ends with its summary;
    else the whole log.

    Raises NotFound and InvalidValue, as `read_log`.
    """
    try:
        with path.open("rb") as stream:
            first = stream.readline()
            stream.seek(max(len(first), os.fstat(stream.fileno()).st_size - _TAIL_BYTES))
            last = stream.read().splitlines()[-2:]
        header, end = decode_line(first), decode_line(last[-1])
        if end.get("kind") == "recording":
            end = decode_line(last[0]) | _without_kind(end)
    except (OSError, ValueError, IndexError):
        return read_log(path)
    is_whole = end.get("kind") == "summary" and header.get("format") == FORMAT
    if not is_whole or header.get("version") not in READABLE_VERSIONS:
        return read_log(path)
    return FlightLog(path, header, [], [], end, truncated=False)


@contextlib.contextmanager
def log_values(path: Path) -> Iterator[None]:
    """Around what works with the values of a log: one that is of no flight raises InvalidValue."""
    try:
        yield
    except OSError:
        raise
    except (TypeError, ValueError, LookupError, AttributeError) as error:
        raise InvalidValue(
            f"{path}: it holds a value that no flight writes ({error}): take the original"
        ) from error


def _lines(path: Path) -> list[bytes]:
    try:
        with path.open("rb") as stream:
            is_packed = stream.peek(len(_GZIP)).startswith(_GZIP)
            data = _begin_or_all(gzip.GzipFile(fileobj=stream) if is_packed else stream)
    except FileNotFoundError:
        raise NotFound(f"flight log {path} does not exist") from None
    except IsADirectoryError:
        raise NotFound(f"flight log {path} is a folder; name one of its .jsonl files") from None
    except OSError as error:
        raise NotFound(f"flight log {path} cannot be read: {error.strerror}") from None
    if is_packed and not data:
        raise InvalidValue(
            f"{path}: it is packed by gzip, and its begin is damaged: take the original"
        )
    if len(data) > MOST_LOG_BYTES:
        unpacked = " unpacked" if is_packed else ""
        raise InvalidValue(
            f"{path}: it has more than {MOST_LOG_BYTES / 1e6:g} MB{unpacked}, and no flight's log "
            f"that is read has so much: take the original, or cut it off behind some line"
        )
    return data.splitlines(keepends=True)


def _begin_or_all(stream: BufferedReader | gzip.GzipFile) -> bytes:
    """All that may be a log, up to one piece more than `MOST_LOG_BYTES`; the begin of what cannot
    be one, as it may be a video of gigabytes. The end of what was packed and cut is lost."""
    parts: list[bytes] = []
    size, most = 0, MOST_LOG_BYTES
    with contextlib.suppress(gzip.BadGzipFile, EOFError, zlib.error):
        while size <= most and (part := stream.read1(_BEGIN_BYTES)):
            if not parts and not part.startswith(b"{"):
                most = _BEGIN_BYTES - 1
            parts.append(part)
            size += len(part)
    return b"".join(parts)


def _header(path: Path, lines: list[bytes]) -> dict[str, Any]:
    if not lines:
        raise InvalidValue(
            f"{path}: line 1: the file is empty: nothing was recorded, or it was lost in copying"
        )
    try:
        header = decode_line(lines[0])
    except ValueError:
        header = {}
    if header.get("kind") != "header" or header.get("format") != FORMAT:
        raise InvalidValue(
            f"{path}: line 1: not a flight log of perchctl: {why_no_log(path, lines[0])}"
        )
    version = header.get("version")
    if version not in READABLE_VERSIONS:
        readable = f"1 to {READABLE_VERSIONS[-1]}"
        newer = isinstance(version, int) and version > SCHEMA_VERSION
        raise InvalidValue(
            f"{path}: line 1: schema version {version!r}, this perchctl reads {readable}; "
            f"the log was written by perchctl {header.get('perchctl', 'of unknown version')}, "
            f"this is {__version__}" + (": update perchctl" if newer else "")
        )
    return header


def _checked(record: dict[str, Any]) -> dict[str, Any]:
    kind = record.get("kind")
    if kind not in KINDS:
        raise ValueError(f"kind {kind!r}, allowed are {', '.join(KINDS)}")
    t_s = record.get("t_s")
    timeless = kind in ("summary", "recording")
    if not timeless and (isinstance(t_s, bool) or not isinstance(t_s, (int, float))):
        raise ValueError(f"t_s must be a number of seconds, found {t_s!r}")
    return record


def _without_kind(record: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in record.items() if k != "kind"}


# --- turns, and what was sent in the loop's place --------------------------------------------


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


# --- What a file is that is no flight log, or no whole one, in words ---------------------------


SUFFIX = ".jsonl"
KINDS = ("tick", "turn", "sent", "event", "summary", "recording")
"""Of a log's records behind its header."""
_BEGINS: tuple[tuple[bytes, str], ...] = (
    (b"\x89PNG", "a PNG picture"),
    (b"\xff\xd8\xff", "a JPEG picture"),
    (b"%PDF", "a PDF document"),
    (b"\x89MCAP", "an MCAP recording"),
    (b"PAR1", "a Parquet table"),
    (b"\x1f\x8b", "packed by gzip"),
    (b"PK\x03\x04", "a ZIP archive"),
    (b"RIFF", "a video or a picture"),
    (b"<", "a page or a drawing"),
)
_HEADER = b'{"kind":"header"'
_BOX = b"ftyp"  # MP4 and MOV, four bytes in
_TEXT_BYTES = 512


def why_no_log(path: Path, first_line: bytes) -> str:
    """What the file holds in place of a flight log, and what to do: the end of a sentence."""
    if first_line.startswith(_HEADER) and not first_line.endswith(b"\n"):
        return f"it is cut off in its header, after {len(first_line)} bytes: take the original"
    return f"{_kind_of(first_line)}; {_remedy(path)}"


def _kind_of(line: bytes) -> str:
    for begin, name in _BEGINS:
        if line.startswith(begin):
            return f"it is {name}"
    if line[4:8] == _BOX:
        return "it is a video"
    if _is_binary(line[:_TEXT_BYTES]):
        return "it is a binary file"
    if not line.strip():
        return "its first line is empty"
    return _kind_of_text(line)


def _kind_of_text(line: bytes) -> str:
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        comma = b"," in line and not line.lstrip().startswith((b"{", b"["))
        return "it is a table" if comma else "it is some other text"
    if isinstance(record, dict) and record.get("kind") in KINDS:
        return "its header is missing"
    return "it is some other JSON"


def _is_binary(data: bytes) -> bool:
    if b"\0" in data:
        return True
    try:
        data.decode("utf-8")
    except UnicodeDecodeError as error:
        return error.start < len(data) - 3  # not only a letter cut in two
    return False


def _remedy(path: Path) -> str:
    """The log that lies beside a plot or a table of it, where there is one."""
    log = path_beside(path, SUFFIX)
    if log != path and log.is_file():
        return f"its flight's log is {log}"
    return f"logs are the {SUFFIX} files in the profile's log.directory"
