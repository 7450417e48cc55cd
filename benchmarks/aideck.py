"""What an AI-deck's pictures are good for: whole simulated flights by rate and latency, and a
colour camera's mosaic before the detector.

    python benchmarks/aideck.py [-n 30] [--jobs 1] [-p aideck]
    python benchmarks/aideck.py --mosaic [-n 12]

Flights: 324x244 at 10 and 20 Hz, 100 and 250 ms late, each up to 20 ms beside what the profile
says (`--beside`). Exit code 1 where one fell or was locked.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import cv2
import numpy as np
from common import Picture, camera_pose, in_view, renderer, rms, setup_with, table, true_corners

from perchctl.calibration import load_calibration
from perchctl.camera.aideck import remove_mosaic
from perchctl.campaign import FlightResult
from perchctl.campaign.flights import fly_seed
from perchctl.geometry import Array
from perchctl.profile import Profile, load_profile
from perchctl.vision import MARKERS, Frame
from perchctl.vision.markers.detect import detect_markers

CALIBRATION = "example_aideck_324x244.yaml"
CORNERS = ((10.0, 0.1), (10.0, 0.25), (20.0, 0.1), (20.0, 0.25))
GAINS = ((0.55, 1.0, 0.7), (0.4, 1.0, 0.95))
"""Of blue, green, red on white paper: by daylight, by warm lamps."""
RANGES_M = (0.06, 0.2, 0.5, 0.9, 1.2)
NOISE, DEFOCUS_PX, JPEG_QUALITY = 4.0, 0.9, 75


def flown_with(profile: Profile, rate_hz: float, latency_s: float, beside_s: float) -> Profile:
    """The profile under that camera; `beside_s`: what the true latency is off by, at most."""
    camera = profile.camera.model_copy(update={"latency_s": latency_s})
    drawn = (latency_s - beside_s, latency_s + beside_s)
    simulation = profile.simulation.model_copy(
        update={"camera_rate_hz": rate_hz, "camera_latency_s": drawn}
    )
    return profile.model_copy(update={"camera": camera, "simulation": simulation})


def row(results: list[FlightResult], rate_hz: float, latency_s: float) -> tuple[object, ...]:
    miss_mm = [1e3 * r.miss_m for r in results if r.miss_m is not None] or [float("nan")]
    times_s = [r.time_s for r in results]
    attempts = Counter(r.attempts for r in results)
    return (
        f"{rate_hz:g} Hz, {1e3 * latency_s:g} ms",
        f"{sum(r.outcome == 'perched' for r in results)}/{len(results)}",
        float(np.median(miss_mm)),
        float(np.percentile(miss_mm, 95)),
        max(miss_mm),
        float(np.median(times_s)),
        max(times_s),
        " ".join(f"{n} x {k}" for k, n in sorted(attempts.items())),
        sum(r.fell or r.locked for r in results),
    )


def flights(options: argparse.Namespace) -> int:
    profile = load_profile(options.profile)
    rows, bad = [], 0
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(options.jobs, mp_context=context) as executor:
        for rate_hz, latency_s in CORNERS:
            flown = flown_with(profile, rate_hz, latency_s, options.beside)
            results = list(executor.map(partial(fly_seed, flown), range(options.number)))
            bad += sum(r.fell or r.locked for r in results)
            rows.append(row(results, rate_hz, latency_s))
            for r in results:
                if r.outcome != "perched":
                    print(f"{rows[-1][0]}: seed {r.seed} {r.outcome}: {r.reason}", flush=True)
    table(
        f"profile {options.profile}",
        ("", "perched", "miss mm", "95 %", "most", "s", "most s", "attempts", "fell, locked"),
        rows,
    )
    return 1 if bad else 0


def mosaic_of(image: Array, gains: tuple[float, float, float]) -> Array:
    """The grey scene through a colour sensor's filters."""
    blue, green, red = gains
    factors = np.full(image.shape, green)
    factors[0::2, 0::2], factors[1::2, 1::2] = blue, red
    return image * factors


WAYS: dict[str, Callable[[Picture], Picture]] = {
    "as it is": lambda image: image,
    "OpenCV's": lambda image: np.asarray(cv2.cvtColor(image, cv2.COLOR_BayerBG2GRAY), np.uint8),
    "1 2 1": remove_mosaic,
}


def mosaic(number: int) -> int:
    """Corner errors of the first sight, whatever the way from the mosaic to grey."""
    camera = load_calibration(CALIBRATION)
    setup = setup_with(camera).detector_setup
    rng = np.random.default_rng(1)
    rows = []
    for as_jpeg in (False, True):
        for z_m in RANGES_M:
            errors: dict[str, list[float]] = {name: [] for name in ("grey camera", *WAYS)}
            shown = 0
            for k in range(number * len(GAINS)):
                x, y = (float(v) for v in rng.uniform(-0.1, 0.1, 2) * z_m)
                roll, pitch = (float(v) for v in rng.uniform(-0.05, 0.05, 2))
                T = camera_pose(x, y, z_m, float(rng.uniform(-3.1, 3.1)), roll, pitch)
                scene = renderer(k % 4, camera, camera_noise_sigma=0.0)
                clean = scene.render([T], DEFOCUS_PX, k).astype(float)
                noise = rng.normal(0.0, NOISE, clean.shape)
                names = [m for m in MARKERS if in_view(true_corners(T, m, camera), camera)]
                names = [m for m in names if m == "large" or z_m < 0.3]
                shown += len(names)
                coloured = mosaic_of(clean, GAINS[k % len(GAINS)])
                pictures = {"grey camera": delivered(clean + noise, as_jpeg)}
                pictures |= {n: w(delivered(coloured + noise, as_jpeg)) for n, w in WAYS.items()}
                for way, image in pictures.items():
                    found = detect_markers(
                        Frame(0, 0.0, image, picture_kind="whole"), None, setup, camera
                    )
                    for name in names:
                        seen = getattr(found, name)
                        if seen is not None:
                            off = seen.corners_px - true_corners(T, name, camera)
                            errors[way].append(float(np.mean(off**2)) ** 0.5)
            cells = [f"{rms(e):.3f} ({len(e)}/{shown})" for e in errors.values()]
            rows.append((f"{'JPEG' if as_jpeg else 'raw'}, {1e2 * z_m:g} cm", *cells))
    head = ("", "grey camera", *WAYS)
    table("corners, RMS px (found), of a colour camera's picture made grey", head, rows)
    return 0


def delivered(image: Array, as_jpeg: bool) -> Picture:
    picture = np.clip(image, 0, 255).astype(np.uint8)
    if not as_jpeg:
        return picture
    data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-n", "--number", type=int, default=None, help="flights, or pictures")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("-p", "--profile", default="aideck")
    parser.add_argument("--beside", type=float, default=0.02, help="latency wrong by, at most, s")
    parser.add_argument("--mosaic", action="store_true", help="pictures instead of flights")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    if options.mosaic:
        return mosaic(options.number or 12)
    options.number = options.number or 30
    return flights(options)


if __name__ == "__main__":
    raise SystemExit(main())
