"""A link that plays a script, for tests of the flight loop."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable

from perchctl.errors import ConnectionFailed
from perchctl.link.protocol import Guard, SentCallback, ignore_sent
from perchctl.vehicle import Command, ExternalPosition, Telemetry


class ScriptedLink:
    """Plays telemetry by time and records commands."""

    def __init__(
        self, telemetry: Iterable[Telemetry], *, refuse: str = "", dies_at_s: float = math.inf
    ) -> None:
        self._script = deque(telemetry)
        self._refuse = refuse
        self._dies_at_s = dies_at_s
        self.now_s = 0.0
        self.sent: list[tuple[float, Command]] = []
        self.places: list[tuple[float, ExternalPosition]] = []
        self.closed = False

    def advance_to(self, t_s: float) -> None:
        self.now_s = t_s

    def connect(self) -> None:
        if self._refuse:
            raise ConnectionFailed(self._refuse)

    def decks(self) -> tuple[str, ...]:
        return ("bcFlow2",)

    def telemetry(self) -> list[Telemetry]:
        arrived = []
        while self._script and self._script[0].t_s <= self.now_s:
            arrived.append(self._script.popleft())
        return arrived

    def send(self, command: Command) -> None:
        self.sent.append((self.now_s, command))

    def problem(self, now_s: float) -> str | None:
        return "the script ended the link" if now_s >= self._dies_at_s else None

    def external(self, place: ExternalPosition) -> bool:
        self.places.append((self.now_s, place))
        return True

    def set_guard(self, guard: Guard, on_sent: SentCallback = ignore_sent) -> None:
        self.watchdog, self.told = guard, on_sent

    def close(self) -> None:
        self.closed = True
