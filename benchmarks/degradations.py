"""What cameras, light and prints do to the target's pose: for each degradation how often the
markers are found, the errors of a picture's pose near and far, and whether its spread is true.

Pictures are the simulator's, with known truth. What moves does so at 0.3 m/s and 0.5 rad/s, and
the last of four frames counts; the rest are single pictures. The print counts as true, but
where it is not.

    python benchmarks/degradations.py --checkout ../older --save older.json
    python benchmarks/degradations.py --beside older.json
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import spoilt
from checkout import Checkout, Seen, Stream
from common import CAMERA, camera_pose, in_view, marker_pose, renderer, rms, table, true_corners

from perchctl.geometry import Array, wrap_rad
from perchctl.sim import Renderer
from perchctl.sim.camera import Shutter

NEAR_M = 0.25
RANGES_M = (0.05, 1.2)
LEAST_SIDE_PX = 14.0  # a marker that should be found
RATE_HZ, FRAMES = 25.0, 4
SPEED_MPS, TURN_RADPS = 0.3, 0.5
CUT_M, MOST_CUT = (0.2, 1.0), 0.05
MASK = "gear.png"
BLUR_PX, NOISE, EXPOSURE_S = 0.8, 3.0, 0.004
TRUE = {"size_sigma": 0.0, "curl_per_m": 0.0}
"""`target`'s keys of a print that is as the profile has it."""


@dataclass(frozen=True)
class Degradation:
    """`scene` goes into the renderer's scenario, `camera` and `target` into the profile; `cut`:
    the large marker reaches out of the picture."""

    name: str
    moving: bool = False
    scene: dict[str, Any] = field(default_factory=dict)
    spoil: spoilt.Spoil | None = None
    camera: dict[str, Any] = field(default_factory=dict)
    target: dict[str, Any] = field(default_factory=lambda: dict(TRUE))
    cut: bool = False


ROLLING = {"camera_readout_s": 0.02}
ROWS = (
    Degradation("clean"),
    Degradation("in motion", True),
    Degradation("fields woven", True, {"camera_fields": "top"}),
    Degradation("rolling 20 ms, known", True, ROLLING, camera={"readout_s": 0.02}),
    Degradation("rolling 20 ms, unknown", True, ROLLING, camera={"readout_s": None}),
    Degradation("flicker", False, ROLLING | {"camera_flicker": 0.35}),
    Degradation("pumping", True, {"camera_pumping": 0.4}),
    Degradation("JPEG 30", spoil=spoilt.jpeg),
    Degradation("vignette", spoil=spoilt.vignette),
    Degradation("highlight on a corner", spoil=spoilt.highlight),
    Degradation("own gear in view", spoil=spoilt.gear),
    Degradation("own gear, masked", spoil=spoilt.known_gear, camera={"mask": MASK}),
    Degradation("cut by up to 5 %", cut=True),
    Degradation("dark", spoil=spoilt.dark),
    Degradation("overexposed", spoil=spoilt.overexposed),
    Degradation("torn analogue", scene={"extra": {"analogue": 0.5}}),
    Degradation("print 2 % too large", target={},
                scene={"large_side_m": 0.153, "small_side_m": 0.0255}),
    Degradation("bulge 2 mm", spoil=spoilt.bulge, target={}),
)  # fmt: skip


@dataclass(frozen=True)
class Figures:
    """Found shares of what was in view; RMS of x and y (of each), z and yaw, and the mean
    squared error in units of the claimed spread, a degree of freedom, each near and far."""

    large: float
    small: float
    either: float
    worst_mm: float
    near: tuple[float, float, float, float]
    far: tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Sample:
    """A view of the target: at time 0, that of the frame that counts, it is at `e_m` in the
    camera's level frame, and which markers are to be found then; how it moves."""

    e_m: Array
    yaw_rad: float
    tilt_rad: tuple[float, float]
    velocity_mps: Array
    turn_radps: float

    def T_at(self, t_s: float) -> Array:
        """T_world_cam (4, 4)."""
        place = self.e_m + self.velocity_mps * t_s
        return camera_pose(*place, self.yaw_rad + self.turn_radps * t_s, *self.tilt_rad)

    @property
    def in_view(self) -> tuple[str, ...]:
        """Those that are wholly in the picture."""
        return tuple(name for name in ("large", "small") if _shows(self.T_at(0.0), name))


