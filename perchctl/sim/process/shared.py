"""Simulated time, shared by the simulated vehicle's process and the flight's."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from perchctl.profile import TargetConfig
from perchctl.sim.capture import CaptureSettings
from perchctl.sim.crtp.server import LinkOptions
from perchctl.sim.scenario import Scenario
from perchctl.vision import CameraModel

CLOCK_MARGIN_S = 0.02
"""Simulated time may run so far past the moment that the flight loop waits for."""
LOOP_PATIENCE_S = 2.0
"""The simulator waits so long, on the wall's clock, for a loop that gives no sign of life."""


class SharedTime:
    """Two numbers in a file that both processes map.

    `reached_s` is how far simulated time has come; the simulator writes it. `limit_s` is how far
    it may go; the flight writes it, and infinity lets time run freely. Without a file they belong
    to one process.
    """

    def __init__(self, file: Path | None = None) -> None:
        if file is None:
            self._values = np.array([0.0, math.inf])
        else:
            self._values = np.memmap(file, np.float64, "r+")

    @classmethod
    def create(cls, file: Path) -> SharedTime:
        np.array([0.0, math.inf]).tofile(file)
        return cls(file)

    @property
    def reached_s(self) -> float:
        return float(self._values[0])

    @reached_s.setter
    def reached_s(self, t_s: float) -> None:
        self._values[0] = t_s

    @property
    def limit_s(self) -> float:
        return float(self._values[1])

    @limit_s.setter
    def limit_s(self, t_s: float) -> None:
        self._values[1] = t_s


# --- Messages between the process that flies and the simulated vehicle's, and their settings ---


Pace = Literal["realtime", "stepped"]
START_TIMEOUT_S = 30.0
LINGER_S = 12.0


@dataclass(frozen=True)
class HostSetup:
    """How the simulated vehicle's process is set up.

    `camera` None: no camera and no stream; `capture` None: no motion capture. Ports 0: chosen
    by the operating system.
    `truth_file`: JSON lines of the true state, 50 a simulated second, also after the
    parent has ended. `heard_file`: JSON lines of every packet that arrived, and who had sent it.
    `linger_s`: how long the vehicle then runs on, in wall-clock time. `time_file`: a
    `SharedTime` of the parent's; None: time runs freely.
    """

    scenario: Scenario = field(default_factory=Scenario)
    pace: Pace = "realtime"
    camera: CameraModel | None = None
    target: TargetConfig | None = None
    capture: CaptureSettings | None = None
    link: LinkOptions = field(default_factory=LinkOptions)
    port: int = 0
    http_port: int = 0
    capture_port: int = 0
    truth_file: Path | None = None
    heard_file: Path | None = None
    linger_s: float = LINGER_S
    time_file: Path | None = None
