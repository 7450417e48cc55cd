"""Telemetry from cflib's log blocks: the variables in each block, and the assembly of packets into
samples.

Only this module converts degrees to radians, and the Crazyflie's nose-up pitch to the right-handed
nose-down pitch (docs/firmware.md, "Signs and units").
"""

from __future__ import annotations

import math
import struct
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from perchctl.errors import NotFound, TimedOut
from perchctl.link.crtp import Packet, Port
from perchctl.vehicle import MOST_DUTY, Telemetry

STATE_BLOCK = {f"stateEstimate.{name}": "float" for name in ("x", "y", "z", "vx", "vy", "vz")}
"""Uses 24 of the 26 bytes of a log block."""

ATTITUDE_BLOCK: dict[str, str] = {
    "stateEstimate.roll": "float",
    "stateEstimate.pitch": "float",
    "stateEstimate.yaw": "float",
    "acc.x": "FP16",
    "acc.y": "FP16",
    "acc.z": "float",
    "stabilizer.thrust": "float",
    "supervisor.info": "uint16_t",
}
"""Uses all 26 bytes: half floats resolve a force of 0.1 g to 0.1 mg."""

MOTOR_DUTIES = tuple(f"motor.m{number}" for number in (1, 2, 3, 4))
"""All four duty cycles are left out of their block if the firmware lacks one of them, because the
battery is more important."""
BATTERY_BLOCK: dict[str, str] = {
    "pm.vbat": "float",
    "pm.state": "int8_t",
    **dict.fromkeys(MOTOR_DUTIES, "uint16_t"),
}
"""Uses 13 bytes. Without this block, the battery is unknown, which the flight tolerates (fault 7).
The duty cycles are in this block because the thrust also depends on the battery's voltage."""

POSITION_VARIANCES = tuple(f"kalman.var{axis}" for axis in "XYZ")
VELOCITY_VARIANCES = tuple(f"kalman.varP{axis}" for axis in "XYZ")
"""The filter's letter for the velocity in body axes is `P` (docs/firmware.md, "Variances")."""
VARIANCE_BLOCK = dict.fromkeys((*POSITION_VARIANCES, *VELOCITY_VARIANCES), "float")
"""Uses 24 bytes. Only requested if the firmware has the Kalman estimator."""

NEEDED = (*STATE_BLOCK, *ATTITUDE_BLOCK)
"""Log variables without which there is no telemetry."""


def telemetry_from_log(
    values: Mapping[str, float],
    t_s: float,
    behind_s: float = 0.0,
    start: int = 0,
    *,
    battery_behind_s: float = 0.0,
    variance_behind_s: float = 0.0,
) -> Telemetry:
    """Return telemetry from log variables, keyed by name; the other arguments are as in
    `Telemetry`. Raises KeyError if a needed value is missing."""
    x_m, y_m, z_m, vx_mps, vy_mps, vz_mps = (values[name] for name in STATE_BLOCK)
    return Telemetry(
        t_s=t_s,
        position_m=(x_m, y_m, z_m),
        velocity_mps=(vx_mps, vy_mps, vz_mps),
        roll_rad=math.radians(values["stateEstimate.roll"]),
        pitch_rad=-math.radians(values["stateEstimate.pitch"]),
        yaw_rad=math.radians(values["stateEstimate.yaw"]),
        acc_z_g=values["acc.z"],
        thrust=values["stabilizer.thrust"],
        battery_v=values.get("pm.vbat", 0.0),
        supervisor=int(values["supervisor.info"]),
        battery_state=int(values.get("pm.state", 0)),
        position_variance_m2=_largest(values, POSITION_VARIANCES),
        climb_variance_m2ps2=_largest(values, VELOCITY_VARIANCES[2:]),
        behind_s=behind_s,
        acc_x_g=values["acc.x"],
        acc_y_g=values["acc.y"],
        start=start,
        battery_behind_s=battery_behind_s,
        variance_behind_s=variance_behind_s,
        velocity_variance_m2ps2=_largest(values, VELOCITY_VARIANCES),
        height_variance_m2=_largest(values, POSITION_VARIANCES[2:]),
        motor_duty=_motor_duty(values),
    )


