"""Read a flight log, even if its last line is incomplete.

A turn is one iteration of the flight loop, and a tick is a turn in which the vehicle was flown.
Unless stated otherwise, times are in seconds since the first tick.
"""

from __future__ import annotations

import base64
import contextlib
import csv
import gzip
import math
import warnings
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from io import StringIO
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from perchctl import __version__
from perchctl.errors import InvalidValue, Note, NotFound
from perchctl.files import kind_note
from perchctl.geometry import Array
from perchctl.mission import SentCommand, TickRecord
from perchctl.profile import Profile, key_and_reason
from perchctl.record.exact import (
    ExactField,
    collect_written_names,
    decode_line,
    exact_fields,
    from_exact_json,
)
from perchctl.record.fields import FIELDS, FORMAT, READABLE_VERSIONS, SCHEMA_VERSION
from perchctl.record.header import computer_record
from perchctl.vision import CameraModel

Times = TypeVar("Times", float, Array)
Exact = TypeVar("Exact", TickRecord, SentCommand)
KINDS = ("tick", "turn", "sent", "event", "summary", "recording")
"""Types of the records that follow a log's header."""
SAME_S = 1e-3
"""Times that differ by less than this belong to one tick, s."""
_GZIP = b"\x1f\x8b"


@dataclass(frozen=True)
class PhaseSpan:
    """A period in one phase. Times are since the flight's first turn; `end_s` is the start of the
    next phase.

    Attributes:
        reason: why the phase was entered.
        row: the row of the mission's transition table that led to the phase.
        severity: severity in the log's event.
        simulated: the event in the simulated scenario that led to the phase. The texts are empty if
            unknown.
    """

    phase: str
    start_s: float
    end_s: float
    reason: str = ""
    row: str = ""
    severity: str = ""
    simulated: str = ""

    @property
    def duration_s(self) -> float:
        return self.end_s - self.start_s


