"""How a vehicle is being moved by hand: its attitude and turn rates, read and nothing else.

Attitude and rates come in one packet, so that they are of one moment.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from perchctl.calibration import AttitudeSample
from perchctl.errors import NotFound, TimedOut
from perchctl.link.cflib_link import SILENCE_S, EstimateLink
from perchctl.link.connection import Connection
from perchctl.link.firmware import check_firmware
from perchctl.link.telemetry import FIRST_SAMPLE_TIMEOUT_S, Timebase, start_block
from perchctl.profile import LinkConfig
from perchctl.vehicle import FLYING

PERIOD_S = 0.01
TURN_BLOCK: dict[str, str] = {
    "stateEstimate.roll": "float",
    "stateEstimate.pitch": "float",
    "stateEstimate.yaw": "float",
    "gyro.x": "float",
    "gyro.y": "float",
    "gyro.z": "float",
}
"""24 of the 26 bytes that a log block holds."""
MOTORS_BLOCK: dict[str, str] = {"supervisor.info": "uint16_t"}
MOST_SAMPLES = 20_000
ATTITUDE, MOTORS = "how it is turned", "whether its motors turn"
"""What `TURN_BLOCK` and `MOTORS_BLOCK` tell, and nothing else does."""


class Motions:
    """The packets of both blocks as samples on the loop's clock; called in cflib's thread."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._timebase = Timebase()
        self._samples: deque[AttitudeSample] = deque(maxlen=MOST_SAMPLES)
        self._heard_s: dict[str, float] = {}  # when each last came
        self.both = threading.Event()
        self.motors_run = False

    def take(self) -> list[AttitudeSample]:
        """Those that arrived since the last call, oldest first."""
        taken = []
        while self._samples:
            taken.append(self._samples.popleft())
        return taken

    def on_turn(self, stamp: int, values: Mapping[str, float], _block: Any = None) -> None:
        """A packet of `TURN_BLOCK`: degrees, and the Crazyflie's nose-up pitch (docs/firmware.md,
        "Signs and units"); its gyroscope is right-handed. One with a number that is none is
        dropped: it would be in everything that is solved from the others."""
        t_s = self._timebase.to_loop_s(stamp, self._clock())
        if not all(map(math.isfinite, values.values())):
            return
        self._samples.append(
            AttitudeSample(
                t_s=t_s,
                roll_rad=math.radians(values["stateEstimate.roll"]),
                pitch_rad=-math.radians(values["stateEstimate.pitch"]),
                yaw_rad=math.radians(values["stateEstimate.yaw"]),
                gyro_radps=np.radians([values[f"gyro.{axis}"] for axis in "xyz"]),
            )
        )
        self._heard(ATTITUDE)

    def on_motors(self, stamp: int, values: Mapping[str, float], _block: Any = None) -> None:
        """A packet of `MOTORS_BLOCK`."""
        self.motors_run = bool(int(values["supervisor.info"]) & FLYING)
        self._heard(MOTORS)

    def missing(self) -> list[str]:
        """What has not come yet."""
        return [what for what in (ATTITUDE, MOTORS) if what not in self._heard_s]

    def problem(self, now_s: float) -> str | None:
        """What came, but comes no more: of each by itself, since one block goes on without the
        other, and still motors of which nothing is heard may turn."""
        for what, heard_s in self._heard_s.copy().items():
            if now_s - heard_s > SILENCE_S:
                return f"nothing heard for {now_s - heard_s:.1f} s of {what}"
        return None

    def _heard(self, what: str) -> None:
        self._heard_s[what] = self._clock()
        if not self.missing():
            self.both.set()


class MotionLink(EstimateLink):
    """An `EstimateLink` for `samples`; it commands nothing. Errors as there."""

    def __init__(self, uri: str, config: LinkConfig, clock: Callable[[], float]) -> None:
        super().__init__(uri, config, clock)
        self._motions = Motions(clock)

    @property
    def motors_run(self) -> bool:
        """By the newest packet; for 2 s after they stopped, too."""
        return self._motions.motors_run

    def samples(self) -> list[AttitudeSample]:
        """Those that arrived since the last call, oldest first, 100 a second."""
        return self._motions.take()

    def problem(self, now_s: float) -> str | None:
        if self.connection is not None and self.connection.lost is not None:
            return self.connection.lost
        return self._motions.problem(now_s)

    def _prepare(self, connection: Connection) -> None:
        check_firmware(connection.cf, self._uri)
        log, known = connection.cf.log, connection.cf.log.toc.get_element_by_complete_name
        for name in TURN_BLOCK:
            if known(name) is None:
                raise NotFound(
                    f"the firmware at {self._uri} has no log variable {name}, by which the "
                    f"mounting is measured: update the firmware"
                )
        start_block(log, self._uri, "motors", MOTORS_BLOCK, PERIOD_S, self._motions.on_motors)
        start_block(log, self._uri, "turn", TURN_BLOCK, PERIOD_S, self._motions.on_turn)
        self._motions.both.wait(FIRST_SAMPLE_TIMEOUT_S)
        if missing := self._motions.missing():
            raise TimedOut(f"{self._uri} is connected but does not send {' and '.join(missing)}")