def _largest(values: Mapping[str, float], names: Sequence[str]) -> float | None:
    """Return the largest of these variances; NaN if one of them is NaN. Return None if one is
    missing or zero: according to the firmware's source, a running filter keeps each at 1e-6 or
    more, while a filter that has never run reports zeros."""
    found = [values.get(name, 0.0) for name in names]
    if any(variance == 0.0 for variance in found):
        return None
    return math.nan if any(map(math.isnan, found)) else max(found)


def _motor_duty(values: Mapping[str, float]) -> tuple[int, int, int, int] | None:
    """Return the duty cycles of M1..M4; None if one is missing or is not a duty cycle."""
    m1, m2, m3, m4 = (values.get(name, math.nan) for name in MOTOR_DUTIES)
    if not all(0.0 <= duty <= MOST_DUTY for duty in (m1, m2, m3, m4)):
        return None
    return round(m1), round(m2), round(m3), round(m4)


# --- Conversion of the vehicle's milliseconds to the loop's clock ---


WRAP_MS = 1 << 24
"""Period of the log time stamps, which have three bytes (docs/firmware.md, "Link")."""
CLOCK_SKEW = 1e-4
"""Largest rate difference between the two clocks: far larger than between two crystal oscillators,
far smaller than after a fault."""
REBOOTED_MS = 1000
"""Backward step of the stamps above which the vehicle must have restarted, ms; reordered packets
step back by far less."""


class Timebase:
    """Map log time stamps to the loop's clock, using the fastest delivery seen so far.

    The smallest difference between arrival and stamp belongs to the packet that was delayed least.
    The difference may grow slowly, to follow a drifting clock. After a restart of the vehicle, the
    mapping restarts at its first stamp; `start` counts the restarts.
    """

    def __init__(self) -> None:
        self.start = 0
        self._last_ms: int | None = None
        self._unwrapped_ms = 0
        self._offset_s: float | None = None
        self._last_arrival_s = 0.0

    def to_loop_s(self, stamp_ms: int, arrival_s: float) -> float:
        """Return the loop's time of a log packet with the stamp `stamp_ms` that arrived at
        `arrival_s`."""
        if self._last_ms is None:
            self._unwrapped_ms = stamp_ms
        else:
            step = (stamp_ms - self._last_ms) % WRAP_MS
            step = step - WRAP_MS if step > WRAP_MS // 2 else step
            self._unwrapped_ms += step
            if step < -REBOOTED_MS:
                self._offset_s = None
                self.start += 1
        self._last_ms = stamp_ms
        offset_s = arrival_s - self._unwrapped_ms / 1000.0
        if self._offset_s is None:
            self._offset_s = offset_s
        else:
            allowed = self._offset_s + CLOCK_SKEW * max(0.0, arrival_s - self._last_arrival_s)
            self._offset_s = min(offset_s, allowed)
        self._last_arrival_s = arrival_s
        return self._unwrapped_ms / 1000.0 + self._offset_s


# --- Assembly of samples from log packets, for the radio and the simulation ---


BLOCKS: dict[str, dict[str, str]] = {
    "battery": BATTERY_BLOCK,
    "variance": VARIANCE_BLOCK,
    "state": STATE_BLOCK,
    "attitude": ATTITUDE_BLOCK,
}
"""Log blocks in the order in which they are sent if they are due at the same time; the block that
completes a sample is last."""
FAST_BLOCKS = ("state", "attitude")
"""A sample requires these blocks; the others arrive ten times a second if the firmware has them."""
SLOW_PERIOD_S = 0.1
"""Period of the slow blocks, s."""
LOG_STEP_S = 0.01
"""Step size of a log block's period in the firmware, s."""
MOST_CARRIED_S = 0.05
"""Longest time for which a position is extrapolated, s."""