@dataclass(frozen=True, eq=False)
class FlightLog:
    """The log of one flight.

    Attributes:
        records: the ticks, each with all keys of `FIELDS` (None where missing).
        truncated: True if the summary is missing, or if the end of the file is cut off.
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

    # --- records

    @cached_property
    def turns(self) -> list[TickRecord]:
        """The exact records of all loop turns; empty in a log of version 1 or 2. Errors:
        InvalidValue."""
        return [parse_turn(record) for record in self.turn_records]

    @cached_property
    def unknown_fields(self) -> tuple[ExactField, ...]:
        """The fields of a turn that this log cannot contain, because an older version of perchctl
        wrote it; in `turns`, they have their defaults. Errors: InvalidValue.

        A field of a command is never unknown: its default is what the older version sent.
        """
        known = self.header.get("turn_fields")
        if not isinstance(known, dict):
            known = self._written_names()
        found = []
        for each in exact_fields(TickRecord):
            names = known.get(each.owner)
            is_listed = not isinstance(names, (list, set)) or each.name in names
            if not (is_listed or each.path.startswith("command.")):
                found.append(each)
        return tuple(found)

    def _written_names(self) -> dict[str, set[str]]:
        """The names of the fields that a log without ``turn_fields`` may contain, keyed by
        dataclass.

        A field that is left out while it is None counts as contained, because its value may have
        been None.
        """
        names: dict[str, set[str]] = {}
        if self.turns:  # raises an error if turns are unreadable
            for record in self.turn_records:
                collect_written_names(TickRecord, _whole_turn(record), names)
        for each in exact_fields(TickRecord):
            is_since_4 = each.owner == "Turn" and each.name in ("outcome", "reason", "error")
            # Logs without ``turn_fields`` are all older than this field.
            is_newer = each.owner == "TargetEstimate" and each.name.startswith("measured_offset")
            is_newer = is_newer or (is_since_4 and self.header["version"] < 4)
            if each.is_always_written or is_newer:
                continue
            if each.owner in names:
                names[each.owner].add(each.name)
        return names

    @cached_property
    def sent(self) -> list[SentCommand]:
        """Commands sent outside of turns; empty in logs before version 4. Errors: InvalidValue."""
        return [parse_exact(SentCommand, record) for record in self.sent_records]

    def column(self, key: str) -> Array:
        """The values of field `key` in all ticks, shape (n,); NaN where missing.

        Raises InvalidValue for a value that is not a number.
        """
        try:
            values = [np.nan if r.get(key) is None else float(r[key]) for r in self.records]
        except (TypeError, ValueError):
            raise InvalidValue(f"{self.path}: {key} is not a number in every record") from None
        return np.array(values, dtype=np.float64)

    def texts(self, key: str) -> list[str]:
        """The values of field `key` in all ticks as text, empty where missing."""
        return [str(record.get(key) or "") for record in self.records]

    @cached_property
    def phases(self) -> tuple[PhaseSpan, ...]:
        """The phases in the order in which they were entered, including a final phase without
        ticks. If the log contains events, each has the row of its transition."""
        spans: list[PhaseSpan] = []
        for record in self.records:
            t_s, phase = self.to_flight_s(float(record["t_s"])), str(record.get("phase") or "")
            if spans:
                spans[-1] = replace(spans[-1], end_s=t_s)
            if not spans or spans[-1].phase != phase:
                spans.append(PhaseSpan(phase, t_s, t_s, str(record.get("reason") or "")))
        for event in (e for e in self.events if e.get("event") == "phase"):
            at_s, phase = self.to_flight_s(float(event["t_s"])), str(event.get("phase") or "")
            words = [str(event.get(k) or "") for k in ("reason", "row", "severity", "simulated")]
            begun = [k for k, span in enumerate(spans) if abs(span.start_s - at_s) < SAME_S]
            for k in begun:
                if spans[k].phase == phase and not spans[k].row:
                    reason = spans[k].reason or words[0]
                    spans[k] = PhaseSpan(
                        phase, spans[k].start_s, spans[k].end_s, reason, *words[1:]
                    )
            if not begun and spans and at_s > spans[-1].end_s - SAME_S:
                spans.append(PhaseSpan(phase, at_s, at_s, *words))
        return tuple(spans)

    def csv(self) -> str:
        """The ticks as CSV: a line with the field names, then one line per tick, with times from 0;
        missing values are empty. Errors: InvalidValue for a log without ticks."""
        if not self.records:
            raise InvalidValue(f"{self.path}: the log has no ticks, so there is nothing to export")
        text = StringIO()
        table = csv.DictWriter(text, FIELDS, extrasaction="ignore", lineterminator="\n")
        table.writeheader()
        for record in self.records:
            times_s = {key: record[key] for key in TIMES if record[key] is not None}
            since_s = {key: round(self.to_flight_s(t_s), 6) for key, t_s in times_s.items()}
            table.writerow(record | since_s)
        return text.getvalue()

    # --- times

    @property
    def start_s(self) -> float:
        """Time of the first flown turn on the loop's clock, the zero of all times that are output;
        0 if no turn was flown."""
        flown = (r for r in self.turn_records if r.get("role") == "flown")
        first = self.records[0] if self.records else next(flown, None)
        return 0.0 if first is None else float(first["t_s"])

    def to_flight_s(self, t_s: Times) -> Times:
        """Convert times on the loop's clock to times since the first flown turn."""
        return t_s - self.start_s

    @cached_property
    def t_s(self) -> Array:
        """Times of the ticks, measured from the flight's first turn, shape (n,)."""
        return self.to_flight_s(self.column("t_s"))

    @property
    def end_s(self) -> float:
        """Time of the last tick, measured from the flight's first turn; 0 if there are no ticks."""
        return self.to_flight_s(float(self.records[-1]["t_s"])) if self.records else 0.0

    def tick_index_at(self, t_s: float) -> int:
        """Index of the last tick at or before `t_s`, which is measured from the first turn; 0
        before the first tick."""
        return max(0, int(np.searchsorted(self.t_s, t_s + SAME_S / 2, side="right")) - 1)

    def tick_slice(self, start_s: float, end_s: float) -> slice:
        """Slice of the ticks in [start_s, end_s), measured from the first turn."""
        first, last = np.searchsorted(self.t_s, (start_s - SAME_S / 2, end_s - SAME_S / 2))
        return slice(int(first), int(last))

    # --- the setup of the flight

    @property
    def profile_name(self) -> str | None:
        """Name of the flown profile; None if the header contains none."""
        profile = self.header.get("profile")
        name = profile.get("name") if isinstance(profile, dict) else None
        return None if name is None else str(name)

    @property
    def setup_text(self) -> str:
        """The flown profile's name and, for a simulated flight, the seed, for messages."""
        seed = self.header.get("seed")
        return f"profile {self.profile_name or '?'}" + ("" if seed is None else f", seed {seed}")

    @property
    def injected_fault(self) -> str | None:
        """Description of the fault that was injected into a simulated flight; None without one, and
        in logs written before perchctl 0.4."""
        fault = self.header.get("fault")
        return None if fault is None else str(fault)

    @property
    def flown_profile(self) -> Profile:
        """The flown profile, without passwords. A `Note` warns about each key that has become a
        constant but was flown with another value. Errors: InvalidValue."""
        values = self.header.get("profile")
        for found in Profile.constant_key_errors(values) if isinstance(values, dict) else ():
            warnings.warn(f"an older perchctl flew this flight: {found}", Note, stacklevel=2)
        try:
            return Profile.model_validate(values, extra="ignore")
        except ValidationError as error:
            key, text = key_and_reason(error)
            raise InvalidValue(
                f"the log's profile cannot be used by this version of perchctl: "
                f"{key or 'profile'}: {text}"
            ) from None

    @property
    def flown_camera(self) -> CameraModel | None:
        """The calibration used in the flight; None if the log does not contain it. Errors:
        InvalidValue."""
        if self.header.get("camera") is None:
            return None
        try:
            return from_exact_json(CameraModel, self.header["camera"])
        except ValueError as error:
            raise InvalidValue(
                f"the log's header contains no valid calibration: camera: {error}"
            ) from None

    @property
    def has_position_variance(self) -> bool:
        """True if the log contains the position variance whenever the vehicle reported it."""
        return bool(self.header.get("version", 0) >= NAMED_VERSION)

    def flown_mask(self, camera: CameraModel) -> NDArray[np.bool_] | None:
        """The mask used in the flight (height, width), True on the gear; None without a mask.
        Errors: InvalidValue."""
        text = self.header.get("mask")
        if text is None:
            return None
        width, height = camera.size_px
        try:
            packed = zlib.decompress(base64.b64decode(text))
            bits = np.unpackbits(np.frombuffer(packed, dtype=np.uint8))
            return bits[: width * height].reshape(height, width).astype(bool)
        except (ValueError, TypeError, zlib.error) as error:
            raise InvalidValue(f"the log's header contains no valid mask: {error}") from None

    @property
    def computer_differences(self) -> str:
        """The differences between the flight's computer and this one, in words; empty if there are
        none or if the log does not record them."""
        was, here = self.header.get("computer"), computer_record()["computer"]
        if not isinstance(was, dict):
            return ""
        return ", ".join(
            f"{key} {was[key]} (here {here[key]})"
            for key in here
            if key in was and was[key] != here[key]
        )


