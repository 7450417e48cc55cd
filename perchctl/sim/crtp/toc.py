"""Tables of contents: which log variables and parameters there are, by number.

cflib keeps a table in a file named after its CRC, so the CRC follows from the
contents and nothing else: the same table has the same CRC in every process.
"""

from __future__ import annotations

import struct
import zlib

from perchctl.sim.crtp.codec import MAX_DATA, Packet, Status

ITEM, INFO, ITEM_V2, INFO_V2 = 0, 1, 2, 3


class Toc:
    """One table. `entries` maps a complete name ("group.name") to its type byte."""

    def __init__(self, port: int, entries: dict[str, int], info_tail: bytes = b"") -> None:
        self.port = port
        self.names = list(entries)
        self._info_tail = info_tail
        self._items = [_item(name, code) for name, code in entries.items()]
        self._crc = zlib.crc32(bytes((port,)) + b"".join(self._items))

    def __len__(self) -> int:
        return len(self.names)

    def name(self, ident: int) -> str | None:
        return self.names[ident] if ident < len(self.names) else None

    def answer(self, data: bytes) -> Packet | None:
        """The reply to a request on channel 0, both versions of the protocol."""
        command = data[0]
        count = len(self)
        if command == INFO_V2:
            body = struct.pack("<BHI", command, count, self._crc) + self._info_tail
        elif command == INFO:
            body = struct.pack("<BBI", command, min(count, 255), self._crc) + self._info_tail
        elif command == ITEM_V2 and len(data) >= 3:
            body = self._item_answer(data[:3], int.from_bytes(data[1:3], "little"))
        elif command == ITEM and len(data) >= 2:
            body = self._item_answer(data[:2], data[1])
        else:
            return None
        return Packet(self.port, 0, body)

    def _item_answer(self, head: bytes, ident: int) -> bytes:
        return head + self._items[ident] if ident < len(self) else head[:1]


def _item(name: str, code: int) -> bytes:
    group, _, short = name.partition(".")
    item = bytes((code,)) + group.encode() + b"\0" + short.encode() + b"\0"
    if len(item) + 3 > MAX_DATA:
        raise ValueError(f"the name {name} does not fit into a packet")
    return item


def not_found(head: bytes) -> bytes:
    """`head` with the status "no such entry"."""
    return head + bytes((Status.ENOENT,))