def telemetry_packets_per_s(period_s: float) -> float:
    """Number of packets per second that a vehicle sends for its telemetry if its firmware has all
    blocks. `period_s` is the period of the fast blocks (`link.telemetry_period_s`), rounded as in
    `start_block`.

    The result is 220 at 0.01 s, 120 at 0.02 s, and 70 at 0.04 s.
    """
    slow = len(BLOCKS) - len(FAST_BLOCKS)
    return len(FAST_BLOCKS) / _rounded_ms(period_s) * 1000.0 + slow / SLOW_PERIOD_S


def _rounded_ms(period_s: float) -> int:
    step_ms = round(LOG_STEP_S * 1000)
    return max(step_ms, step_ms * round(period_s / LOG_STEP_S))


class SampleAssembler:
    """Assemble telemetry samples from the newest values of all log blocks.

    Only the attitude block completes a sample; the other values are the last ones that arrived.
    Each sample says how much older the other blocks are (`Telemetry.behind_s` and similar fields),
    because frozen values look like a vehicle at rest.
    """

    def __init__(self) -> None:
        self._values: dict[str, float] = {}
        self._came_s: dict[str, float] = {}  # time of each block since the newest restart
        self._start = 0

    def accept(
        self, block: str, values: Mapping[str, float], t_s: float, start: int = 0
    ) -> Telemetry | None:
        """Process one packet of a block, and return the sample that it completes, if any.

        `t_s` is the packet's stamp on the loop's clock, and `start` is as in `Timebase`; values
        from before the newest restart are dropped.
        """
        if start < self._start:
            return None
        if start > self._start:
            self._start, self._came_s = start, {}
        self._values.update(values)
        self._came_s[block] = t_s
        if block != "attitude" or "state" not in self._came_s:
            return None
        behind_s = {name: t_s - self._came_s.get(name, -math.inf) for name in BLOCKS}
        return telemetry_from_log(
            _carried(self._values, behind_s["state"]),
            t_s,
            max(0.0, behind_s["state"]),
            start,
            battery_behind_s=max(0.0, behind_s["battery"]),
            variance_behind_s=max(0.0, behind_s["variance"]),
        )


def _carried(values: Mapping[str, float], ahead_s: float) -> dict[str, float]:
    """Return the values, with the position extrapolated to the time of the attitude block."""
    carried = dict(values)
    step_s = max(-MOST_CARRIED_S, min(MOST_CARRIED_S, ahead_s))
    for axis in "xyz":
        carried[f"stateEstimate.{axis}"] += values[f"stateEstimate.v{axis}"] * step_s
    return carried


# --- cflib's log blocks ---
# They are started, collected by cflib's thread, and restarted after a silence in which the vehicle
# has deleted them.


FIRST_SAMPLE_TIMEOUT_S = 3.0
"""Timeout for the first sample, s."""
AWAIT_SLOW_S = 1.0
"""Time for which the first sample waits for the slow blocks, s."""
BLOCKS_DELETED_AFTER_S = 1.0
"""Duration of a radio dropout after which a vehicle deletes its log blocks, s (docs/firmware.md,
"Radio silence")."""
RESUME_PERIOD_S = 0.25
"""Time between attempts to restart blocks, s; longer than the slowest block's period, so that a
restarted block is noticed before the next attempt."""
MOST_TELEMETRY_SAMPLES = 2000
"""Largest number of samples that wait to be read; older ones are dropped."""
_SETTINGS, _CREATE, _START = 1, 6, 3  # channel of the log port, and commands
_PREFIX = "perch_"


