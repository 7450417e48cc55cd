"""The counterpart of the cflib link for lockstep flights with a simulated vehicle: same protocol,
same packets, but no wall clock."""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable, Iterable
from typing import Any

from perchctl.link.arming import disarm
from perchctl.link.crtp import (
    UNLOCK_PERIOD_S,
    UNLOCK_THRUST,
    UNLOCK_TIMES,
    Packet,
    encode,
)
from perchctl.link.external_position import (
    RESET_PARAMETER,
    estimator_parameters,
    estimator_start_parameters,
)
from perchctl.link.firmware import detected_decks
from perchctl.link.protocol import Guard, SentCallback, ignore_sent
from perchctl.link.telemetry import (
    BLOCKS,
    BLOCKS_DELETED_AFTER_S,
    FAST_BLOCKS,
    RESUME_PERIOD_S,
    SLOW_PERIOD_S,
    SampleAssembler,
)
from perchctl.mission import SentCommand
from perchctl.positioning import VehiclePose
from perchctl.profile import PositioningConfig
from perchctl.vehicle import FLYING, Arm, Command, ExternalPosition, Telemetry

TELEMETRY_DELAY_S = 0.01
"""Simulated delay of a log packet, s."""
SETTLE_S = 1.0
"""Simulated time that connecting takes, s."""
WATCH_PERIOD_S = 0.05
"""Period of the guard, s."""


class Radio:
    """A simulated radio in both directions; `bursts` decides which packets are lost (None:
    none)."""

    def __init__(self, bursts: Any = None) -> None:
        self._bursts = bursts

    def uplink_arrives(self, packet: Packet, now_s: float) -> bool:
        return self._bursts is None or not self._bursts.is_lost(now_s)

    def downlink_delay_s(self, block: str, now_s: float) -> float | None:
        """Return the delay after which a log block's packet arrives, s; None if it is lost."""
        lost = self._bursts is not None and self._bursts.is_lost(now_s)
        return None if lost else TELEMETRY_DELAY_S


