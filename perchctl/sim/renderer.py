"""The picture of the ceiling and its target from a camera pose.

Every image pixel is a ray, traced to the ceiling's plane and looked up in
textures; lens distortion lies in the rays, which are precomputed. The sheets' map
is exact at each pixel of a tile in which they show an edge; other tiles are filled
(`perchctl.sim.tiles`). The ceiling's is evaluated at every eighth and interpolated,
which errs by less than 0.01 px for lenses up to 90 degrees.

Behind the renderer: what the lens makes of the pixels, the sheets on the ceiling, what an analogue
link does to a picture, and the motion within one exposure.

Pixel (0, 0) is the centre of the top-left pixel, as in OpenCV.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array, invert_T, make_T, rot_z, rotation_from_rpy
from perchctl.profile import TargetConfig
from perchctl.sim.gloss import shone_upon
from perchctl.sim.pixels import Mean, defocused, lit, sample, vignetting
from perchctl.sim.rays import (
    COARSE_PX,
    FINE_PX,
    LEAST_RISE,
    RayGrid,
    local_px_per_m,
    plane_map,
    ray_grid,
    trace,
)
from perchctl.sim.scenario import Neighbour, Scenario
from perchctl.sim.shutter import Shot, blended, woven
from perchctl.sim.still import STILL_PX, Stills, rounded
from perchctl.sim.surfaces import (
    CEILING_TEXTURE_PX,
    SAMPLING_SIGMA_PX,
    TILE_M,
    Ceiling,
    Picture,
    Sheet,
    SheetTexture,
)
from perchctl.sim.tiles import (
    Box,
    TileRays,
    Tiles,
    box_around,
    box_of,
    by_tile,
    fill,
    reach_of,
    tile_rays,
    tiles_of,
)
from perchctl.target import draw_target
from perchctl.vision import CameraModel

CEILING_STREAM, NOISE_STREAM, FRAME_STREAM = 401, 402, 403
"""Numbers of this part's random streams."""

FLOOR_GREY = 60
_NOISE_ROOM_PX = 64
"""By so much the bank of noise is larger than a picture. Each frame has another part of it, 4225
of them until the first comes again; and so small a bank stays near to the processor."""
_PLAIN_PX = 1.5
"""Blur of the lens that the bare ceiling, drawn at half the size or less, does not show."""
_COVERING_SIGMA = 4.0
"""Noise, grey levels, under which nobody sees whether the ceiling is drawn at a quarter of the
size or at half of it: these differ by a spread of 1.1 to 1.3."""
_CENTER_TEXEL = CEILING_TEXTURE_PX / 2.0 - 0.5