TIMES = ("t_s", "frame_t_s")
"""Fields that are times on the loop's clock in the log; in a table, they are measured from the
first iteration in which the vehicle was flown."""


# --- the file ---


def read_log(path: Path | str) -> FlightLog:
    """Read a flight log, compressed by gzip or not. An unreadable tail is ignored, and its length
    is recorded.

    Raises NotFound if there is no such file, and InvalidValue, with the line number, if it is not a
    flight log or is damaged anywhere but at its end.
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
            if header["version"] < NAMED_VERSION:
                record = _with_named_variance(record)
        except ValueError as error:
            bad = bad or (number, str(error))
            ignored += len(line)
            continue
        if bad is not None:
            raise InvalidValue(
                f"{path}: line {bad[0]}: not a record of a flight log ({bad[1]}), but records "
                "follow it: the file is damaged, use the original"
            )
        good.append(record)
    summary = next((r for r in good if r["kind"] == "summary"), None)
    blank = dict.fromkeys(FIELDS)
    return FlightLog(
        path=path,
        header=header,
        records=[blank | _without_kind(r) for r in good if r["kind"] == "tick"],
        events=[_without_kind(r) for r in good if r["kind"] == "event"],
        summary=None if summary is None else _without_kind(summary),
        truncated=summary is None or ignored > 0,
        ignored_bytes=ignored,
        turn_records=[r for r in good if r["kind"] == "turn"],
        sent_records=[r for r in good if r["kind"] == "sent"],
    )


@contextlib.contextmanager
def wrap_log_errors(path: Path) -> Iterator[None]:
    """Context manager that converts errors caused by damaged values in a log to InvalidValue."""
    try:
        yield
    except OSError:
        raise
    except (TypeError, ValueError, LookupError, AttributeError) as error:
        raise InvalidValue(
            f"{path}: contains a value that no flight writes ({error}): use the original"
        ) from error


def _lines(path: Path) -> list[bytes]:
    """Read the lines of a file. Return no lines for a file that cannot be a log, since it may be a
    video of several gigabytes. The end of a truncated compressed file is lost."""
    lines: list[bytes] = []
    try:
        with path.open("rb") as file:
            is_packed = file.peek(len(_GZIP)).startswith(_GZIP)
            stream = gzip.GzipFile(fileobj=file) if is_packed else file
            with contextlib.suppress(gzip.BadGzipFile, EOFError, zlib.error):
                if stream.peek(1).startswith(b"{"):
                    lines.extend(stream)
    except FileNotFoundError:
        raise NotFound(f"flight log {path} does not exist") from None
    except IsADirectoryError:
        raise NotFound(f"flight log {path} is a folder; name one of its .jsonl files") from None
    except OSError as error:
        raise NotFound(f"flight log {path} cannot be read: {error.strerror}") from None
    return lines


def _header(path: Path, lines: list[bytes]) -> dict[str, Any]:
    try:
        header = decode_line(lines[0])
    except (IndexError, ValueError):
        header = {}
    if header.get("kind") != "header" or header.get("format") != FORMAT:
        kind = kind_note(path, "a flight log", "a JSON file") or ", or truncated in its header"
        raise InvalidValue(
            f"{path}: line 1: not a perchctl flight log{kind}; logs are the .jsonl files in "
            "the profile's log.directory"
        )
    version = header.get("version")
    if version not in READABLE_VERSIONS:
        raise InvalidValue(
            f"{path}: line 1: schema version {version!r}, but this perchctl reads 1 to "
            f"{SCHEMA_VERSION}; the log was written by perchctl "
            f"{header.get('perchctl', 'of unknown version')}, and this is {__version__}: "
            "update perchctl"
        )
    return header


def _checked(record: dict[str, Any]) -> dict[str, Any]:
    kind = record.get("kind")
    if kind not in KINDS:
        raise ValueError(f"kind {kind!r} is unknown; allowed are {', '.join(KINDS)}")
    t_s: Any = record.get("t_s")
    is_time = type(t_s) in (int, float) and abs(t_s) < math.inf
    if not is_time and kind not in ("summary", "recording"):
        raise ValueError(f"t_s must be a number of seconds, found {t_s!r}")
    return record


NAMED_VERSION = 5
"""From this version on, a log has the variances of velocity and position under their own names."""
_NAMES = {"position_variance_m2": "velocity_variance_m2ps2", "var_m2": "vel_var_m2ps2"}


def _with_named_variance(value: Any) -> Any:
    """Return a value from an older log, in which the velocity variance was stored under the name of
    the position variance, with the correct name."""
    if isinstance(value, list):
        return [_with_named_variance(part) for part in value]
    if isinstance(value, dict):
        return {_NAMES.get(key, key): _with_named_variance(part) for key, part in value.items()}
    return value


def _without_kind(record: Mapping[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in record.items() if k != "kind"}


# --- turns, and commands sent in the loop's place ---


def parse_turn(record: dict[str, Any]) -> TickRecord:
    """Restore the turn in a record, bit for bit. Errors: InvalidValue."""
    return parse_exact(TickRecord, _whole_turn(record))


def _whole_turn(record: dict[str, Any]) -> dict[str, Any]:
    """Return the record with the observation's telemetry filled in: a line in the log contains this
    telemetry only once, among the samples."""
    obs, taken = record.get("observation"), record.get("taken")
    if isinstance(obs, dict) and "telemetry" not in obs and isinstance(taken, dict):
        samples = taken.get("late") or taken.get("samples")
        if isinstance(samples, list) and samples:
            return record | {"observation": obs | {"telemetry": samples[-1]}}
    return record


def parse_exact(kind: type[Exact], record: Mapping[str, Any]) -> Exact:
    """Restore the `TickRecord` or `SentCommand` in a record, bit for bit. Errors: InvalidValue."""
    try:
        return from_exact_json(kind, _without_kind(record))
    except ValueError as error:
        raise InvalidValue(
            f"the log's {record.get('kind')} at {record.get('t_s')} s cannot be read ({error}): "
            f"the log is damaged, or another version of perchctl wrote it"
        ) from None
