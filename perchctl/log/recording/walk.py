"""Reading an MCAP file from its beginning, as far as it goes: a killed flight's has no index."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from mcap.exceptions import InvalidMagic, McapError
from mcap.records import Channel, McapRecord, Message
from mcap.stream_reader import StreamReader

from perchctl.errors import InvalidValue, NotFound

_TORN = (McapError, ValueError, RuntimeError, struct.error, UnicodeDecodeError)
"""What the library raises for a record that is cut or damaged; lz4's errors among them."""


@dataclass(frozen=True)
class Walked:
    """One message as it lies in the file."""

    topic: str
    sequence: int
    log_ns: int
    data: bytes


def walk(path: Path, topics: Sequence[str]) -> Iterator[Walked]:
    """The messages of the topics in the file's order, up to its end or its first torn record.

    Errors: NotFound where there is no file, InvalidValue where it is no MCAP file.
    """
    names: dict[int, str] = {}
    for record in _records(path):
        if isinstance(record, Channel):
            names[record.id] = record.topic
        elif isinstance(record, Message) and names.get(record.channel_id) in topics:
            yield Walked(names[record.channel_id], record.sequence, record.log_time, record.data)


def _records(path: Path) -> Iterator[McapRecord]:
    try:
        stream = path.open("rb")
    except FileNotFoundError:
        raise NotFound(
            f"recording {path} does not exist: a flight is recorded with --record"
        ) from None
    except OSError as error:
        raise NotFound(f"recording {path} cannot be read: {error.strerror}") from None
    with stream:
        records = iter(StreamReader(stream, validate_crcs=True).records)
        first = True
        while True:
            try:
                record = next(records)
            except StopIteration:
                return
            except (InvalidMagic, *_TORN) as error:
                if first:
                    raise InvalidValue(
                        f"{path} is no recording: it does not begin as an MCAP file does"
                    ) from error
                return
            first = False
            yield record
