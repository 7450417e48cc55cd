"""The lockstep sibling of the cflib link: same protocol, same packets, no wall clock.

`MockLink` flies a `SimulatedVehicle`; `ScriptedLink` plays back a list of
telemetry and records the commands.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections import deque
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from perchctl.errors import ConnectionFailed
from perchctl.link.assemble import BLOCKS, FAST_BLOCKS, SLOW_PERIOD_S, Assembler
from perchctl.link.encode import (
    UNLOCK_PERIOD_S,
    UNLOCK_THRUST,
    UNLOCK_TIMES,
    encode,
    encode_external,
)
from perchctl.link.protocol import Guard, SentCallback, ignore_sent
from perchctl.link.variables import EXTERNAL_POSITION_TICK, LISTEN_S, decks_found
from perchctl.mission import SentCommand
from perchctl.sim import PROTOCOL_VERSION, CommandService, Packet
from perchctl.values import replace
from perchctl.vehicle import FLYING, Command, ExternalPosition, MeasuredBy, Telemetry

if TYPE_CHECKING:
    from perchctl.sim import SimulatedVehicle
from perchctl.sim import Bursts, Scenario, radio_bursts

TELEMETRY_DELAY_S = 0.01
SETTLE_S = 1.0
WATCH_PERIOD_S = 0.05


class Radio:
    """What becomes of the packets of both directions; this one loses none."""

    def up(self, packet: Packet, now_s: float) -> bool:
        """Whether it arrives at the vehicle."""
        return True

    def down(self, block: str, now_s: float) -> float | None:
        """After how many seconds a log block's packet arrives; None when it is lost."""
        return TELEMETRY_DELAY_S


