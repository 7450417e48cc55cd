"""The radio chip of a simulated vehicle, which answers as docs/firmware.md has it ("Safelink")."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

_NULL, _SAFELINK = 0xF3, 0x05


class Chip:
    """The radio chip of a vehicle: safelink, and the packets that wait for their turn.

    `waiting` are those; `take` gets each packet that comes, once.
    """

    def __init__(self, take: Callable[[bytes], None]) -> None:
        self.waiting: deque[bytes] = deque()
        self._take = take
        self._safelink, self._up, self._down = False, 1, 1
        self._last = b""

    def acknowledge(self, data: bytes) -> bytes:
        """The acknowledgement of a packet."""
        head = data[0]
        if len(data) == 3 and head & _NULL == _NULL and data[1] == _SAFELINK:
            self._safelink, self._up, self._down = bool(data[2]), 1, 1
            self._last = data
            return data
        if not self._safelink or head & 0x08 != self._up << 3:
            self._up = 1 - self._up
            if head & _NULL != _NULL:
                self._take(data)
        if not self._safelink or head & 0x04 != self._down << 2:
            self._down = 1 - self._down
            self._last = self.waiting.popleft() if self.waiting else bytes((_NULL,))
            if self._safelink:
                self._last = bytes((self._last[0] & _NULL | self._down << 2,)) + self._last[1:]
        return self._last
