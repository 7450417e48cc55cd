"""The memory port: which memories the vehicle has, and reading and writing them."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass

from perchctl.sim.crtp.codec import Packet, Port, Status

_INFO, _READ, _WRITE = 0, 1, 2
_VERSION, _COUNT, _DETAILS = 0, 1, 2
_CHUNK = 24
I2C, ONE_WIRE, LEDS, TRAJECTORY, TESTER = 0x00, 0x01, 0x10, 0x12, 0x15


@dataclass
class _Memory:
    kind: int
    size: int
    serial: bytes = bytes(8)
    content: bytearray | None = None  # None: each byte is its address (the tester)

    def read(self, at: int, length: int) -> bytes:
        if self.content is None:
            return bytes((at + i) & 0xFF for i in range(length))
        return bytes(self.content[at : at + length])

    def write(self, at: int, data: bytes) -> None:
        if self.content is not None:
            self.content[at : at + len(data)] = data


class MemService:
    """EEPROM, LED driver, trajectory, tester and the flow deck's 1-wire memory."""

    def __init__(self) -> None:
        serial = bytes.fromhex("0D2F4C1BA0000055")
        makers: tuple[Callable[[], _Memory], ...] = (
            lambda: _Memory(I2C, 8192, content=_filled(8192, _eeprom())),
            lambda: _Memory(LEDS, 24, content=bytearray(24)),
            lambda: _Memory(TRAJECTORY, 4096, content=bytearray(4096)),
            lambda: _Memory(TESTER, 4096),
            lambda: _Memory(ONE_WIRE, 112, serial, _filled(112, _flow_deck())),
        )
        self._memories = [make() for make in makers]

    def handle(self, packet: Packet) -> list[Packet]:
        data = packet.data
        if packet.channel == _INFO and data:
            answer = self._info(data)
        elif packet.channel == _READ and len(data) >= 6:
            answer = self._read(data)
        elif packet.channel == _WRITE and len(data) >= 5:
            answer = self._write(data)
        else:
            return []
        return [Packet(Port.MEM, packet.channel, answer)] if answer else []

    def _info(self, data: bytes) -> bytes:
        if data[0] == _VERSION:
            return bytes((_VERSION, 1))
        if data[0] == _COUNT:
            return bytes((_COUNT, len(self._memories)))
        if data[0] != _DETAILS or len(data) < 2:
            return b""
        ident = data[1]
        if ident >= len(self._memories):
            return data[:2]
        memory = self._memories[ident]
        return struct.pack("<BBBI", _DETAILS, ident, memory.kind, memory.size) + memory.serial

    def _place(self, data: bytes, length: int) -> tuple[_Memory, int] | None:
        ident, at = struct.unpack_from("<BI", data)
        if ident >= len(self._memories) or length > _CHUNK:
            return None
        memory = self._memories[ident]
        return (memory, at) if at + length <= memory.size else None

    def _read(self, data: bytes) -> bytes:
        place = self._place(data, data[5])
        if place is None:
            return data[:5] + bytes((Status.EACCES,))
        memory, at = place
        return data[:5] + bytes((Status.OK,)) + memory.read(at, data[5])

    def _write(self, data: bytes) -> bytes:
        place = self._place(data, len(data) - 5)
        if place is None:
            return data[:5] + bytes((Status.EACCES,))
        memory, at = place
        memory.write(at, data[5:])
        return data[:5] + bytes((Status.OK,))


def _filled(size: int, content: bytes) -> bytearray:
    return bytearray(content.ljust(size, b"\xff"))


def _eeprom() -> bytes:
    """The radio's settings, version 1: channel 80, 2 Mbit/s, address E7E7E7E7E7."""
    body = b"0xBC" + struct.pack("<BBBffBI", 1, 80, 2, 0.0, 0.0, 0xE7, 0xE7E7E7E7)
    return body + bytes((sum(body) % 256,))


def _flow_deck() -> bytes:
    """A deck's description: header, then board name and revision, each with a CRC."""
    header = struct.pack("<BIBB", 0xEB, 0, 0xBC, 0x0F)
    name, revision = b"bcFlow2", b"A"
    body = bytes((1, len(name))) + name + bytes((2, len(revision))) + revision
    elements = bytes((0, len(body))) + body
    return _with_crc(header) + _with_crc(elements)


def _with_crc(data: bytes) -> bytes:
    return data + bytes((zlib.crc32(data) & 0xFF,))