class MockLink:
    """The simulated vehicle in lockstep; `advance_to` is the flight's clock.

    Commands reach `vehicle`, a `perchctl.sim.SimulatedVehicle`, as bytes through the simulated
    link's decoder. The vehicle's telemetry arrives in log blocks and passes through the same
    assembler as over the radio.
    """

    FAST_BLOCKS = FAST_BLOCKS
    """The log blocks without which there is no telemetry."""
    BLOCKS_BACK_AFTER_S = BLOCKS_DELETED_AFTER_S + RESUME_PERIOD_S
    """Time until the real link has restarted log blocks that a vehicle has deleted, s."""

    def __init__(
        self,
        vehicle: Any,
        telemetry_period_s: float = 0.01,
        radio: Radio | None = None,
    ) -> None:
        self.vehicle = vehicle
        self.radio = radio or Radio()
        self._assembler = SampleAssembler()
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
        self._on_sent: SentCallback = ignore_sent
        self._was_armed = False  # armed by a command of this session
        self._watched_s = -math.inf
        self._call: Callable[[float], object] = lambda now_s: None
        self._call_due_s = self._call_period_s = math.inf

    @property
    def now_s(self) -> float:
        """The vehicle's simulated time."""
        return float(self.vehicle.t_s)

    def advance_to(self, t_s: float) -> None:
        """Step the vehicle until `t_s`, sending its telemetry meanwhile."""
        while (due_s := min(self._call_due_s, *self._due_s.values())) <= t_s:
            self.vehicle.advance_to(due_s)
            for name, block_due_s in self._due_s.items():
                if block_due_s <= due_s + 1e-9:
                    self._send_down(name)
                    self._due_s[name] = block_due_s + self._periods_s[name]
            self._run_guard()
            if self._call_due_s <= due_s + 1e-9:
                self._call_due_s += self._call_period_s
                self._call(self.now_s)
        self.vehicle.advance_to(t_s)

    def call_every(self, period_s: float, call: Callable[[float], object]) -> None:
        """Call `call` with the current time every `period_s` from now on; this replaces a
        thread."""
        self._call, self._call_period_s, self._call_due_s = call, period_s, self.now_s

    def connect(self) -> None:
        self.advance_to(self.now_s + SETTLE_S)
        for _ in range(UNLOCK_TIMES):
            self._hand_over(UNLOCK_THRUST)
            self.advance_to(self.now_s + UNLOCK_PERIOD_S)

    def decks(self) -> tuple[str, ...]:
        firmware = self.vehicle.firmware
        names = (n for n in firmware.PARAMETERS if n.startswith("deck."))
        return detected_decks({name: firmware.get_parameter(name) for name in names})

    def telemetry(self) -> list[Telemetry]:
        self._collect()
        samples, self._arrived = self._arrived, []
        return samples

    def set_guard(self, guard: Guard, on_sent: SentCallback = ignore_sent) -> None:
        self._guard, self._on_sent, self._watched_s = guard, on_sent, -math.inf

    def _run_guard(self) -> None:
        if self._guard is None or self.now_s < self._watched_s + WATCH_PERIOD_S - 1e-9:
            return
        self._watched_s = self.now_s
        self._collect()
        command = self._guard(self.now_s, self._newest, self._arrived)
        if command is not None:
            self.send(command)
            self._on_sent(SentCommand(self.now_s, "watchdog", command))

    def _collect(self) -> Telemetry | None:
        """Process the packets that have arrived by now; return the newest sample."""
        while self._under_way and self._under_way[0][0] <= self.now_s + 1e-9:
            _, _, block, stamp_s, values, start = heapq.heappop(self._under_way)
            sample = self._assembler.accept(block, values, stamp_s, start)
            if sample is not None:
                self._newest = sample
                self._arrived.append(sample)
        return self._newest

    def send(self, command: Command) -> None:
        self._was_armed = self._was_armed or command == Arm(True)
        self._hand_over(encode(command))

    def send_external(self, place: ExternalPosition) -> bool:
        self._hand_over(encode(place))
        return True

    def settle_estimator(self, config: PositioningConfig, start: VehiclePose) -> None:
        """Configure the estimator for external positions, and start it at `start`."""
        firmware = self.vehicle.firmware
        parameters = estimator_parameters(config) | estimator_start_parameters(start)
        for name, value in (parameters | {RESET_PARAMETER: 1}).items():
            firmware.set_parameter(name, value)
        firmware.set_parameter(RESET_PARAMETER, 0)

    def problem(self, now_s: float) -> str | None:
        return None

    def close(self) -> None:
        """Wait until the vehicle is no longer flying, with a timeout, and disarm it, as the real
        link does."""
        end_s = self.now_s + 6.0
        while self.vehicle.firmware.supervisor_info & FLYING and self.now_s < end_s:
            self.advance_to(self.now_s + 0.1)
        ordered = self._was_armed
        disarm(self._collect, self._disarm, lambda: self.now_s, self._wait, was_ordered=ordered)

    def _disarm(self, order: Arm) -> None:
        self.send(order)
        self._on_sent(SentCommand(self.now_s, "farewell", order))

    def _wait(self, duration_s: float) -> None:
        self.advance_to(self.now_s + duration_s)

    def _hand_over(self, packets: Iterable[Packet]) -> None:
        for packet in packets:
            if self.radio.uplink_arrives(packet, self.now_s):
                self.vehicle.receive(packet)

    def _send_down(self, block: str) -> None:
        firmware = self.vehicle.firmware
        if firmware.t_s < self._stamp_s:
            self._start += 1
        self._stamp_s = firmware.t_s
        delay_s = self.radio.downlink_delay_s(block, self.now_s)
        if delay_s is not None:
            values = {name: firmware.log_value(name) for name in BLOCKS[block]}
            arrives_s, number = self.now_s + delay_s, next(self._count)
            packet = (arrives_s, number, block, self.now_s, values, self._start)
            heapq.heappush(self._under_way, packet)