class Renderer:
    """Renders frames; `render` depends on its arguments and the seed only.

    Args:
        scenario: the ceiling's height, the target's place and true print sizes
            (`large_side_m`, `small_side_m`), noise, bare ceiling or not;
            ``extra["analogue"]`` in 0..1 adds the faults of an analogue video link.
        camera: the true camera.
        target: dictionaries and ids; its sizes are replaced by the scenario's.
        seed: of texture and noise; the scenario's own if None.
    """

    def __init__(
        self,
        scenario: Scenario,
        camera: CameraModel,
        target: TargetConfig,
        seed: int | None = None,
    ) -> None:
        self.scenario = scenario
        self.camera = camera
        self.seed = scenario.seed if seed is None else seed
        printed = TargetConfig(
            large=target.large.model_copy(update={"side_m": scenario.large_side_m}),
            small=target.small.model_copy(update={"side_m": scenario.small_side_m}),
        )
        own = () if scenario.no_target else (Placed(printed_sheet(printed.model_dump_json())),)
        self._sheets = (*own, *(beside(n, printed) for n in scenario.neighbours))
        self._glossy_half_m = 0.0
        if own and scenario.gloss > 0.0:
            self._glossy_half_m = own[0].sheet.drawing.sheet_side_m / 2.0
        self._stills = Stills()
        self.move_target(scenario.target_xy_m)
        self._ceiling = Ceiling(np.random.default_rng([self.seed, CEILING_STREAM]))
        lens = lens_of(camera)
        self._coarse, self._tiles, self.shade = lens.coarse, lens.tiles, lens.shade
        self._places, self._focal_px = lens.places, lens.focal_px
        self._ceiling_px = 4 if scenario.camera_noise_sigma >= _COVERING_SIGMA else 2
        self._noise, self._noise_at = self._noise_bank()
        self._analogue = min(max(float(scenario.extra.get("analogue", 0.0)), 0.0), 1.0)

    def move_target(self, xy_m: tuple[float, float]) -> None:
        """The target's centre is there from now on."""
        self._stills.forget()
        scenario = self.scenario
        z_m = scenario.ceiling_z_m + scenario.target_above_ceiling_m
        turn = rotation_from_rpy(*scenario.target_tilt_rad, 0.0) @ rot_z(scenario.target_yaw_rad)
        self.T_world_target = make_T(turn, (*xy_m, z_m))
        self._T_target_world = invert_T(self.T_world_target)
        self._lamp_m = (self._T_target_world @ (*scenario.lamp_m, 1.0))[:3]

    def render(
        self,
        T_world_cam_samples: Sequence[Array] | Array,
        defocus_px: float | None = None,
        frame_index: int = 0,
    ) -> Picture:
        """One exposure.

        Args:
            T_world_cam_samples: poses (4, 4) at equal steps over the exposure,
                first and last included; a single one is a still camera.
            defocus_px: sigma of the lens's blur; the scenario's if None.
            frame_index: chooses the noise.

        Returns: uint8, shape (height, width).
        """
        shot = Shot((tuple(T_world_cam_samples),))
        return self.expose([shot], frame_index=frame_index, defocus_px=defocus_px)

    def expose(
        self, shots: Sequence[Shot], frame_index: int = 0, defocus_px: float | None = None
    ) -> Picture:
        """The frame of one shot, or of two fields in their order of time; which rows are
        the first one's, and whether they are blended, is the scenario's. Otherwise as
        `render`."""
        scene = self.scenario
        top_first = scene.camera_fields != "bottom"
        picture = woven([self._exposed(shot, defocus_px) for shot in shots], top_first)
        if len(shots) > 1 and scene.camera_blended:
            picture = blended(picture)
        if self._noise is not None:
            width, height = self.camera.size_px
            r, c = self._noise_at[frame_index % len(self._noise_at)]
            more, less = (bank[r : r + height, c : c + width] for bank in self._noise)
            picture = np.asarray(cv2.add(picture, more), np.uint8)
            cv2.subtract(picture, less, picture)
        if self._analogue > 0.0:
            rng = np.random.default_rng([self.seed, FRAME_STREAM, frame_index])
            picture = spoil(picture, self._analogue, rng)
        return np.array(picture, np.uint8, copy=True if self._noise is None else None)

    def _exposed(self, shot: Shot, defocus_px: float | None) -> Picture:
        """What falls onto the sensor in one shot, before noise. Not to be written into."""
        rows = [self._T_target_world @ np.array(poses) for poses in shot.rows]
        motion_px = self._motion_px(rows[len(rows) // 2])
        length_px = path_length_px(motion_px)
        sigma = self.scenario.camera_defocus_px if defocus_px is None else defocus_px
        if length_px < STILL_PX and len(rows) == 1:
            pose = rounded(rows[0][len(rows[0]) // 2])
            motion_px, still = np.zeros((5, 1, 2)), [pose[None]]
            make = partial(self._projected, still, motion_px, 0.0, sigma)
            picture = self._stills.picture(pose, sigma, make)
        else:
            picture = self._projected(rows, motion_px, length_px, sigma)
        return picture if shot.light is None else lit(picture, shot.light)

    # -- through the lens ---------------------------------------------------

    def _projected(
        self, rows: list[Array], motion_px: Array, length_px: float, sigma_px: float
    ) -> Picture:
        """The picture at poses T_target_cam, of each row (n, 4, 4)."""
        count = sample_count(length_px)
        if count == 1 and all(len(poses) % 2 for poses in rows):
            by_row = [plane_map(poses[len(poses) // 2][None]) for poses in rows]
        else:
            by_row = [plane_map(spread(poses, count)) for poses in rows]
        maps = by_row[0] if len(rows) == 1 else np.stack(by_row, axis=1)
        picture, box = self._optical(maps, motion_px, length_px)
        if self._glossy_half_m:
            middle = rows[len(rows) // 2]
            picture = shone_upon(
                picture, self._coarse, middle[len(middle) // 2], self._lamp_m,
                self.scenario.gloss, self._glossy_half_m,
            )  # fmt: skip
        lens = math.sqrt(max(sigma_px**2 - SAMPLING_SIGMA_PX**2, 0.0))
        if lens > _PLAIN_PX:
            picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), lens), np.uint8)
        elif lens > 0.05 and box is not None:
            defocused(picture, lens, box)
        width, height = self.camera.size_px
        seen = picture[:height, :width]
        return np.asarray(cv2.multiply(seen, self.shade, seen, scale=1.0 / 255.0), np.uint8)

    def _optical(
        self, maps: Array, motion_px: Array, length_px: float
    ) -> tuple[Picture, Box | None]:
        """The picture before defocus, at the ray grids' padded size, and the tiles among which
        there is a sheet, None without one."""
        middle = maps[len(maps) // 2]
        if len(maps) % 2 == 0:
            middle = (maps[len(maps) // 2 - 1] + middle) / 2.0
        nodes, misses = trace(self._coarse, middle)
        views = [view for s in self._sheets if (view := s.view(nodes, length_px)) is not None]
        rows, cols = (n - 2 for n in nodes.shape[:2])
        hiding = [view for view in views if view.hides(rows * cols)]
        if hiding:
            picture = np.empty((rows * COARSE_PX, cols * COARSE_PX), np.uint8)
        else:
            picture = self._background(nodes, misses, motion_px, length_px)
        for view in hiding or views:
            self._add_sheet(picture, view, maps)
        return picture, box_around([view.box for view in hiding or views])

    def _background(
        self,
        nodes: NDArray[np.float32],
        misses: NDArray[np.bool_],
        motion_px: Array,
        length_px: float,
    ) -> Picture:
        """The bare ceiling, several pixels drawn as one: its texture carries no measurement."""
        rows, cols = nodes.shape[:2]
        mid = nodes[rows // 2, cols // 2]
        px_per_m = local_px_per_m(nodes, rows // 2, cols // 2, COARSE_PX)
        step = self._ceiling_px
        texture = self._ceiling.texture(px_per_m / step)
        # Whole tiles, to have the view in the middle of the texture.
        tile = np.clip(np.round(mid / TILE_M), -1e3, 1e3) * TILE_M
        texels = nodes * np.float32(texture.px_per_m)
        texels += (_CENTER_TEXEL - tile * texture.px_per_m).astype(np.float32)
        crop = COARSE_PX // step
        wider = cv2.resize(texels, None, fx=crop, fy=crop)
        picture = sample(texture.image, wider[crop:-crop, crop:-crop], cv2.BORDER_WRAP)
        if misses.any():
            mask = cv2.resize(misses[1:-1, 1:-1].astype(np.uint8), picture.shape[::-1],
                              interpolation=cv2.INTER_NEAREST)  # fmt: skip
            picture[mask > 0] = FLOOR_GREY
        kernel = line_kernel(motion_px / step) if length_px >= SHARP_MOTION_PX else None
        if kernel is not None:
            picture = np.asarray(cv2.filter2D(picture, -1, kernel), np.uint8)
        return np.asarray(cv2.resize(picture, None, fx=step, fy=step), np.uint8)

    def _add_sheet(self, picture: Picture, view: View, maps: Array) -> None:
        tiles, texture, plane = view.tiles, view.texture, view.placed.plane
        whole = by_tile(picture)
        into = whole[view.box]
        fill(into, tiles.even, tiles.grey)
        outline = np.flatnonzero(tiles.outline)
        wanted = np.concatenate([outline, np.flatnonzero(tiles.edges)])
        if not len(wanted):
            return
        scale, centre = texture.px_per_m, texture.center_px
        to_texels = np.array([[scale, 0.0, centre], [0.0, scale, centre], [0.0, 0.0, 1.0]])
        if plane is not None:
            to_texels = to_texels @ plane
        places = np.divmod(wanted, into.shape[1])
        top, left = (each.start for each in view.box)
        grid = self._tiles.of((places[0] + top) * whole.shape[1] + places[1] + left)
        value, alpha = Mean(len(maps)), Mean(len(maps))
        for each in maps:
            texels = trace(grid, to_texels @ each)[0].reshape(-1, COARSE_PX**2, 2)
            value.add(sample(texture.value, texels))
            if len(outline):
                alpha.add(sample(texture.alpha, texels[: len(outline)]))
        pixels = value.result()
        if len(outline):
            on = pixels[: len(outline)]
            rows, cols = (axis[: len(outline)] for axis in places)
            behind = into[rows, cols].view(np.uint8)
            rest: Any = cv2.multiply(behind, cv2.bitwise_not(alpha.result()), scale=1.0 / 255.0)
            on[:] = cv2.add(rest, on)
        into[places] = pixels.view(np.uint64)

    # -- motion -------------------------------------------------------------

    def _motion_px(self, poses: Array) -> Array:
        """Path of the ceiling's image during the exposure at five places, (5, n, 2) px, from
        poses (n, 4, 4)."""
        if len(poses) == 1:
            return np.zeros((5, 1, 2))
        points = plane_map(poses[len(poses) // 2]).dot(self._places)
        points /= np.maximum(points[2], LEAST_RISE)
        points[2] = 0.0
        R, t = poses[:, :3, :3], poses[:, :3, 3:]
        cam = R.transpose(0, 2, 1) @ (points - t)  # (n, 3, 5)
        path = cam[:, :2] * (self._focal_px / np.maximum(cam[:, 2:], 1e-3))
        return np.asarray(path.transpose(2, 0, 1))

    def _noise_bank(self) -> tuple[tuple[Picture, Picture] | None, list[tuple[int, int]]]:
        """What is added to a picture, and what is taken off, one of them being 0 at each place:
        such sums of bytes cost a third of one with signed numbers. And from which row and column
        on for each frame."""
        sigma = self.scenario.camera_noise_sigma
        if sigma <= 0.0:
            return None, []
        width, height = self.camera.size_px
        size = (height + _NOISE_ROOM_PX, width + _NOISE_ROOM_PX)
        rng = np.random.default_rng([self.seed, NOISE_STREAM])
        bank = np.rint(rng.standard_normal(size, np.float32) * np.float32(sigma))
        across = _NOISE_ROOM_PX + 1
        places = np.stack(np.divmod(rng.permutation(across**2), across), axis=1).tolist()
        return (_bytes(bank), _bytes(-bank)), places


def _bytes(grey: NDArray[np.float32]) -> Picture:
    return np.clip(grey, 0.0, 255.0).astype(np.uint8)


# --- What a camera's lens makes of its pixels, for all pictures and all flights alike; pure ----


@dataclass(frozen=True, eq=False)
class Lens:
    """`coarse` the rays of every eighth pixel, `tiles` of all of them; `shade` the relative light
    (height, width), 255 for all of it; `places` rays (3, 5) to the picture's middle and into its
    quarters; `focal_px` the mean of both directions."""

    coarse: RayGrid
    tiles: TileRays
    shade: Picture
    places: Array
    focal_px: float


def lens_of(camera: CameraModel) -> Lens:
    """The camera's; flights share it, since its rays take longer than 20 pictures."""
    return _lens(*camera.contents)


@lru_cache(maxsize=2)
def _lens(size_px: tuple[int, int], model: str, K: bytes, dist: bytes) -> Lens:
    camera = CameraModel(size_px, np.frombuffer(K).reshape(3, 3), np.frombuffer(dist), model)
    fine, coarse = ray_grid(camera, FINE_PX), ray_grid(camera, COARSE_PX)
    focal_px = float(camera.K[0, 0] + camera.K[1, 1]) / 2.0
    shade = vignetting(fine, size_px)
    return Lens(coarse, tile_rays(fine), shade, _five_places(coarse), focal_px)


def _five_places(coarse: RayGrid) -> Array:
    rows, cols = coarse.xy.shape[:2]
    places = [(rows // 2, cols // 2)] + [
        (r, c) for r in (rows // 5, 4 * rows // 5) for c in (cols // 5, 4 * cols // 5)
    ]
    return np.array([[*coarse.xy[r, c], 1.0] for r, c in places], np.float64).T


# --- Sheets on the ceiling, and where each is seen in one exposure -----------------------------


@dataclass(frozen=True, eq=False)
class Placed:
    """A sheet, and how (3, 3) the own target's plane maps to its: None for the own."""

    sheet: Sheet
    plane: Array | None = None

    def seen_from(self, nodes: NDArray[np.float32]) -> NDArray[np.float32]:
        """The coarse nodes (rows, columns, 2) in this sheet's axes, m."""
        if self.plane is None:
            return nodes
        turn, shift = self.plane[:2, :2].T, self.plane[:2, 2]
        return np.asarray(nodes @ turn.astype(np.float32) + shift.astype(np.float32))

    def view(self, nodes: NDArray[np.float32], length_px: float) -> View | None:
        """At the coarse nodes (rows, columns, 2), in the own target's axes; `length_px` is the
        longest way of the picture within the exposure. None where the sheet is out of view."""
        moved = self.seen_from(nodes)
        side_m = self.sheet.drawing.sheet_side_m
        reach = reach_of(moved, length_px)
        box = box_of(reach.near(side_m))
        if box is None:
            return None
        j, i = ((each.start + each.stop - 1) // 2 + 1 for each in box)
        texture = self.sheet.texture(local_px_per_m(moved, j, i, COARSE_PX))
        return View(self, texture, box, tiles_of(reach.within(box), texture, side_m))


@dataclass(frozen=True, eq=False)
class View:
    """A sheet in one exposure, in the picture's `box` of tiles."""

    placed: Placed
    texture: SheetTexture
    box: Box
    tiles: Tiles

    def hides(self, tiles: int) -> bool:
        """Whether nothing else is seen in a picture of so many."""
        return self.tiles.inner.size == tiles and bool(self.tiles.inner.all())


def beside(neighbour: Neighbour, own: TargetConfig) -> Placed:
    """Another vehicle's target; what the neighbour leaves open is as on the own."""
    large = {} if neighbour.large_id is None else {"id": neighbour.large_id}
    small = {} if neighbour.small_id is None else {"id": neighbour.small_id}
    target = TargetConfig(
        large=own.large.model_copy(update=large), small=own.small.model_copy(update=small)
    )
    to_own = make_T(rot_z(neighbour.yaw_rad), (*neighbour.xy_m, 0.0))
    plane = np.delete(np.delete(invert_T(to_own), 2, axis=0), 2, axis=1)
    return Placed(printed_sheet(target.model_dump_json()), plane)


@lru_cache(maxsize=4)
def printed_sheet(target_json: str) -> Sheet:
    """The sheet of a target; its textures cost more than a second, and flights share them."""
    return Sheet(draw_target(TargetConfig.model_validate_json(target_json)))


# --- Faults of an analogue video link: lines that tremble, hum bars, torn and lost lines -------


LINE_JITTER_PX = 1.2
HUM_GREY = 18.0
TEAR_PX = 30.0
TEARS_PER_FRAME = 1.5
SNOW_LINES_PER_FRAME = 12.0
"""Means at full strength."""


def spoil(image: NDArray[np.uint8], strength: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The picture as a receiver shows it; `strength` 0 (clean) .. 1 (about to be lost)."""
    height, width = image.shape
    shift = np.asarray(rng.standard_normal(height) * LINE_JITTER_PX * strength)
    for _ in range(rng.poisson(TEARS_PER_FRAME * strength)):
        start, length = int(rng.integers(height)), int(rng.integers(4, 40))
        # A torn band comes back to its place over its length, as the receiver's line lock does.
        band = slice(start, min(start + length, height))
        fade = np.linspace(1.0, 0.0, length)[: band.stop - band.start]
        shift[band] += rng.normal(0.0, TEAR_PX * strength) * fade
    cols, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height))
    cols = cols + shift[:, None].astype(np.float32)
    out = cv2.remap(image, cols, rows.astype(np.float32), cv2.INTER_LINEAR,
                    borderMode=cv2.BORDER_REPLICATE).astype(np.float32)  # fmt: skip
    phase, bars = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.7, 2.5)
    hum = np.sin(2.0 * np.pi * bars * np.arange(height) / height + phase)
    out += (HUM_GREY * strength * hum)[:, None].astype(np.float32)
    for _ in range(rng.poisson(SNOW_LINES_PER_FRAME * strength)):
        row, left = int(rng.integers(height)), int(rng.integers(width))
        length = int(min(rng.exponential(0.3 * width) + 1.0, width - float(left)))
        out[row, left : left + length] = rng.uniform(0.0, 255.0, size=length)
    return np.clip(np.rint(out), 0.0, 255.0).astype(np.uint8)


# --- Motion within one exposure: how many poses it needs, and its blur as a kernel; pure -------


SHARP_MOTION_PX = 0.25
"""Motion in one exposure below which one pose is enough (its blur has sigma 0.07 px)."""
SAMPLE_SPACING_PX = 1.3
"""Distance of the poses averaged for motion blur: the ripple this leaves lies above
the pixels' own resolution."""
MAX_SAMPLES = 16
MAX_KERNEL_REACH_PX = 12


def path_length_px(motion_px: Array) -> float:
    """Longest path of any of the places, `motion_px` (places, times, 2)."""
    steps = motion_px[:, 1:] - motion_px[:, :-1]
    return float(np.sqrt((steps * steps).sum(axis=2)).sum(axis=1).max())


def sample_count(length_px: float) -> int:
    """How many poses the blur of a path of that length needs; 1 for a sharp frame."""
    if length_px < SHARP_MOTION_PX:
        return 1
    return min(max(math.ceil(length_px / SAMPLE_SPACING_PX), 2), MAX_SAMPLES)


def spread(poses: Array, count: int) -> Array:
    """`count` poses (count, 4, 4) at the middles of equal parts of the exposure.

    Linear in the matrices of `poses` (n, 4, 4): within an exposure the turn is so small
    (< 0.05 rad) that the loss of orthogonality is below 1e-3 of a pixel.
    """
    if len(poses) == 1:
        return np.broadcast_to(poses, (count, 4, 4))
    last = len(poses) - 1
    places = [(i + 0.5) / count * last for i in range(count)]
    low = [min(int(place), last - 1) for place in places]
    part = np.array([p - i for p, i in zip(places, low, strict=True)])[:, None, None]
    return np.asarray((1.0 - part) * poses[low] + part * poses[[i + 1 for i in low]])


def line_kernel(motion_px: Array) -> NDArray[np.float32] | None:
    """Blur kernel of the path at the image's middle, or None if it is too short to see."""
    path = motion_px[0] - motion_px[0].mean(axis=0)
    reach = float(np.abs(path).max())
    if reach < SHARP_MOTION_PX / 2.0:
        return None
    count = min(2 * math.ceil(reach) + 1, MAX_SAMPLES)
    at = (np.arange(count) + 0.5) / count * (len(path) - 1)
    steps = np.arange(len(path))
    half = min(math.ceil(reach) + 1, MAX_KERNEL_REACH_PX)
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    for x, y in zip(
        np.interp(at, steps, path[:, 0]), np.interp(at, steps, path[:, 1]), strict=True
    ):
        x, y = np.clip(x, -half, half - 1e-6), np.clip(y, -half, half - 1e-6)
        i, j = math.floor(x), math.floor(y)
        fx, fy = x - i, y - j
        weights = np.outer([1.0 - fy, fy], [1.0 - fx, fx])
        kernel[j + half : j + half + 2, i + half : i + half + 2] += weights.astype(np.float32)
    return np.asarray(kernel / kernel.sum(), np.float32)
