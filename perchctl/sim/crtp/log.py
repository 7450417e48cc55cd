"""The log port: blocks of variables, sent with their period while they run.

Limits as measured: 26 bytes a block, period 10 ms x 1..254, 16 blocks, 128 variables
(docs/firmware.md, "Link").
"""

from __future__ import annotations

import struct
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from perchctl.sim.crtp.codec import BY_CTYPE, BY_LOG_CODE, Number, Packet, Port, Status, Toc

if TYPE_CHECKING:
    from perchctl.sim.firmware import Firmware

MAX_BLOCK_BYTES = 26
MAX_BLOCKS = 16
MAX_VARIABLES = 128
PERIOD_UNIT_S = 0.010
_TOC, _SETTINGS, _DATA = 0, 1, 2
_DELETE, _START, _STOP, _RESET, _CREATE_V2, _APPEND_V2 = range(2, 8)
_ENTRY_BYTES = 3
_EPS_S = 1e-6


@dataclass
class _Block:
    variables: list[tuple[str, Number]] = field(default_factory=list)
    period_s: float = 0.0
    due_s: float | None = None  # None: stopped

    @property
    def size(self) -> int:
        return sum(number.size for _, number in self.variables)


class LogService:
    """Serves the log port of one firmware; `missing` names are left out of the table."""

    def __init__(self, firmware: Firmware, missing: Collection[str] = ()) -> None:
        self._firmware = firmware
        codes = {
            name: BY_CTYPE[ctype].log_code
            for name, ctype in firmware.LOG_VARIABLES.items()
            if name not in missing
        }
        self.toc = Toc(Port.LOG, codes, bytes((MAX_BLOCKS, MAX_VARIABLES)))
        self._blocks: dict[int, _Block] = {}

    def rebooted(self, firmware: Firmware, *, keep_blocks: bool = False) -> None:
        """Time starts again; the blocks are lost unless kept (a test's short cut)."""
        self._firmware = firmware
        if not keep_blocks:
            self._blocks.clear()
        for block in self._blocks.values():
            if block.due_s is not None:
                block.due_s = firmware.t_s + block.period_s

    def handle(self, packet: Packet) -> list[Packet]:
        """The answers to one packet."""
        if packet.channel == _TOC:
            return self.toc.handle(packet)
        if packet.channel != _SETTINGS or not packet.data:
            return []
        command, ident = packet.data[0], packet.data[1] if len(packet.data) > 1 else 0
        status, extra = self._settings(command, ident, packet.data[2:])
        return [Packet(Port.LOG, _SETTINGS, bytes((command, ident, status))), *extra]

    def due(self) -> list[Packet]:
        """Data packets whose time has come."""
        now_s = self._firmware.t_s
        packets = []
        for ident, block in self._blocks.items():
            if block.due_s is not None and block.due_s <= now_s + _EPS_S:
                packets.append(self._data(ident, block))
                block.due_s = max(block.due_s + block.period_s, now_s)
        return packets

    def _settings(self, command: int, ident: int, rest: bytes) -> tuple[Status, list[Packet]]:
        block = self._blocks.get(ident)
        if command == _RESET:
            self._blocks.clear()
            return Status.OK, []
        if command == _CREATE_V2:
            if block is not None:
                return Status.EEXIST, []
            if len(self._blocks) >= MAX_BLOCKS:
                return Status.ENOMEM, []
            self._blocks[ident] = _Block()
            return self._append(self._blocks[ident], rest), []
        if command not in (_APPEND_V2, _DELETE, _START, _STOP):
            return Status.ENOEXEC, []
        if block is None:
            return Status.ENOENT, []
        if command == _APPEND_V2:
            return self._append(block, rest), []
        if command == _START:
            return Status.OK, self._start(ident, block, rest[0] if rest else 0)
        block.due_s = None
        if command == _DELETE:
            del self._blocks[ident]
        return Status.OK, []

    def _append(self, block: _Block, rest: bytes) -> Status:
        """Adds variables until one does not fit; an incomplete last entry is ignored.

        cflib leaves one stray byte at the end of a full packet.
        """
        for at in range(0, len(rest) - _ENTRY_BYTES + 1, _ENTRY_BYTES):
            number = BY_LOG_CODE.get(rest[at] & 0x0F)
            name = self.toc.name(rest[at + 1 : at + _ENTRY_BYTES])
            if name is None or number is None:
                return Status.ENOENT
            if block.size + number.size > MAX_BLOCK_BYTES:
                return Status.E2BIG
            if sum(len(b.variables) for b in self._blocks.values()) >= MAX_VARIABLES:
                return Status.ENOMEM
            block.variables.append((name, number))
        return Status.OK

    def _start(self, ident: int, block: _Block, period: int) -> list[Packet]:
        if period == 0:  # the firmware sends once
            return [self._data(ident, block)]
        block.period_s = period * PERIOD_UNIT_S
        block.due_s = self._firmware.t_s + block.period_s
        return []

    def _data(self, ident: int, block: _Block) -> Packet:
        stamp_ms = round(self._firmware.t_s * 1000.0) & 0xFFFFFF
        head = struct.pack("<I", ident | stamp_ms << 8)
        read = self._firmware.log_value
        body = b"".join(number.pack(read(name)) for name, number in block.variables)
        return Packet(Port.LOG, _DATA, head + body)
