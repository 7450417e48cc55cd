"""Time a frame on a moving sequence, against two full-frame detectors: same frames, same
process, one thread, CPU time. All take turns, and of several passes each frame's least counts:
what else a machine does makes small steps dearer than large ones."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping

import numpy as np
from common import (
    CAMERA,
    arguments,
    camera_pose,
    in_view,
    marker_pose,
    plain_detect,
    renderer,
    setup_with,
    table,
    true_corners,
)

from perchctl.geometry import Array
from perchctl.vision import (
    Frame,
    PipelineOutput,
    PipelineState,
    VehicleState,
    deinterlace,
    step,
)
from perchctl.vision.markers.detect import detect_markers
from perchctl.vision.types import Detections

RATE_HZ, PASSES = 30.0, 15
BASE, WHOLE = "two full-frame detectors", "frame to target pose"
Found = dict[str, object]


def path(t: float) -> tuple[Array, VehicleState]:
    """A flight towards the target, swaying and turning: T_world_cam and the attitude."""
    roll, pitch = 0.06 * math.sin(2.3 * t), 0.05 * math.cos(1.9 * t)
    yaw = 0.4 * math.sin(0.7 * t)
    height = 0.20 + 0.85 * (0.5 + 0.5 * math.cos(0.45 * t))
    x, y = 0.12 * height * math.sin(1.3 * t), 0.10 * height * math.sin(1.7 * t + 0.5)
    T = camera_pose(x, y, height, yaw, roll, pitch)
    return T, VehicleState(t, roll, pitch, -yaw, tuple(T[:3, 3]))


def sequence(count: int) -> Iterator[tuple[Frame, VehicleState, Array]]:
    scene = renderer(seed=4, camera_noise_sigma=4.0)
    for k in range(count):
        t = k / RATE_HZ
        samples = [path(t + dt)[0] for dt in (-0.003, 0.0, 0.003)]
        T, attitude = path(t)
        yield Frame(k, t, scene.render(samples, 0.8, k)), attitude, T


def timed(
    count: int, works: Mapping[str, Callable[[int], Found]], afresh: Callable[[], None]
) -> dict[str, tuple[Array, list[Found]]]:
    """Of each work the CPU ms of each frame, and what was found in it; all take turns, and
    each pass begins `afresh`."""
    least = {label: np.full(count, math.inf) for label in works}
    found: dict[str, list[Found]] = {}
    for _ in range(PASSES):
        for label, work in works.items():
            afresh()
            found[label] = []
            for k in range(count):
                start = time.thread_time()
                found[label].append(work(k))
                took_ms = (time.thread_time() - start) * 1e3
                least[label][k] = min(least[label][k], took_ms)
    return {label: (least[label], found[label]) for label in works}


def main() -> None:
    quick = arguments(__doc__ or "").quick
    frames = list(sequence(120 if quick else 420))
    visible = {n: [in_view(true_corners(T, n)) for _, _, T in frames] for n in ("large", "small")}
    last: Detections | None = None
    state = PipelineState()
    setup = setup_with()
    errors = []

    def plain(k: int) -> Found:
        return dict(plain_detect(frames[k][0].image))

    def detection(k: int) -> Found:
        nonlocal last
        seen = detect_markers(frames[k][0], last, setup.detector_setup, CAMERA)
        last = seen if seen.large or seen.small else last
        return {"large": seen.large, "small": seen.small}

    def whole(k: int, attitude: VehicleState | None) -> Found:
        nonlocal state
        state, (frame,) = deinterlace(state, frames[k][0], setup)
        state, output = step(state, frame, attitude, setup)
        return {"large": output.detections.large, "small": output.detections.small, "all": output}

    def afresh() -> None:
        nonlocal last, state
        last, state = None, PipelineState()

    rows = []
    total = {name: sum(seen) for name, seen in visible.items()}
    works: dict[str, Callable[[int], Found]] = {
        BASE: plain,
        "detection, corners refined": detection,
        WHOLE: lambda k: whole(k, frames[k][1]),
        "the same without attitude": lambda k: whole(k, None),
    }
    results = timed(len(frames), works, afresh)
    base = np.percentile(results[BASE][0], [50, 99])
    for label, (times, found) in results.items():
        median, p99 = (float(v) for v in np.percentile(times, [50, 99]))
        hits = [
            sum(visible[name][k] and f.get(name) is not None for k, f in enumerate(found))
            for name in total
        ]
        rows.append((label, median, p99, float(base[0]) / median, float(base[1]) / p99, *hits))
        if label == WHOLE:
            for (_, _, T), f in zip(frames, found, strict=True):
                output = f["all"]
                assert isinstance(output, PipelineOutput)
                pose = next((output.poses[n] for n in ("joint", *total) if n in output.poses), None)
                if pose is not None:
                    errors.append(pose.tvec_m - marker_pose(T)[1])
    table(
        f"{len(frames)} frames of 640x480, one thread, CPU ms a frame",
        ("", "median", "p99", "x faster", "x at p99",
         f"large/{total['large']}", f"small/{total['small']}"),
        rows,
    )  # fmt: skip
    spread = 1000.0 * np.sqrt((np.array(errors) ** 2).mean(axis=0))
    print(
        f"  RMS of the frame's own pose: x {spread[0]:.2f} y {spread[1]:.2f} z {spread[2]:.2f} mm"
    )


if __name__ == "__main__":
    main()
