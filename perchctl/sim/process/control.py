"""Messages between the process that flies and the simulated vehicle's, and their settings."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from perchctl.profile import TargetConfig
from perchctl.sim.capture.settings import CaptureSettings
from perchctl.sim.crtp.server import LinkOptions
from perchctl.sim.scenario import Scenario
from perchctl.vision import CameraModel

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
    truth_file: str | None = None
    heard_file: str | None = None
    linger_s: float = LINGER_S
    time_file: Path | None = None