class LogBlocks:
    """cflib's log blocks as samples on the loop's clock.

    `newest` is the last sample, None before the first; `last_arrival_s` is the time of the last
    arrival of data.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._timebase = Timebase()
        self._assembler = SampleAssembler()
        self._samples: deque[Telemetry] = deque(maxlen=MOST_TELEMETRY_SAMPLES)
        self._first_sample = threading.Event()
        self._awaited: set[str] = set()  # slow blocks that have not sent data yet
        self._started_s = 0.0
        self._starting: dict[str, list[Packet]] = {}  # packets that start each block
        self._arrived_s: dict[str, float] = {}  # last arrival of each block
        self._resuming: deque[Packet] = deque()  # packets that are still to be sent
        self._resumed_s = 0.0
        self.last_arrival_s = 0.0
        self.newest: Telemetry | None = None

    def start(self, log: Any, uri: str, period_s: float) -> None:
        """Start the blocks in cflib's `log`, and wait for the first sample.

        Raises NotFound if a block cannot be added, and TimedOut.
        """
        self._started_s = self._clock()

        def is_known(variable: str) -> bool:
            return log.toc.get_element_by_complete_name(variable) is not None

        absent = () if all(map(is_known, MOTOR_DUTIES)) else MOTOR_DUTIES
        for name, described in BLOCKS.items():
            variables = {n: ctype for n, ctype in described.items() if n not in absent}
            if name in FAST_BLOCKS:
                block = start_block(log, uri, name, variables, period_s, self._on_data)
            elif all(map(is_known, variables)):
                self._awaited.add(name)
                block = start_block(log, uri, name, variables, SLOW_PERIOD_S, self._on_data)
            else:
                continue
            self._starting[name] = _starting(log, block)
        if not self._first_sample.wait(FIRST_SAMPLE_TIMEOUT_S):
            raise TimedOut(f"{uri} is connected but sends no telemetry")

    def take_samples(self) -> list[Telemetry]:
        """Return the samples that arrived since the last call, oldest first."""
        return [self._samples.popleft() for _ in range(len(self._samples))]

    @property
    def waiting_samples(self) -> list[Telemetry]:
        """Samples that the next `take_samples` will return; may be read from any thread."""
        return list(self._samples.copy())

    def resume(self, send: Callable[[Packet], bool]) -> bool:
        """Send one of the packets that restart silent blocks; return True if it was sent.

        Must be called from a single thread whenever the driver has room. `send` must not wait. A
        vehicle that still has the block reports an error but restarts the block anyway.
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
        """Process a packet; runs in cflib's thread."""
        now_s = self._clock()
        self.last_arrival_s = now_s
        name = block.name.removeprefix(_PREFIX)
        self._awaited.discard(name)
        self._arrived_s[name] = now_s
        sent_s = self._timebase.to_loop_s(stamp, now_s)
        sample = self._assembler.accept(name, data, sent_s, self._timebase.start)
        if sample is None or (self._awaited and now_s < self._started_s + AWAIT_SLOW_S):
            return  # the first sample should also contain the battery
        self.newest = sample
        self._samples.append(sample)
        self._first_sample.set()


def start_block(
    log: Any,
    uri: str,
    name: str,
    variables: Mapping[str, str | None],
    period_s: float,
    on_data: Callable[[int, dict[str, float], Any], None],
) -> Any:
    """Start a block in cflib's `log` and return it.

    `variables` maps names to types, None for the firmware's own type. `period_s` is rounded to 10
    ms. `on_data` is called with the stamp in ms, the values by name and the block. Raises NotFound
    if the block cannot be added.
    """
    from cflib.crazyflie.log import LogConfig

    block = LogConfig(name=_PREFIX + name, period_in_ms=_rounded_ms(period_s))
    for variable, ctype in variables.items():
        block.add_variable(variable, ctype)
    try:
        log.add_config(block)
    except (KeyError, AttributeError) as error:
        raise NotFound(f"log block {name} cannot be added to {uri}: {error}") from None
    block.data_received_cb.add_callback(on_data)
    block.start()
    return block


def _starting(log: Any, block: Any) -> list[Packet]:
    """Return the packets with which cflib creates and starts a new block (docs/firmware.md, "Log
    blocks"): one of each, since none of perchctl's blocks has more than nine variables."""
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
