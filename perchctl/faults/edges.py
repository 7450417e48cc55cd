"""The parts of a simulated flight that faults act on: its radio, its camera and the program itself.

`FaultRig` combines them; the functions in `perchctl.faults.effects` act on it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import cv2
import numpy as np

from perchctl.camera import FrameSource, WrappedSource
from perchctl.link import MockLink, Packet, Port, Radio
from perchctl.sim import SimulatedVehicle
from perchctl.vision import Frame

# --- The radio: lost and delayed packets ---


def packet_kind(packet: Packet) -> str:
    """The kind of a command packet, such as "land" or "stop"; "" for any other packet."""
    kind = packet.data[0] if packet.data else None
    match packet.port, packet.channel, kind:
        case Port.COMMANDER, 0, _:
            return "raw"
        case Port.COMMANDER_GENERIC, 0, 0:
            return "stop"
        case Port.COMMANDER_GENERIC, 0, _:
            return "setpoint"
        case Port.COMMANDER_GENERIC, 1, 0:
            return "notify"
        case Port.HIGH_LEVEL, 0, 8:
            return "land"
        case Port.SUPERVISOR, 1, 3:
            return "emergency-stop"
    return ""


class FaultyRadio(Radio):
    """A radio that loses all packets that the radio `air` loses, and also those that a fault
    selects."""

    def __init__(self, air: Radio | None = None) -> None:
        self._air = air or Radio()
        self._losses: list[tuple[float, bool, str, float]] = []
        self.cut = False
        self.lost: dict[str, int] = {}
        self.twice: set[str] = set()
        self.receive: Callable[[Packet], None] | None = None

    def lose(self, end_s: float, uplink: bool, block: str, delay_s: float = math.inf) -> None:
        """Until `end_s`, lose all commands if `uplink` is True, and all packets of the log block
        `block` ("all": of every block). A finite `delay_s` delays the log packets instead."""
        self._losses.append((end_s, uplink, block, delay_s))

    def uplink_arrives(self, packet: Packet, now_s: float) -> bool:
        if self.cut or not self._air.uplink_arrives(packet, now_s):
            return False
        order = packet_kind(packet)
        if self.lost.get(order, 0) > 0:
            self.lost[order] -= 1
            return False
        if any(up and now_s < end_s for end_s, up, _, _ in self._losses):
            return False
        if order in self.twice and self.receive is not None:
            self.twice.remove(order)
            self.receive(packet)
        return True

    def downlink_delay_s(self, block: str, now_s: float) -> float | None:
        delay_s = self._air.downlink_delay_s(block, now_s)
        if delay_s is None:
            return None
        for end_s, _, down, late_s in self._losses:
            if now_s < end_s and down in ("all", block):
                delay_s = max(delay_s, late_s)
        return None if math.isinf(delay_s) else delay_s


# --- The camera ---


SNOW_STREAM = 512
INJECTED_SNOW_SIGMA = 60.0
DARK_GAIN = 0.06
SHEET_SIGMA = 6.0
"""Standard deviation of the noise, in grey levels, while a sheet covers the target: the camera's
own noise."""
LOST = 0.2


@dataclass(frozen=True)
class CameraFault:
    """A camera fault that lasts for `for_s`. `kind`: silent, frozen, snow, dark, covered, lossy,
    out-of-order, mirrored, late (by `late_s`), or sooner (than the profile expects, by
    `late_s`)."""

    kind: str
    for_s: float
    late_s: float = 0.0


class FaultyCamera(WrappedSource):
    """A frame source that returns the simulated camera's frames, corrupted while there is a
    fault."""

    def __init__(self, inner: FrameSource, seed: int) -> None:
        super().__init__(inner)
        self._rng = np.random.default_rng([seed, SNOW_STREAM])
        self._fault: CameraFault | None = None
        self._begin_s = 0.0
        self._last: Frame | None = None
        self._queue: deque[Frame] = deque()
        self._overtaken: Frame | None = None
        self.late_s = 0.0  # delay before a fault begins, included in the profile's latency

    def begin_fault(self, fault: CameraFault, now_s: float) -> None:
        self._fault, self._begin_s = fault, now_s
        self.late_s = 0.0
        self._queue.clear()

    def poll(self, now_s: float) -> Frame | None:
        frame = super().poll(now_s)
        if self.late_s:
            frame = self._late(frame, self.late_s, now_s)
        fault = self._fault
        if fault is None or not self._begin_s <= now_s < self._begin_s + fault.for_s:
            self._last = frame or self._last
            return frame
        return self._spoilt(fault, frame, now_s)

    def _spoilt(self, fault: CameraFault, frame: Frame | None, now_s: float) -> Frame | None:
        if fault.kind == "late":
            return self._late(frame, fault.late_s, now_s)
        if fault.kind == "out-of-order":
            return self._swapped(frame)
        if frame is None or fault.kind == "silent":
            return None
        if fault.kind == "lossy" and self._rng.random() < LOST:
            return None
        match fault.kind:
            case "frozen":
                image = (self._last or frame).image
            case "snow":
                image = self._noise(frame.image, 120.0, INJECTED_SNOW_SIGMA)
            case "covered":  # a sheet as grey as the ceiling hides the target
                image = self._noise(frame.image, float(frame.image.mean()), SHEET_SIGMA)
            case "dark":
                image = np.asarray(cv2.convertScaleAbs(frame.image, alpha=DARK_GAIN), np.uint8)
            case "mirrored":
                image = np.ascontiguousarray(frame.image[:, ::-1])
            case _:
                return frame
        return replace(frame, image=image, source_jpeg=None)

    def _noise(self, image: np.ndarray, mean: float, sigma: float) -> np.ndarray:
        return np.clip(self._rng.normal(mean, sigma, image.shape), 0, 255).astype(np.uint8)

    def _late(self, frame: Frame | None, late_s: float, now_s: float) -> Frame | None:
        if frame is not None:
            self._queue.append(frame)
        old = None
        while self._queue and self._queue[0].t_arrival_s + late_s <= now_s:
            old = self._queue.popleft()
        if old is None:
            return None
        return replace(old, t_s=old.t_s + late_s, t_arrival_s=old.t_arrival_s + late_s)

    def _swapped(self, frame: Frame | None) -> Frame | None:
        """Return the frames in pairs, with the newer frame of each pair first."""
        if self._overtaken is not None:
            older, self._overtaken = self._overtaken, None
            if frame is not None:
                self._queue.append(frame)
            return older
        if frame is None:
            return None
        if not self._queue:
            self._queue.append(frame)
            return None
        self._overtaken = self._queue.popleft()
        return frame


# --- The program: let simulated time pass while its loop does not run ---


USER_PATIENCE_S = 60.0
"""Time after which the user kills a program that does not respond, s."""


class ProgramKilled(BaseException):
    """Ends the program under test. This class is not derived from Exception, so the program's
    `except Exception` clauses do not catch it."""


class PlantedError(Exception):
    """The unforeseen exception that a fault raises in the loop."""


class FaultyClock:
    """The flight's simulated clock. Faults in the program take effect whenever the loop waits. A
    killed program sends nothing through `radio`. A flight that takes longer than `stop_s` is ended.

    Attributes:
        pending: function to call once, the next time the loop waits.
        tick_s, slow_until_s: until `slow_until_s`, each tick takes at least `tick_s`.
        killed_s: time at which the program was killed, or None; endless: it was killed because of
            `stop_s`.
    """

    def __init__(self, link: MockLink, radio: FaultyRadio, stop_s: float) -> None:
        self._link, self._radio, self._stop_s = link, radio, stop_s
        self.pending: Callable[[], None] | None = None
        self.tick_s = self.slow_until_s = 0.0
        self.killed_s: float | None = None
        self.endless = False

    def now(self) -> float:
        if self.killed_s is not None:
            raise ProgramKilled  # a killed program cannot rescue the vehicle or report
        return self._link.now_s

    def wait_until(self, t_s: float) -> None:
        now_s = self._link.now_s
        if now_s < self.slow_until_s:
            t_s = max(t_s, now_s + self.tick_s)
        if t_s > now_s and self.killed_s is None:
            self._link.advance_to(t_s)
        act, self.pending = self.pending, None
        if act is not None:
            act()
        if self._link.now_s > self._stop_s:
            self.endless = True
            self.kill()
        if self.killed_s is not None:
            raise ProgramKilled

    def kill(self) -> None:
        if self.killed_s is None:
            self.killed_s = self._link.now_s
            self._radio.cut = True

    def suspend(self, for_s: float) -> None:
        """Let `for_s` pass while all threads of the program are suspended."""
        self._link.vehicle.advance_to(self._link.now_s + for_s)

    def hang(self, for_s: float) -> None:
        """Let `for_s` pass while the loop's thread is stuck; the link's threads keep running."""
        self._link.advance_to(self._link.now_s + min(for_s, USER_PATIENCE_S))
        if for_s > USER_PATIENCE_S:
            self.kill()


# --- All parts together ---


@dataclass
class FaultRig:
    """The parts of a flight that faults act on. `press` acts like the operator's Ctrl-C, and
    `hang_up` like closing the terminal. `disk.problem` is the error that the log's disk reports.
    The deck provides no positions while `deck_silent` is set. Each function in `on_sample` is
    called with the time, every `SAMPLE_S`."""

    vehicle: SimulatedVehicle
    radio: FaultyRadio
    camera: FaultyCamera
    clock: FaultyClock
    press: Callable[[], None]
    hang_up: Callable[[], None]
    disk: Any
    deck_silent: bool = False
    on_sample: list[Callable[[float], None]] = field(default_factory=list)
    _later: list[tuple[float, Callable[[], None]]] = field(default_factory=list)

    def call_at(self, t_s: float, act: Callable[[], None]) -> None:
        """Call `act` at the simulated time `t_s`."""
        self._later.append((t_s, act))
        self._later.sort(key=lambda entry: entry[0])

    def set_until(self, end_s: float, owner: Any, name: str, value: Any, later: Any) -> None:
        """Set the attribute `name` of `owner` to `value` now, and to `later` at the time
        `end_s`."""
        setattr(owner, name, value)
        self.call_at(end_s, partial(setattr, owner, name, later))

    def call_due(self, t_s: float) -> None:
        """Call each function passed to `call_at` that is due by `t_s`, and each function in
        `on_sample`."""
        while self._later and self._later[0][0] <= t_s:
            self._later.pop(0)[1]()
        for act in self.on_sample:
            act(t_s)
