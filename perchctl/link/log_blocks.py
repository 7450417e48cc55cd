"""Telemetry by cflib's log blocks: started, collected by cflib's thread, and started again after
a silence in which the vehicle has forgotten them."""

from __future__ import annotations

import struct
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

from perchctl.errors import NotFound, TimedOut
from perchctl.link.assemble import BLOCKS, FAST_BLOCKS, SLOW_PERIOD_S, Assembler
from perchctl.link.crtp import Packet, Port
from perchctl.link.timebase import Timebase
from perchctl.vehicle import Telemetry

FIRST_SAMPLE_TIMEOUT_S = 3.0
AWAIT_SLOW_S = 1.0
"""The first sample waits that long for the slow blocks."""
BLOCKS_DELETED_AFTER_S = 1.0
"""A vehicle that hears no radio for so long deletes its log blocks (docs/firmware.md, "Radio
silence")."""
RESUME_PERIOD_S = 0.25
"""Longer than the slowest block's period: one that was started shows by then."""
MOST_SAMPLES = 2000
_SETTINGS, _CREATE, _START = 1, 6, 3  # channel of the log port, and commands
_PREFIX = "perch_"


class LogBlocks:
    """Samples on the loop's clock.

    The callbacks run in cflib's thread; they take the values and return. `newest` is the
    last sample, None before the first; `last_arrival_s` is when data last came.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._timebase = Timebase()
        self._assembler = Assembler()
        self._samples: deque[Telemetry] = deque(maxlen=MOST_SAMPLES)
        self._first_sample = threading.Event()
        self._awaited: set[str] = set()  # slow blocks without data so far
        self._started_s = 0.0
        self._starting: dict[str, list[Packet]] = {}  # what starts each block
        self._arrived_s: dict[str, float] = {}  # of each block
        self._resuming: deque[Packet] = deque()  # what has still to go out
        self._resumed_s = 0.0
        self.last_arrival_s = 0.0
        self.newest: Telemetry | None = None

    def start(self, log: Any, uri: str, period_s: float) -> None:
        """Start the blocks in cflib's `log` and wait for the first sample.

        Raises NotFound for a refused block, TimedOut.
        """
        self._started_s = self._clock()
        for name, variables in BLOCKS.items():
            if name in FAST_BLOCKS:
                block = start_block(log, uri, name, variables, period_s, self._on_data)
            elif all(log.toc.get_element_by_complete_name(n) is not None for n in variables):
                self._awaited.add(name)
                block = start_block(log, uri, name, variables, SLOW_PERIOD_S, self._on_data)
            else:
                continue
            self._starting[name] = _starting(log, block)
        if not self._first_sample.wait(FIRST_SAMPLE_TIMEOUT_S):
            missing = self._assembler.missing()
            raise TimedOut(
                f"{uri} is connected but sends no telemetry "
                f"(missing: {', '.join(missing) or 'none'})"
            )

    def take(self) -> list[Telemetry]:
        """Samples that arrived since the last call, oldest first."""
        arrived = []
        while self._samples:
            arrived.append(self._samples.popleft())
        return arrived

    @property
    def waiting(self) -> list[Telemetry]:
        """Samples that the next `take` gives, from any thread."""
        return list(self._samples.copy())

    def resume(self, send: Callable[[Packet], bool]) -> bool:
        """Start the blocks again that come no more: one packet, whether it went out.

        To be called whenever there is room for one, from one thread. `send` must not wait. A
        vehicle that still has a block answers that it exists, and starts it again all the same.
        """
        now_s = self._clock()
        if not self._resuming and now_s - self._resumed_s > RESUME_PERIOD_S:
            for name, packets in self._starting.items():
                if now_s - self._arrived_s.get(name, self._started_s) > BLOCKS_DELETED_AFTER_S:
                    self._resuming.extend(packets)
        if not self._resuming or not send(self._resuming[0]):
            return False
        self._resuming.popleft()
        self._resumed_s = now_s
        return True

    def _on_data(self, stamp: int, data: dict[str, float], block: Any) -> None:
        now_s = self._clock()
        self.last_arrival_s = now_s
        name = block.name.removeprefix(_PREFIX)
        self._awaited.discard(name)
        self._arrived_s[name] = now_s
        sent_s = self._timebase.to_loop_s(stamp, now_s)
        sample = self._assembler.accept(name, data, sent_s, self._timebase.start)
        if sample is None or (self._awaited and now_s < self._started_s + AWAIT_SLOW_S):
            return  # the first sample is to contain the battery too
        self.newest = sample
        self._samples.append(sample)
        self._first_sample.set()


def start_block(
    log: Any,
    uri: str,
    name: str,
    variables: dict[str, str],
    period_s: float,
    on_data: Callable[[int, dict[str, float], Any], None],
) -> Any:
    """Start a block in cflib's `log` and return it. `period_s` is rounded to 10 ms; `on_data` gets
    the stamp in ms, the values by name and the block. Raises NotFound for a refused one."""
    from cflib.crazyflie.log import LogConfig

    period_ms = max(10, 10 * round(period_s * 100))
    block = LogConfig(name=_PREFIX + name, period_in_ms=period_ms)
    for variable, ctype in variables.items():
        block.add_variable(variable, ctype)
    try:
        log.add_config(block)
    except (KeyError, AttributeError) as error:
        raise NotFound(f"log block {name} is refused by {uri}: {error}") from None
    block.data_received_cb.add_callback(on_data)
    block.start()
    return block


def _starting(log: Any, block: Any) -> list[Packet]:
    """The packets by which cflib has a new block created and started (docs/firmware.md, "Log
    blocks"): one each, since none of perchctl's has more than nine variables."""
    variables = b"".join(
        struct.pack(
            "<BH", variable.get_storage_and_fetch_byte(), log.toc.get_element_id(variable.name)
        )
        for variable in block.variables
    )
    return [
        Packet(Port.LOG, _SETTINGS, bytes((_CREATE, block.id)) + variables),
        Packet(Port.LOG, _SETTINGS, bytes((_START, block.id, block.period))),
    ]