def samples(count: int, rng: np.random.Generator) -> Iterator[Sample]:
    """Half of them nearer than 25 cm."""
    for low_m, high_m in pairwise((RANGES_M[0], NEAR_M, RANGES_M[1])):
        yield from samples_between(low_m, high_m, count // 2, rng)


def samples_between(
    low_m: float, high_m: float, count: int, rng: np.random.Generator
) -> Iterator[Sample]:
    """Where a marker is in view."""
    done = 0
    while done < count:
        z = math.exp(rng.uniform(math.log(low_m), math.log(high_m)))
        x, y = rng.uniform((-0.5, -0.4), (0.5, 0.4)) * z
        yaw, roll, pitch = rng.uniform(-1, 1, 3) * (math.pi, 0.15, 0.15)
        way = rng.normal(size=3)
        way *= SPEED_MPS / np.linalg.norm(way)
        turn = float(rng.choice((-1.0, 1.0))) * TURN_RADPS
        sample = Sample(np.array([x, y, z]), yaw, (roll, pitch), way, turn)
        if sample.in_view:
            done += 1
            yield sample


def cut_samples(count: int, rng: np.random.Generator) -> Iterator[Sample]:
    """The large marker's outermost corner beyond the picture's edge by up to 5 % of a side."""
    for _ in range(count):
        across, sign = int(rng.integers(2)), float(rng.choice((-1.0, 1.0)))
        share, sample = math.inf, None
        while (
            sample is None
            or abs(_beyond(sample, across) - share) > 1e-3
            or (_beyond(sample, 1 - across) > 0.0)
        ):
            z = math.exp(rng.uniform(math.log(CUT_M[0]), math.log(CUT_M[1])))
            yaw, roll, pitch = rng.uniform(-1, 1, 3) * (math.pi, 0.08, 0.08)
            place, share = np.append(rng.uniform(-0.3, 0.3, 2) * z, z), rng.uniform(0.0, MOST_CUT)
            low, high = 0.0, 1.5 * z
            for _ in range(40):
                place = place.copy()
                place[across] = sign * 0.5 * (low + high)
                sample = Sample(place, yaw, (roll, pitch), np.zeros(3), 0.0)
                inside = _beyond(sample, across) < share
                low, high = (0.5 * (low + high), high) if inside else (low, 0.5 * (low + high))
        yield sample


def _beyond(sample: Sample, axis: int) -> float:
    """How far the large marker reaches out of the picture along an axis, in sides."""
    corners = true_corners(sample.T_at(0.0), "large")
    side = float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean())
    along = corners[:, axis]
    return max(float(along.max()) - (CAMERA.size_px[axis] - 1.0), -float(along.min())) / side


def _shows(T: Array, marker: str) -> bool:
    corners = true_corners(T, marker)
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
    return in_view(corners) and float(sides.min()) > LEAST_SIDE_PX


def frames(
    row: Degradation, sample: Sample, scene: Renderer, index: int, rng: np.random.Generator
) -> list[tuple[float, spoilt.Picture]]:
    """The stream up to the frame that counts, at time 0."""
    shutter, height = Shutter(scene.scenario), CAMERA.size_px[1]
    out = []
    for k in range(FRAMES if row.moving else 1):
        t_s = (k + 1 - FRAMES) / RATE_HZ if row.moving else 0.0
        lamp_s = t_s + index * 0.6180  # the light's phase

        def T_at(at_s: float, lamp_s: float = lamp_s, t_s: float = t_s) -> Array:
            return sample.T_at(at_s - lamp_s + t_s if row.moving else 0.0)

        shots = shutter.shots(lamp_s, T_at, height)
        picture = scene.expose(shots, frame_index=FRAMES * index + k)
        if row.spoil is not None:
            picture = row.spoil(picture, T_at(lamp_s), rng)
        out.append((t_s + 1.0, picture))
    return out


def error(seen: Seen, T: Array) -> Array:
    """(x, y, z) in m and yaw in rad of a pose, (4,)."""
    rvec, tvec = marker_pose(T)
    R = cv2.Rodrigues(rvec)[0]
    off = seen.e[:3] - tvec  # type: ignore[index]
    return np.append(off, wrap_rad(seen.e[3] - math.atan2(R[1, 0], R[0, 0])))  # type: ignore[index]


