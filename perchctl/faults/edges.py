"""The edges of a flight at which faults come in: its radio, its camera, and the program itself."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from perchctl.camera import FrameSource
from perchctl.faults import effects as e
from perchctl.link import MockLink, Packet, Port, Radio
from perchctl.vision import Frame

# --- The radio: what arrives, what does not, and what comes late -------------------------------


ORDERS = ("setpoint", "raw", "land", "notify", "stop", "emergency-stop")
"""The kinds of packets that a fault can name."""


def order_of(packet: Packet) -> str:
    """Return the kind of a packet, one of `ORDERS`, or the empty string."""
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
    """A radio that loses the packets that `air` loses, and more as effects begin. `cut` ends the
    uplink for good."""

    def __init__(self, air: Radio | None = None) -> None:
        self._air = air or Radio()
        self.cut = False
        self._begun: list[tuple[e.Silence | e.BlockDead | e.TelemetryDelayed, float]] = []
        self._left: dict[str, int] = {}  # packets of an order still to be lost
        self._twice: set[str] = set()
        self._receive: Callable[[Packet], None] | None = None

    def serves(self, receive: Callable[[Packet], None]) -> None:
        """Name what receives the second copy of a packet."""
        self._receive = receive

    def begin(self, effect: e.RadioEffect, now_s: float) -> None:
        """Begin an effect."""
        match effect:
            case e.PacketLost(order, count):
                self._left[order] = count
            case e.PacketTwice(order):
                self._twice.add(order)
            case e.Reboots(boots_s):
                self._begun.append((e.Silence(boots_s, up=True, down=True), now_s))
                unasked_s = boots_s + MockLink.BLOCKS_BACK_AFTER_S
                self._begun.append((e.Silence(unasked_s, up=False, down=True), now_s))
            case e.Silence() | e.BlockDead() | e.TelemetryDelayed():
                self._begun.append((effect, now_s))

    def uplink_arrives(self, packet: Packet, now_s: float) -> bool:
        if self.cut or not self._air.uplink_arrives(packet, now_s):
            return False
        order = order_of(packet)
        if self._left.get(order, 0) > 0:
            self._left[order] -= 1
            return False
        for effect, begin_s in self._begun:
            if isinstance(effect, e.Silence) and effect.up and now_s < begin_s + effect.for_s:
                return False
        if order in self._twice and self._receive is not None:
            self._twice.remove(order)
            self._receive(packet)
        return True

    def downlink_delay_s(self, block: str, now_s: float) -> float | None:
        delay_s = self._air.downlink_delay_s(block, now_s)
        if delay_s is None:
            return None
        for effect, begin_s in self._begun:
            if now_s >= begin_s + effect.for_s:
                continue
            if isinstance(effect, e.Silence) and effect.down:
                return None
            if isinstance(effect, e.BlockDead) and effect.block == block:
                return None
            if isinstance(effect, e.TelemetryDelayed):
                delay_s = max(delay_s, effect.delay_s)
        return delay_s


# --- The camera --------------------------------------------------------------------------------


SNOW_STREAM = 512
SNOW_SIGMA = 60.0
DARK_GAIN = 0.06
SHEET_SIGMA = 6.0
"""The camera's own noise."""
LOST = 0.2


