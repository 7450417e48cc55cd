"""A made-up but plausible flight for the tests of log, plot and display."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from perchctl.mission import (
    Event,
    ExternalPositionStatus,
    Observation,
    Phase,
    PlannerState,
    Tick,
    TickInputs,
    TickRecord,
)
from perchctl.profile import Profile
from perchctl.record import LogWatcher
from perchctl.record.fields import tick_record
from perchctl.record.header import make_header
from perchctl.vehicle import Command, Idle, PositionSetpoint, StopMotors, Telemetry
from perchctl.vision import CameraCalibrationErrors, MarkerPose, PipelineOutput, TargetEstimate
from perchctl.vision.types import Detection, Detections, VisibleMarkers
from tests.helpers import mission
from tests.helpers.mission import state_with

PERIOD_S = 0.02
PLAN: tuple[tuple[str, float, str], ...] = (
    ("APPROACH", 3.0, "start"),
    ("SEARCH", 0.5, "hovering in the perching area"),
    ("ESTIMATE", 0.5, "target seen"),
    ("ALIGN", 4.0, "pose is steady"),
    ("ASCEND", 6.0, "aligned in position and heading"),
    ("PERCH", 1.2, "settled at the stand-off"),
    ("COMPLETE", 3.4, "contact proven by position, acceleration and thrust"),
    ("PERCHED", 0.0, "hanging still with the motors off"),
)
GONE_S = (5.0, 5.5)
"""No detection between these times: the filter coasts."""


def header(**changes: Any) -> dict[str, Any]:
    args: dict[str, Any] = {"uri": "sim://", "source": "sim:", "seed": 7, "lockstep": True}
    return make_header(Profile(name="sim"), **(args | changes))


def telemetry(t_s: float = 0.0, z_m: float = 0.0) -> Telemetry:
    place_m, battery_v = (0.3, -0.2, z_m), 3.9 - 0.01 * t_s
    return mission.telemetry(t_s, position_m=place_m, yaw_rad=0.5, battery_v=battery_v)


def target(
    t_s: float, z_m: float, measured: bool = True, stage: VisibleMarkers = VisibleMarkers.BOTH
) -> TargetEstimate:
    decay = math.exp(-t_s / 4.0)
    return mission.target_at(
        t_s,
        (0.6, -0.4, 2.2),
        last_measured_at_s=t_s if measured else t_s - 0.13,
        is_measured_in_newest_frame=measured,
        unseen_frames=0 if measured else 4,
        stage=stage,
        e_m=np.array([0.3 * decay, -0.2 * decay, max(0.0, 1.9 - z_m)]),
        e_yaw_rad=2.0 * decay,
    )


def output(index: int, truth: TargetEstimate, rng: np.random.Generator) -> PipelineOutput:
    """Noisy poses of the large marker far away, of the small one near by."""
    corners_px = np.array([[100.1234, 90.0], [200.0, 90.0], [200.0, 190.0], [100.0, 190.0]])
    poses: dict[str, MarkerPose] = {}
    found: dict[str, Detection] = {}
    for marker, is_seen, sigma in (
        ("large", truth.e_m[2] > 0.12, 0.01),
        ("small", truth.e_m[2] < 0.5, 0.004),
    ):
        if is_seen:
            e_m = truth.e_m + rng.normal(0.0, sigma, 3)
            e_yaw_rad = truth.e_yaw_rad + float(rng.normal(0.0, 3.0 * sigma))
            poses[marker] = MarkerPose(
                marker, truth.t_s, np.zeros(3), np.zeros(3), e_m, e_yaw_rad, np.full(3, sigma),
                sigma, 0.4,
            )  # fmt: skip
            found[marker] = Detection(marker, corners_px, 0.1, are_corners_fitted=True)
    detections = Detections(index, truth.t_s, **found)
    return PipelineOutput(detections=detections, poses=poses, target=truth, stage=truth.stage)


def ticks(seed: int = 7) -> Iterator[dict[str, Any]]:
    """The records of the flight in `PLAN`, 50 a second, a frame in every other."""
    rng = np.random.default_rng(seed)
    t_s, n = 1.1, 0
    for phase, duration_s, reason in PLAN:
        for _ in range(max(1, round(duration_s / PERIOD_S))):
            flown_s = n * PERIOD_S
            z_m = min(1.87, 0.25 * flown_s)
            seen = flown_s > 3.2
            gone = GONE_S[0] < flown_s < GONE_S[1]
            stage = VisibleMarkers.LARGE if z_m < 1.5 else VisibleMarkers.BOTH
            pose = target(flown_s, z_m, not gone, stage) if seen else None
            frame = None
            if pose is not None and not gone and n % 2 == 0:
                frame = output(n // 2, pose, rng)
            yield tick_record(
                tick(
                    t_s,
                    telemetry(t_s - 0.012, z_m),
                    _command(phase, z_m),
                    state_with(phase=Phase(phase), reason=reason),
                    output=frame,
                    target=pose,
                )
            )
            n += 1
            t_s += PERIOD_S


def tick(
    t_s: float,
    sample: Telemetry,
    command: Command,
    state: PlannerState,
    output: PipelineOutput | None = None,
    target: TargetEstimate | None = None,
    consistency: CameraCalibrationErrors | None = None,
    delay_used_s: float = 0.0,
    outside: ExternalPositionStatus | None = None,
) -> Tick:
    obs = Observation(
        t_s, sample, target, last_good_frame_age_s=0.03, camera_latency_above_profile_s=delay_used_s
    )
    turn = flown_turn(obs, command, external_positions=outside)
    return Tick(record=turn, state=state, output=output, camera_errors=consistency)


def flown_turn(obs: Observation, command: Command, **more: Any) -> TickRecord:
    """A turn that was flown, as the loop hands it to its watchers."""
    t_s = obs.t_s
    turn = TickRecord(number=0, role="flown", began_s=t_s, t_s=t_s, inputs=TickInputs())
    return replace(turn, observation=obs, command=command, **more)


def _command(phase: str, z_m: float) -> Command:
    match phase:
        case "APPROACH":
            return PositionSetpoint(0.3, -0.2, 0.5, 0.5)
        case "COMPLETE":
            return StopMotors()
        case "PERCHED":
            return Idle()
    return PositionSetpoint(0.6, -0.4, z_m + 0.05, 0.5)


def write(
    path: Path,
    changes: Mapping[str, Any] | None = None,
    summary: Mapping[str, Any] | None = None,
    events: Sequence[Event] = (),
    most: int | None = None,
) -> Path:
    """The flight as a file: its first `most` ticks, the header's `changes`, and `events` at the
    end; without a summary it was killed."""
    writer = LogWatcher.open(path, header() | dict(changes or {}))
    for record in islice(ticks(), most):
        writer.write(record)
    for event in events:
        writer.event(event)
    writer.end(summary)
    return writer.path


SUMMARY = {
    "outcome": "perched",
    "cause": "perched",
    "reason": "hanging still with the motors off",
    "duration_s": 18.6,
    "attempts": 1,
    "miss_m": 0.0031,
    "battery_min_v": 3.7,
    "locked": False,
    "fell": False,
}


def small_log(path: Path, ticks: int = 5) -> Path:
    writer = LogWatcher.open(path, header())
    for i in range(ticks):
        writer.write({"t_s": 0.02 * i, "phase": "SEARCH", "z_m": 0.1 * i})
        writer.event(mission.note(0.02 * i, f"event {i}"))
    writer.end(SUMMARY)
    assert writer.problem is None
    return writer.path