class MockLink:
    """The simulated vehicle in lockstep; `advance_to` is the flight's clock.

    Commands reach it as bytes, through the decoder of the simulated link's server, and its
    telemetry comes in the same log blocks, through the same assembler, as by radio.
    """

    def __init__(
        self,
        vehicle: SimulatedVehicle,
        telemetry_period_s: float = 0.01,
        radio: Radio | None = None,
    ) -> None:
        self.vehicle = vehicle
        self.radio = radio or Radio()
        self._service = CommandService(vehicle.firmware, PROTOCOL_VERSION)
        self._assembler = Assembler()
        self._periods_s = {
            name: telemetry_period_s if name in FAST_BLOCKS else SLOW_PERIOD_S for name in BLOCKS
        }
        self._due_s = dict.fromkeys(BLOCKS, 0.0)
        self._under_way: list[tuple[float, int, str, float, dict[str, float], int]] = []
        self._start, self._stamp_s = 0, 0.0
        self._count = itertools.count()
        self._arrived: list[Telemetry] = []
        self._newest: Telemetry | None = None
        self._guard: Guard | None = None
        self._told: SentCallback = ignore_sent
        self._watched_s = -math.inf
        self._turn: Callable[[float], object] = lambda now_s: None
        self._turn_due_s = self._turn_period_s = math.inf

    @property
    def now_s(self) -> float:
        return self.vehicle.t_s

    def advance_to(self, t_s: float) -> None:
        """Step the vehicle until `t_s`, sending its telemetry on the way."""
        while (due_s := min(self._turn_due_s, *self._due_s.values())) <= t_s:
            self.vehicle.advance_to(due_s)
            for name, block_due_s in self._due_s.items():
                if block_due_s <= due_s + 1e-9:
                    self._send_down(name)
                    self._due_s[name] = block_due_s + self._periods_s[name]
            self._ask_guard()
            if self._turn_due_s <= due_s + 1e-9:
                self._turn_due_s += self._turn_period_s
                self._turn(self.now_s)
        self.vehicle.advance_to(t_s)

    def each(self, period_s: float, turn: Callable[[float], object]) -> None:
        """Calls `turn` with the time every `period_s` from now on: a thread's stand-in."""
        self._turn, self._turn_period_s, self._turn_due_s = turn, period_s, self.now_s

    def connect(self) -> None:
        self.advance_to(self.now_s + SETTLE_S)
        for _ in range(UNLOCK_TIMES):
            self._hand_over(UNLOCK_THRUST)
            self.advance_to(self.now_s + UNLOCK_PERIOD_S)

    def measured_by(self) -> MeasuredBy:
        firmware = self.vehicle.firmware
        told = {n: firmware.get_parameter(n) for n in firmware.PARAMETERS if n.startswith("deck.")}
        by = MeasuredBy(decks_found(told))
        if by.position_decks:
            return by
        before = firmware.log_value(EXTERNAL_POSITION_TICK)
        self.advance_to(self.now_s + LISTEN_S)
        return replace(by, external=firmware.log_value(EXTERNAL_POSITION_TICK) != before)

    def telemetry(self) -> list[Telemetry]:
        self._collect()
        samples, self._arrived = self._arrived, []
        return samples

    def guard(self, guard: Guard, told: SentCallback = ignore_sent) -> None:
        self._guard, self._told = guard, told

    def _ask_guard(self) -> None:
        if self._guard is None or self.now_s < self._watched_s + WATCH_PERIOD_S - 1e-9:
            return
        self._watched_s = self.now_s
        self._collect()
        command = self._guard.poll(self.now_s, self._newest, self._arrived)
        if command is not None:
            self.send(command)
            self._told(SentCommand(self.now_s, "watchdog", command))

    def _collect(self) -> None:
        while self._under_way and self._under_way[0][0] <= self.now_s + 1e-9:
            _, _, block, stamp_s, values, start = heapq.heappop(self._under_way)
            sample = self._assembler.accept(block, values, stamp_s, start)
            if sample is not None:
                self._newest = sample
                self._arrived.append(sample)

    def send(self, command: Command) -> None:
        self._hand_over(encode(command))

    def external(self, place: ExternalPosition) -> bool:
        self._hand_over((encode_external(place),))
        return True

    def problem(self, now_s: float) -> str | None:
        return None

    def close(self) -> None:
        """As the real one: waits, bounded, until nothing flies any more."""
        end_s = self.now_s + 6.0
        while self.vehicle.firmware.supervisor_info & FLYING and self.now_s < end_s:
            self.advance_to(self.now_s + 0.1)

    def _hand_over(self, packets: Iterable[Packet]) -> None:
        for packet in packets:
            if self.radio.up(packet, self.now_s):
                self._service.handle(packet)

    def _send_down(self, block: str) -> None:
        firmware = self.vehicle.firmware
        if firmware.t_s < self._stamp_s:
            self._start += 1
        self._stamp_s = firmware.t_s
        delay_s = self.radio.down(block, self.now_s)
        if delay_s is not None:
            values = firmware.log_values(BLOCKS[block])
            arrives_s, number = self.now_s + delay_s, next(self._count)
            packet = (arrives_s, number, block, self.now_s, values, self._start)
            heapq.heappush(self._under_way, packet)


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
        self.places: list[tuple[float, ExternalPosition]] = []
        self.closed = False

    def advance_to(self, t_s: float) -> None:
        self.now_s = t_s

    def connect(self) -> None:
        if self._refuse:
            raise ConnectionFailed(self._refuse)

    def measured_by(self) -> MeasuredBy:
        return MeasuredBy(("bcFlow2",))

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

    def guard(self, guard: Guard, told: SentCallback = ignore_sent) -> None:
        self.watchdog, self.told = guard, told

    def close(self) -> None:
        self.closed = True


# --- The lockstep's radio in a scenario that loses packets by bursts, both ways ----------------


class BurstyRadio(Radio):
    """Loses what is sent while a burst lasts."""

    def __init__(self, bursts: Bursts) -> None:
        self._bursts = bursts

    def up(self, packet: Packet, now_s: float) -> bool:
        return not self._bursts.lost(now_s) and super().up(packet, now_s)

    def down(self, block: str, now_s: float) -> float | None:
        return None if self._bursts.lost(now_s) else super().down(block, now_s)


def simulated_radio(scenario: Scenario) -> Radio:
    """As the scenario has it."""
    bursts = radio_bursts(scenario)
    return Radio() if bursts is None else BurstyRadio(bursts)
