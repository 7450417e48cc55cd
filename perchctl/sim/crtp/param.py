"""The parameter port: table, values, and which of them are persistent."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from perchctl.sim.crtp.codec import BY_CTYPE, Packet, Port, Status, Toc

if TYPE_CHECKING:
    from perchctl.sim.firmware import Firmware

_TOC, _READ, _WRITE, _MISC = 0, 1, 2, 3
_EXTENDED_TYPE_V2 = 7
_EXTENDED, _READ_ONLY = 0x10, 0x40
_IS_PERSISTENT = 1


class ParamService:
    """Serves the parameter port of one firmware."""

    def __init__(self, firmware: Firmware) -> None:
        self.firmware = firmware
        self._numbers = {name: BY_CTYPE[p.ctype] for name, p in firmware.PARAMETERS.items()}
        codes = {}
        for name, parameter in firmware.PARAMETERS.items():
            code = self._numbers[name].param_code
            assert code is not None, f"{parameter.ctype} is no type of a parameter"
            extended = _EXTENDED if parameter.persistent else 0
            codes[name] = code | extended | (_READ_ONLY if parameter.readonly else 0)
        self.toc = Toc(Port.PARAM, codes)

    def handle(self, packet: Packet) -> list[Packet]:
        """The answers to one packet; a command that is not simulated has none."""
        if packet.channel == _TOC:
            return self.toc.handle(packet)
        if not packet.data:
            return []
        if packet.channel == _READ:
            answer = self._read(packet.data)
        elif packet.channel == _WRITE:
            answer = self._write(packet.data)
        else:
            answer = self._misc(packet.data)
        return [Packet(Port.PARAM, packet.channel, answer)] if answer else []

    def _value(self, name: str) -> bytes:
        return self._numbers[name].pack(self.firmware.get_parameter(name))

    def _read(self, data: bytes) -> bytes:
        name = self.toc.name(data[:2])
        if name is None:
            return data[:2] + bytes((Status.ENOENT,))
        return data[:2] + bytes((Status.OK,)) + self._value(name)

    def _write(self, data: bytes) -> bytes:
        """Answers with the value that is kept; a read-only one is passed over in silence."""
        name = self.toc.name(data[:2])
        if name is None:
            return data[:2] + bytes((Status.ENOENT,))
        if self.firmware.PARAMETERS[name].readonly:
            return b""
        try:
            self.firmware.set_parameter(name, self._numbers[name].unpack(data[2:]))
        except struct.error:
            return b""
        return data[:2] + self._value(name)

    def _misc(self, data: bytes) -> bytes:
        if data[0] != _EXTENDED_TYPE_V2:
            return b""
        name, head = self.toc.name(data[1:3]), data[:3]
        if name is None or not self.firmware.PARAMETERS[name].persistent:
            return head + bytes((Status.ENOENT,))
        return head + bytes((Status.OK, _IS_PERSISTENT))