class FaultyCamera:
    """A frame source that passes on the simulated camera's frames, spoilt while a fault lasts."""

    finished = False

    def __init__(self, inner: FrameSource, seed: int) -> None:
        self._inner = inner
        self._rng = np.random.default_rng([seed, SNOW_STREAM])
        self._fault: e.CameraFault | None = None
        self._begin_s = 0.0
        self._last: Frame | None = None
        self._queue: deque[Frame] = deque()
        self._overtaken: Frame | None = None
        self.late_s = 0.0  # until a fault begins, and known to the profile

    def begin(self, fault: e.CameraFault, now_s: float) -> None:
        self._fault, self._begin_s = fault, now_s
        self.late_s = 0.0
        self._queue.clear()

    @property
    def live(self) -> bool:
        return self._inner.live

    @property
    def size_px(self) -> tuple[int, int] | None:
        return self._inner.size_px

    def poll(self, now_s: float) -> Frame | None:
        frame = self._inner.poll(now_s)
        if self.late_s:
            frame = self._late(frame, self.late_s, now_s)
        fault = self._fault
        if fault is None or not self._begin_s <= now_s < self._begin_s + fault.for_s:
            self._last = frame or self._last
            return frame
        return self._spoilt(fault, frame, now_s)

    def problem(self, now_s: float) -> str | None:
        return self._inner.problem(now_s)

    def describe(self) -> str:
        return self._inner.describe()

    def close(self) -> None:
        self._inner.close()

    def _spoilt(self, fault: e.CameraFault, frame: Frame | None, now_s: float) -> Frame | None:
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
                image = self._noise(frame.image, 120.0, SNOW_SIGMA)
            case "covered":  # by a sheet of the ceiling's grey, under the target
                image = self._noise(frame.image, float(frame.image.mean()), SHEET_SIGMA)
            case "dark":
                image = np.asarray(cv2.convertScaleAbs(frame.image, alpha=DARK_GAIN), np.uint8)
            case "mirrored":
                image = np.ascontiguousarray(frame.image[:, ::-1])
            case _:
                return frame
        return replace(frame, image=image, encoded=None)

    def _noise(self, image: np.ndarray, mean: float, sigma: float) -> np.ndarray:
        return np.clip(self._rng.normal(mean, sigma, image.shape), 0, 255).astype(np.uint8)

    def _late(self, frame: Frame | None, late_s: float, now_s: float) -> Frame | None:
        """Return the frame that was queued for so long; its times look as if it were new."""
        if frame is not None:
            self._queue.append(frame)
        old = None
        while self._queue and self._queue[0].t_arrival_s + late_s <= now_s:
            old = self._queue.popleft()
        if old is None:
            return None
        return replace(old, t_s=old.t_s + late_s, t_arrival_s=old.t_arrival_s + late_s)

    def _swapped(self, frame: Frame | None) -> Frame | None:
        """Return the frames in pairs, the newer one of each first."""
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


# --- The program: simulated time passes while its loop does not run ----------------------------


LONGEST_S = 60.0
"""The user kills a hung program after this time."""


class ProgramKilled(BaseException):
    """Ends the program under test; its `except Exception` clauses do not catch it."""


class PlantedError(Exception):
    """The exception that a fault raises in the loop: unforeseen by the program, planned by the
    campaign."""


class FaultyClock:
    """The flight's clock in simulated time. Effects on the program happen where the loop waits
    for its next tick. A killed program sends nothing more through `radio`. A flight that takes
    longer than `stop_s` is ended."""

    def __init__(self, link: MockLink, radio: FaultyRadio, stop_s: float) -> None:
        self._link, self._radio, self._stop_s = link, radio, stop_s
        self._pending: e.ProgramEffect | None = None
        self._slow: e.Slow | None = None
        self._slow_until_s = 0.0
        self._gone = False
        self.endless = False
        self.killed_s: float | None = None

    def begin(self, effect: e.ProgramEffect, now_s: float) -> None:
        """Begin an effect: where the loop waits next, or with its next ticks."""
        if isinstance(effect, e.Slow):
            self._slow, self._slow_until_s = effect, now_s + effect.for_s
        else:
            self._pending = effect

    def now(self) -> float:
        if self._gone:
            raise ProgramKilled  # it rescues nothing any more, and says nothing
        return self._link.now_s

    def wait_until(self, t_s: float) -> None:
        now_s = self._link.now_s
        if self._slow is not None and now_s < self._slow_until_s:
            t_s = max(t_s, now_s + self._slow.turn_s)
        if t_s > now_s and not self._gone:
            self._link.advance_to(t_s)
        effect, self._pending = self._pending, None
        match effect:
            case e.Killed():
                self._kill()
            case e.Suspended(for_s):
                # Past the link: none of the program's threads runs.
                self._link.vehicle.advance_to(self._link.now_s + for_s)
            case e.Hung(for_s):
                self._link.advance_to(self._link.now_s + min(for_s, LONGEST_S))
                if for_s >= e.FOR_EVER:
                    self._kill()
            case e.Raises():
                raise PlantedError("an exception that the fault raised")
        if self._link.now_s > self._stop_s:
            self.endless = True
            self._kill()
        if self._gone:
            raise ProgramKilled

    def _kill(self) -> None:
        if not self._gone:
            self._gone = True
            self.killed_s = self._link.now_s
            self._radio.cut = True
