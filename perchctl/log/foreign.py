"""What a file is that is no flight log, or no whole one, in words."""

from __future__ import annotations

import json
from pathlib import Path

from perchctl.log.place import path_beside

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
