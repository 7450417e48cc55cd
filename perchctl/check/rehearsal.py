"""Run the flight loop's perception on live images for a few seconds, to find out what it detects
and how long it takes.

A rehearsal cannot send anything to the vehicle, because it only has access to the telemetry.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from perchctl.camera import FrameSource
from perchctl.flight import FlightInputs, GroundCriteria, WallClock
from perchctl.geometry import Array
from perchctl.profile import Profile
from perchctl.target import PrintCheck
from perchctl.vehicle import Telemetry
from perchctl.vision import (
    MARKERS,
    Frame,
    Pipeline,
    PipelineOutput,
    TargetEstimate,
    refine_corners_by_lines,
)

REHEARSED_S = 3.0
WARM_FRAMES = 3
"""Number of frames at the start that are not timed, because libraries are still being loaded."""
KEPT_FRAMES = 12
TRACK_SETTLES_S = 0.5

TakeTelemetry = Callable[[], list[Telemetry]]
"""Returns the samples that arrived since the last call."""


@dataclass(frozen=True)
class PictureProblem:
    """A problem with an image. `kind` is its name in `FrameHealth`, or ``mirrored``; None for any
    other problem."""

    text: str
    kind: str | None = None


@dataclass(eq=False)
class Rehearsal:
    """Result of a rehearsal.

    Attributes:
        arrivals: index and arrival time of each image.
        repeats: number of repeated images, which other counts leave out.
        processing_s: processing time of each tick with an image; tick_delays_s: lateness of each
            tick.
        ages_s: time from each image's exposure (computed with `camera.latency_s`) to its result.
        problem: the camera's problem at the end, or empty; problems: number of images with each
            problem.
        newest_outputs: the last few pipeline outputs; target_pictures: number of images with a
            target.
        silent_s: time without an image at the end.
        target: the final estimate; None if the target was not detected.
        target_places: time and position of the target, m, in each image in which it was measured
            since the vehicle came to rest.
        prints: the comparison of the two markers' apparent sizes; None for too few frames.
        blur_px: sigma of the markers' edges; None if not measured.
        scheme: the kind of source, such as ``camera``, on which the advice depends.
    """

    live: bool
    problem: str = ""
    arrivals: list[tuple[int, float]] = field(default_factory=list)
    processing_s: list[float] = field(default_factory=list)
    tick_delays_s: list[float] = field(default_factory=list)
    ages_s: list[float] = field(default_factory=list)
    problems: Counter[PictureProblem] = field(default_factory=Counter)
    newest_outputs: list[tuple[Frame, PipelineOutput]] = field(default_factory=list)
    pictures: int = 0
    repeats: int = 0
    target_pictures: int = 0
    silent_s: float = 0.0
    target: TargetEstimate | None = None
    target_places: list[tuple[float, Array]] = field(default_factory=list)
    prints: PrintCheck | None = None
    blur_px: float | None = None
    scheme: str = ""

    @property
    def target_moved_m(self) -> float:
        """Distance, m, by which the target has moved since its track settled, according to the
        detections; 0 if unknown."""
        places = self.target_places
        settled_m = [m for t_s, m in places if t_s - places[0][0] >= TRACK_SETTLES_S]
        return float(np.linalg.norm(settled_m[-1] - settled_m[0])) if settled_m else 0.0

    @property
    def frame_period_s(self) -> float | None:
        """Mean time between images; None for fewer than two images, or for a recording."""
        if not self.live or len(self.arrivals) < 2:
            return None
        (first, begin_s), (last, end_s) = self.arrivals[0], self.arrivals[-1]
        return (end_s - begin_s) / (last - first) if last > first else None


@dataclass(frozen=True)
class _TelemetryOnly:
    """Stand-in for a link that only returns telemetry. If `feet_m` is given, the vehicle is assumed
    to be at that position, because its own estimate diverges if it is sent no positions."""

    take: TakeTelemetry
    feet_m: tuple[float, float, float] | None

    def telemetry(self) -> list[Telemetry]:
        samples, feet_m = self.take(), self.feet_m
        if feet_m is None:
            return samples
        return [replace(t, position_m=feet_m, velocity_mps=(0.0, 0.0, 0.0)) for t in samples]


def rehearsal_telemetry(take: TakeTelemetry, profile: Profile) -> _TelemetryOnly:
    """A stand-in for the link that gives a rehearsal the telemetry returned by `take`."""
    by_target = profile.positioning.source.is_target
    return _TelemetryOnly(take, (0.0, 0.0, profile.safety.ground_z_m) if by_target else None)


def rehearse(
    take: TakeTelemetry,
    source: FrameSource,
    pipeline: Pipeline,
    profile: Profile,
    clock: WallClock,
    duration_s: float = REHEARSED_S,
    stopwatch: Callable[[], float] = time.perf_counter,
) -> Rehearsal:
    """Run perception for `duration_s` at the loop's rate, on the telemetry returned by `take` and
    on the frames of `source`, which must have the calibrated size.

    `stopwatch` measures processing times, as `clock` may be simulated.
    """
    polled: list[Frame] = []  # frame of this loop iteration, at most one
    telemetry = rehearsal_telemetry(take, profile)
    senses = FlightInputs(telemetry, source, pipeline, profile, on_frame=polled.append)
    done = Rehearsal(source.live)
    prints = PrintCheck(pipeline.camera, profile.target)
    period_s = 1.0 / profile.link.loop_hz
    due_s = start_s = clock.now()
    while due_s < start_s + duration_s and not source.finished:
        began_s, mark_s = clock.now(), stopwatch()
        polled.clear()
        senses.poll_inputs(began_s)
        work_s = stopwatch() - mark_s
        done.tick_delays_s.append(max(0.0, began_s - due_s))
        for frame in polled:
            _note(done, frame, senses, prints, work_s, began_s)
        due_s += period_s
        if due_s < clock.now():
            due_s = clock.now()  # as in the flight loop, do not make up for missed iterations
        clock.wait_until(due_s)
    end_s = clock.now()
    done.problem = source.problem(end_s) or ""
    done.silent_s = end_s - (done.arrivals[-1][1] if done.arrivals else start_s)
    target = senses.target(end_s)
    done.target = target if target is not None and target.tracked else None
    done.prints = prints if prints.has_enough_frames else None
    done.blur_px = _blur_px(done.newest_outputs, pipeline)
    return done


def _note(
    done: Rehearsal,
    frame: Frame,
    senses: FlightInputs,
    prints: PrintCheck,
    work_s: float,
    now_s: float,
) -> None:
    if senses.repeated:
        done.repeats += 1
        return
    done.pictures += 1
    done.arrivals.append((frame.index, frame.t_arrival_s))
    if senses.camera_problem is not None:
        done.problems[PictureProblem(senses.camera_problem, senses.problem_kind)] += 1
    output = senses.output
    newest = senses.history.newest
    stands = newest is not None and GroundCriteria(newest, senses.profile).stands
    if not stands:
        done.target_places.clear()
    if output is None:
        return
    if done.pictures > WARM_FRAMES:
        done.processing_s.append(work_s)
        done.ages_s.append(now_s - frame.t_s + work_s)
    seen = output.detections
    done.target_pictures += seen.large is not None or seen.small is not None
    target = output.target
    if (
        stands
        and target is not None
        and target.is_measured_in_newest_frame
        and target.world_m is not None
    ):
        done.target_places.append((frame.t_s, target.world_m))
    prints.add(output)
    done.newest_outputs = [*done.newest_outputs[1 - KEPT_FRAMES :], (frame, output)]


def _blur_px(
    newest_outputs: Sequence[tuple[Frame, PipelineOutput]], pipeline: Pipeline
) -> float | None:
    """The sigma of the marker's edges, px; None if the target was not seen."""
    found_px = []
    for frame, output in newest_outputs:
        for name in MARKERS:
            seen = output.detections.get(name)
            if seen is None:
                continue
            rim = pipeline.detector_setup.patterns[name].cells_along_border
            corners = seen.corners_px.reshape(1, 4, 2)
            (refined,) = refine_corners_by_lines(frame.image, corners, [rim], pipeline.camera)
            if refined is not None:
                found_px.append(refined.sharpest_side_blur_sigma_px)
                break  # the large marker if it was seen
    return float(np.median(found_px)) if found_px else None
