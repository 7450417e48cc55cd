"""How a vehicle is being moved by hand: its attitude, turn rates and place, read and nothing else.

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
from perchctl.geometry import Array
from perchctl.link.cflib_link import SILENCE_S, EstimateLink
from perchctl.link.connection import Connection
from perchctl.link.firmware import check_firmware
from perchctl.link.telemetry import FIRST_SAMPLE_TIMEOUT_S, VARIANCE_BLOCK, Timebase, start_block
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
PLACE_BLOCK: dict[str, str] = {
    "stateEstimate.x": "float",
    "stateEstimate.y": "float",
    "stateEstimate.z": "float",
    "supervisor.info": "uint16_t",
}
"""26 bytes, with `VARIANCE_BLOCK` where the Kalman estimator runs."""
MOST_SAMPLES = 20_000
MOST_CARRIED_S = 0.05
"""A place that is older is not that of the moment."""
ATTITUDE, MOTORS = "how it is turned", "whether its motors turn"
"""What `TURN_BLOCK` and `PLACE_BLOCK` tell, and nothing else does."""


class Motions:
    """The packets of both blocks as samples on the loop's clock; called in cflib's thread."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._timebase = Timebase()
        self._samples: deque[AttitudeSample] = deque(maxlen=MOST_SAMPLES)
        self._places: deque[tuple[float, Array]] = deque(maxlen=2)
        self._sigma_m: float | None = None
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
        t_s = self._to_loop_s(stamp)
        if not all(map(math.isfinite, values.values())):
            return
        self._samples.append(
            AttitudeSample(
                t_s=t_s,
                roll_rad=math.radians(values["stateEstimate.roll"]),
                pitch_rad=-math.radians(values["stateEstimate.pitch"]),
                yaw_rad=math.radians(values["stateEstimate.yaw"]),
                gyro_radps=np.radians([values[f"gyro.{axis}"] for axis in "xyz"]),
                position_m=self._place_at(t_s),
                position_sigma_m=self._sigma_m,
            )
        )
        self._heard(ATTITUDE)

    def on_place(self, stamp: int, values: Mapping[str, float], _block: Any = None) -> None:
        """A packet of `PLACE_BLOCK`. One with a number that is none has no place, but tells of
        the motors."""
        t_s = self._to_loop_s(stamp)
        place_m = np.array([values[f"stateEstimate.{axis}"] for axis in "xyz"])
        variances = [values[name] for name in VARIANCE_BLOCK if name in values]
        self._sigma_m = None
        if np.isfinite([*place_m, *variances]).all():
            self._places.append((t_s, place_m))
            self._sigma_m = math.sqrt(max(*variances, 0.0)) if variances else None
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

    def _to_loop_s(self, stamp: int) -> float:
        return self._timebase.to_loop_s(stamp, self._clock())

    def _place_at(self, t_s: float) -> Array | None:
        """The place, carried on to this time by its last step. None where nothing tells how
        good it is: it may be anything then."""
        if self._sigma_m is None or len(self._places) < 2:
            return None
        (before_s, before_m), (last_s, last_m) = self._places
        if t_s - last_s > MOST_CARRIED_S or not 0.0 < last_s - before_s <= MOST_CARRIED_S:
            return None
        return np.asarray(last_m + (last_m - before_m) * (t_s - last_s) / (last_s - before_s))


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
        place = PLACE_BLOCK | {n: t for n, t in VARIANCE_BLOCK.items() if known(n) is not None}
        start_block(log, self._uri, "place", place, PERIOD_S, self._motions.on_place)
        start_block(log, self._uri, "turn", TURN_BLOCK, PERIOD_S, self._motions.on_turn)
        self._motions.both.wait(FIRST_SAMPLE_TIMEOUT_S)
        if missing := self._motions.missing():
            raise TimedOut(f"{self._uri} is connected but does not send {' and '.join(missing)}")
