"""The parameter port: table, values, extended types and what the EEPROM keeps."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from perchctl.sim.crtp.codec import BY_CTYPE, BY_PARAM_CODE, Number, Packet, Port, Status
from perchctl.sim.crtp.toc import Toc, not_found

if TYPE_CHECKING:
    from perchctl.sim.firmware import Firmware

_TOC, _READ, _WRITE, _MISC = 0, 1, 2, 3
_SET_BY_NAME = 0
_EXTENDED_TYPE, _STORE, _GET_STATE, _CLEAR, _DEFAULT = 2, 3, 4, 5, 6
_EXTENDED_TYPE_V2, _DEFAULT_V2 = 7, 8
_FIRST_WITH_V2_MISC = 11  # protocol version
_EXTENDED, _READ_ONLY = 0x10, 0x40
_IS_PERSISTENT = 1


class ParamService:
    """Serves the parameter port of one firmware. What was stored survives a reboot."""

    def __init__(self, firmware: Firmware, protocol_version: int) -> None:
        self._firmware = firmware
        self._protocol_version = protocol_version
        self._stored: dict[str, bytes] = {}
        self._numbers: dict[str, Number] = {}
        entries = {}
        for name, parameter in firmware.PARAMETERS.items():
            number = BY_CTYPE[parameter.ctype]
            if number.param_code is None:
                raise ValueError(f"{parameter.ctype} is no type of a parameter")
            self._numbers[name] = number
            entries[name] = (
                number.param_code
                | (_EXTENDED if parameter.persistent else 0)
                | (_READ_ONLY if parameter.readonly else 0)
            )
        self.toc = Toc(Port.PARAM, entries)

    def rebooted(self, firmware: Firmware) -> None:
        """The firmware started again: stored values are read back."""
        self._firmware = firmware
        for name, raw in self._stored.items():
            firmware.set_parameter(name, self._numbers[name].unpack(raw))

    def handle(self, packet: Packet) -> list[Packet]:
        data = packet.data
        if not data:
            return []
        answer: bytes | None
        if packet.channel == _TOC:
            reply = self.toc.answer(data)
            return [reply] if reply is not None else []
        if packet.channel == _READ:
            answer = self._read(data)
        elif packet.channel == _WRITE:
            answer = self._write(data)
        else:
            answer = self._misc(data)
        return [Packet(Port.PARAM, packet.channel, answer)] if answer is not None else []

    def _name(self, ident: bytes) -> str | None:
        return self.toc.name(int.from_bytes(ident, "little")) if len(ident) == 2 else None

    def _value(self, name: str) -> bytes:
        return self._numbers[name].pack(self._firmware.get_parameter(name))

    def _read(self, data: bytes) -> bytes | None:
        name = self._name(data[:2])
        if name is None:
            return not_found(data[:2])
        return data[:2] + bytes((Status.OK,)) + self._value(name)

    def _write(self, data: bytes) -> bytes | None:
        """Answers with the value that is kept; a read-only one is passed over in silence."""
        name = self._name(data[:2])
        if name is None:
            return not_found(data[:2])
        if self._set(name, self._numbers[name], data[2:]) is not Status.OK:
            return None
        return data[:2] + self._value(name)

    def _set(self, name: str, number: Number, raw: bytes) -> Status:
        if self._firmware.PARAMETERS[name].readonly:
            return Status.EACCES
        try:
            self._firmware.set_parameter(name, number.unpack(raw))
        except struct.error:
            return Status.E2BIG
        return Status.OK

    def _misc(self, data: bytes) -> bytes | None:
        command, head = data[0], data[:3]
        if command == _SET_BY_NAME:
            return self._set_by_name(data)
        if (
            command in (_EXTENDED_TYPE_V2, _DEFAULT_V2)
            and self._protocol_version < _FIRST_WITH_V2_MISC
        ):
            return None
        ok = bytes((Status.OK,))
        name = self._name(data[1:3])
        parameter = self._firmware.PARAMETERS[name] if name is not None else None
        if name is None or parameter is None:
            return not_found(head)
        if command in (_EXTENDED_TYPE, _EXTENDED_TYPE_V2):
            if not parameter.persistent:
                return not_found(head)
            kind = bytes((_IS_PERSISTENT,))
            return head + (ok + kind if command == _EXTENDED_TYPE_V2 else kind)
        if command in (_DEFAULT, _DEFAULT_V2):
            if parameter.readonly:
                return not_found(head)
            return head + (ok if command == _DEFAULT_V2 else b"") + self._default(name)
        if command not in (_STORE, _GET_STATE, _CLEAR):
            return None
        return self._persistent(command, head, name) if parameter.persistent else not_found(head)

    def _persistent(self, command: int, head: bytes, name: str) -> bytes:
        if command == _STORE:
            self._stored[name] = self._value(name)
        elif command == _CLEAR:
            self._stored.pop(name, None)
        else:
            stored = self._stored.get(name)
            flag = bytes((stored is not None,))
            return head + flag + self._default(name) + (stored or b"")
        return head + bytes((Status.OK,))

    def _default(self, name: str) -> bytes:
        return self._numbers[name].pack(self._firmware.PARAMETERS[name].default)

    def _set_by_name(self, data: bytes) -> bytes | None:
        parts = data[1:].split(b"\0", 2)
        if len(parts) < 3 or not parts[2]:
            return None
        group, short, rest = parts
        name = f"{group.decode(errors='replace')}.{short.decode(errors='replace')}"
        number = BY_PARAM_CODE.get(rest[0])
        if name not in self._numbers or number is not self._numbers[name]:
            status = Status.ENOENT
        else:
            status = self._set(name, number, rest[1:])
        return data[: 3 + len(group) + len(short)] + bytes((status,))
