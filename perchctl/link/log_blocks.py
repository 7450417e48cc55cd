"""Telemetry by cflib's log blocks: started once, then collected by cflib's thread."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any

from perchctl.errors import NotFound, TimedOut
from perchctl.link.telemetry import (
    ATTITUDE_BLOCK,
    BATTERY_BLOCK,
    NEEDED,
    STATE_BLOCK,
    VARIANCE_BLOCK,
    telemetry_from,
)
from perchctl.link.timebase import Timebase
from perchctl.vehicle import Telemetry

FIRST_SAMPLE_TIMEOUT_S = 3.0
SLOW_PERIOD_MS = 100
AWAIT_SLOW_S = 1.0
"""The first sample waits that long for the slow blocks."""
MOST_CARRIED_S = 0.05
MOST_SAMPLES = 2000


class LogBlocks:
    """Samples on the loop's clock.

    The callbacks run in cflib's thread; they take the values and return. `newest` is the
    last sample, None before the first; `last_arrival_s` is when data last came.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._timebase = Timebase()
        self._values: dict[str, float] = {}
        self._state_s: float | None = None
        self._samples: deque[Telemetry] = deque(maxlen=MOST_SAMPLES)
        self._first_sample = threading.Event()
        self._awaited: set[str] = set()  # slow blocks without data so far
        self._started_s = 0.0
        self.last_arrival_s = 0.0
        self.newest: Telemetry | None = None

    def start(self, log: Any, uri: str, period_s: float) -> None:
        """Start the blocks in cflib's `log` and wait for the first sample.

        `period_s` is rounded to 10 ms. Raises NotFound for a refused block, TimedOut.
        """
        self._started_s = self._clock()
        fast_ms = max(10, 10 * round(period_s * 100))
        _start_block(log, uri, "state", STATE_BLOCK, fast_ms, self._on_state)
        _start_block(log, uri, "attitude", ATTITUDE_BLOCK, fast_ms, self._on_attitude)
        for name, variables in (("battery", BATTERY_BLOCK), ("variance", VARIANCE_BLOCK)):
            if all(log.toc.get_element_by_complete_name(n) is not None for n in variables):
                self._awaited.add(f"perch_{name}")
                _start_block(log, uri, name, variables, SLOW_PERIOD_MS, self._on_values)
        if not self._first_sample.wait(FIRST_SAMPLE_TIMEOUT_S):
            missing = [n for n in NEEDED if n not in self._values]
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

    def _on_values(self, _stamp: int, data: dict[str, float], block: Any) -> None:
        self.last_arrival_s = self._clock()
        self._values.update(data)
        self._awaited.discard(block.name)

    def _on_state(self, stamp: int, data: dict[str, float], _block: Any) -> None:
        now_s = self._clock()
        self.last_arrival_s = now_s
        self._values.update(data)
        self._state_s = self._timebase.to_loop_s(stamp, now_s)

    def _on_attitude(self, stamp: int, data: dict[str, float], _block: Any) -> None:
        now_s = self._clock()
        self.last_arrival_s = now_s
        self._values.update(data)
        t_s = self._timebase.to_loop_s(stamp, now_s)
        if self._state_s is None or any(name not in self._values for name in NEEDED):
            return
        if self._awaited and now_s < self._started_s + AWAIT_SLOW_S:
            return  # the first sample is to contain the battery too
        sample = telemetry_from(_carried(self._values, t_s - self._state_s), t_s)
        self.newest = sample
        self._samples.append(sample)
        self._first_sample.set()


def _start_block(
    log: Any,
    uri: str,
    name: str,
    variables: dict[str, str],
    period_ms: int,
    on_data: Callable[[int, dict[str, float], Any], None],
) -> None:
    from cflib.crazyflie.log import LogConfig

    block = LogConfig(name=f"perch_{name}", period_in_ms=period_ms)
    for variable, ctype in variables.items():
        block.add_variable(variable, ctype)
    try:
        log.add_config(block)
    except (KeyError, AttributeError) as error:
        raise NotFound(f"log block {name} is refused by {uri}: {error}") from None
    block.data_received_cb.add_callback(on_data)
    block.start()


def _carried(values: dict[str, float], ahead_s: float) -> dict[str, float]:
    """The position block carried on to the attitude block's time by its velocity."""
    carried = dict(values)
    step_s = max(-MOST_CARRIED_S, min(MOST_CARRIED_S, ahead_s))
    for axis in "xyz":
        carried[f"stateEstimate.{axis}"] += values[f"stateEstimate.v{axis}"] * step_s
    return carried