def measure(row: Degradation, count: int, looker: Checkout, folder: Path) -> Figures:
    """`count` samples, the same for every row that moves or stands as this one does. `folder`:
    where the gear's mask is."""
    rng = np.random.default_rng(5)
    scene = renderer(
        seed=5, camera_rate_hz=RATE_HZ, camera_noise_sigma=NOISE, camera_defocus_px=BLUR_PX,
        camera_exposure_s=EXPOSURE_S, **row.scene,
    )  # fmt: skip
    shown: dict[str, list[bool]] = {"large": [], "small": [], "either": []}
    near: list[tuple[Array, float]] = []
    far: list[tuple[Array, float]] = []
    camera = row.camera
    if "mask" in camera:
        camera = camera | {"mask": str(folder / MASK)}
    views = cut_samples(count, rng) if row.cut else samples(count, rng)
    for index, sample in enumerate(views):
        pictures = frames(row, sample, scene, index, np.random.default_rng([6, index]))
        seen = looker.look(Stream(pictures, {"camera": camera, "target": row.target}))
        for name in ("large",) if row.cut else sample.in_view:
            shown[name].append(name in seen.markers)
        shown["either"].append(seen.e is not None)
        if seen.e is None or seen.cov is None:
            continue
        e = error(seen, sample.T_at(seen.t_s - 1.0 if row.moving else 0.0))
        squared = float(e @ np.linalg.solve(seen.cov, e)) / 4.0
        (near if sample.e_m[2] < NEAR_M else far).append((e, squared))
    everything = [e for e, _ in near + far]
    return Figures(
        **{name: float(np.mean(s)) if s else math.nan for name, s in shown.items()},
        worst_mm=1e3 * max((float(np.abs(e[:3]).max()) for e in everything), default=math.nan),
        near=summary(near),
        far=summary(far),
    )


def summary(rows: list[tuple[Array, float]]) -> tuple[float, float, float, float]:
    if not rows:
        return (math.nan,) * 4
    E = np.array([e for e, _ in rows])
    xy, z, yaw = rms(E[:, :2].ravel()), rms(E[:, 2]), rms(E[:, 3])
    return 1e3 * xy, 1e3 * z, math.degrees(yaw), float(np.mean([s for _, s in rows]))


def cells(name: str, who: str, f: Figures) -> tuple[object, ...]:
    shares = ("-" if math.isnan(s) else f"{100 * s:.0f}" for s in (f.large, f.small, f.either))
    return (name, who, *shares, *f.near, *f.far, f.worst_mm)


def read(path: Path) -> dict[str, Figures]:
    """What `--save` has written."""
    return {name: Figures(**figures) for name, figures in json.loads(path.read_text()).items()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="fewer pictures, for a first look")
    parser.add_argument("--count", type=int, help="pictures a row")
    parser.add_argument("--only", help="rows whose name contains this")
    parser.add_argument("--checkout", type=Path, help="whose perchctl measures; default: this one")
    parser.add_argument("--save", type=Path, metavar="FILE.json", help="write the figures")
    parser.add_argument("--beside", type=Path, metavar="FILE.json", help="saved figures to show")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    count = options.count or (16 if options.quick else 100)
    old = read(options.beside) if options.beside else {}
    rows, results = [], {}
    with (
        TemporaryDirectory() as name,
        Checkout(options.checkout, (CAMERA.size_px, CAMERA.K, CAMERA.dist)) as looker,
    ):
        folder = Path(name)
        cv2.imwrite(str(folder / MASK), spoilt.GEAR.astype(np.uint8) * 255)
        for row in ROWS:
            if options.only and options.only not in row.name:
                continue
            results[row.name] = figures = measure(row, count, looker, folder)
            if row.name in old:
                rows.append(cells(row.name, options.beside.stem, old[row.name]))
            rows.append(cells("" if row.name in old else row.name, "now", figures))
    head = ("", "", "large %", "small %", "either %", "near: x, y mm", "z mm", "yaw deg", "sq./dof",
            "far: x, y mm", "z mm", "yaw deg", "sq./dof", "worst mm")  # fmt: skip
    table(f"{count} views a row, half of them nearer than {100 * NEAR_M:.0f} cm: found, RMS, and "
          "squared error in units of its spread", head, rows)  # fmt: skip
    if options.save:
        figures_of = {name: asdict(figures) for name, figures in results.items()}
        options.save.write_text(json.dumps(figures_of, indent=1) + "\n")


if __name__ == "__main__":
    main()
