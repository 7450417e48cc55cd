"""The lockstep sibling of the cflib link: same protocol, same packets, no wall clock.

`MockLink` flies a `SimulatedVehicle`; `ScriptedLink` plays back a list of
telemetry and records the commands.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from typing import TYPE_CHECKING

from perchctl.errors import ConnectionFailed
from perchctl.link.encode import UNLOCK_THRUST, encode
from perchctl.link.telemetry import NEEDED, OPTIONAL, telemetry_from
from perchctl.sim.crtp.codec import Packet
from perchctl.sim.crtp.commands import CommandService
from perchctl.sim.crtp.server import PROTOCOL_VERSION
from perchctl.vehicle import FLYING, Command, Telemetry

if TYPE_CHECKING:
    from perchctl.sim.vehicle import SimulatedVehicle

TELEMETRY_DELAY_S = 0.01
SETTLE_S = 1.0


class MockLink:
    """The simulated vehicle in lockstep; `advance_to` is the flight's clock.

    Commands reach it as bytes, through the decoder of the simulated link's server.
    """

    def __init__(self, vehicle: SimulatedVehicle, telemetry_period_s: float = 0.01) -> None:
        self.vehicle = vehicle
        self._service = CommandService(vehicle.firmware, PROTOCOL_VERSION)
        self._period_s = telemetry_period_s
        self._samples: deque[Telemetry] = deque()
        self._next_sample_s = 0.0

    @property
    def now_s(self) -> float:
        return self.vehicle.firmware.t_s

    def advance_to(self, t_s: float) -> None:
        """Step the vehicle until `t_s`, sampling its telemetry on the way."""
        while self._next_sample_s <= t_s:
            self.vehicle.advance_to(self._next_sample_s)
            self._samples.append(self._sample())
            self._next_sample_s += self._period_s
        self.vehicle.advance_to(t_s)

    def connect(self) -> None:
        self.advance_to(self.now_s + SETTLE_S)
        self._hand_over(UNLOCK_THRUST)
        self.advance_to(self.now_s + 0.1)

    def telemetry(self) -> list[Telemetry]:
        arrived = []
        while self._samples and self._samples[0].t_s <= self.now_s - TELEMETRY_DELAY_S + 1e-9:
            arrived.append(self._samples.popleft())
        return arrived

    def send(self, command: Command) -> None:
        self._hand_over(encode(command))

    def problem(self, now_s: float) -> str | None:
        return None

    def close(self) -> None:
        """As the real one: waits, bounded, until nothing flies any more."""
        end_s = self.now_s + 6.0
        while self.vehicle.firmware.supervisor_info & FLYING and self.now_s < end_s:
            self.advance_to(self.now_s + 0.1)

    def _hand_over(self, packets: Iterable[Packet]) -> None:
        for packet in packets:
            self._service.handle(packet)

    def _sample(self) -> Telemetry:
        firmware = self.vehicle.firmware
        values = {name: firmware.log_value(name) for name in (*NEEDED, *OPTIONAL)}
        return telemetry_from(values, firmware.t_s)


class ScriptedLink:
    """Plays telemetry by time and records commands: for tests of the flight loop."""

    def __init__(
        self, telemetry: Iterable[Telemetry], *, refuse: str = "", dies_at_s: float = math.inf
    ) -> None:
        self._script = deque(telemetry)
        self._refuse = refuse
        self._dies_at_s = dies_at_s
        self.now_s = 0.0
        self.sent: list[tuple[float, Command]] = []
        self.closed = False

    def advance_to(self, t_s: float) -> None:
        self.now_s = t_s

    def connect(self) -> None:
        if self._refuse:
            raise ConnectionFailed(self._refuse)

    def telemetry(self) -> list[Telemetry]:
        arrived = []
        while self._script and self._script[0].t_s <= self.now_s:
            arrived.append(self._script.popleft())
        return arrived

    def send(self, command: Command) -> None:
        self.sent.append((self.now_s, command))

    def problem(self, now_s: float) -> str | None:
        return "the script ended the link" if now_s >= self._dies_at_s else None

    def close(self) -> None:
        self.closed = True
