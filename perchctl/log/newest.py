"""Which logs a folder holds, the newest first, and how each ended: without reading them whole."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from perchctl.errors import NotFound, PerchError
from perchctl.log.jsonl import decode_line
from perchctl.log.read import READABLE_VERSIONS, FlightLog, read_log
from perchctl.log.summary import FlightSummary, summarise_flight

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
