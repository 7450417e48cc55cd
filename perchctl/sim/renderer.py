"""Render the image of the ceiling and its target from a camera pose.

Each pixel is a ray that is traced to the plane of the ceiling and looked up in textures. The rays
are precomputed and contain the lens distortion. The map of the sheets is exact at each pixel. The
map of the ceiling is evaluated at every eighth pixel and interpolated, with an error below 0.01 px
for lenses up to 90 degrees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array, invert_T, make_T, rot_z, rotation_from_rpy
from perchctl.profile import TargetConfig
from perchctl.sim.optics import (
    COARSE_PX,
    LEAST_RISE,
    Picture,
    RayGrid,
    local_px_per_m,
    ray_to_plane_map,
    shared_lens,
    trace_rays,
)
from perchctl.sim.scenario import Scenario
from perchctl.sim.sheets import (
    CEILING_TEXTURE_PX,
    SAMPLING_SIGMA_PX,
    TILE_M,
    Box,
    CeilingTexture,
    PlacedSheet,
    SheetView,
    neighbour_sheet,
    pixel_slices,
    printed_sheet,
    union_box,
)
from perchctl.vision import CameraModel

CEILING_STREAM, NOISE_STREAM, FRAME_STREAM = 401, 402, 403
"""Numbers of the renderer's random streams."""

FLOOR_GREY = 60
_NOISE_ROOM_PX = 64
"""Margin by which the bank of noise is larger than an image, px: each frame uses a different part
of the bank."""
_PLAIN_PX = 1.5
"""Blur of the lens above which the whole image is blurred, px. A smaller blur does not show on
the bare ceiling, which is drawn at half the size or less."""
_COVERING_SIGMA = 4.0
"""Noise, in grey levels, that hides the quarter resolution at which the ceiling is drawn."""
_CENTER_TEXEL = CEILING_TEXTURE_PX / 2.0 - 0.5


@dataclass(frozen=True, eq=False)
class Exposure:
    """The exposure of one field, or of a whole frame.

    Attributes:
        row_poses: for rows at equal distances from the first to the last, the camera poses
            T_world_cam (4, 4) at equal steps over their exposure. A single entry means that all
            rows are exposed at once (global shutter).
        row_brightness: factor of each row's brightness (height,); None: 1 for all.
    """

    row_poses: tuple[tuple[Array, ...], ...]
    row_brightness: Array | None = None


class Renderer:
    """Renders frames. The result of `render` depends only on its arguments and the seed.

    Args:
        scenario: the ceiling's height, the target's place and true print sizes
            (`large_side_m`, `small_side_m`), noise, bare ceiling or not;
            ``extra["analogue"]`` in 0..1 adds the faults of an analogue video link.
        camera: the true camera.
        target: dictionaries and ids; its sizes are replaced by the scenario's.
        seed: seed of texture and noise; None: that of the scenario.
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
        own = () if scenario.no_target else (PlacedSheet(printed_sheet(printed.model_dump_json())),)
        self._sheets = (*own, *(neighbour_sheet(n, printed) for n in scenario.neighbours))
        self.move_target(scenario.target_xy_m)
        self._ceiling = CeilingTexture(np.random.default_rng([self.seed, CEILING_STREAM]))
        lens = shared_lens(camera)
        self._coarse, self._pixels, self._shade = lens.coarse, lens.pixels, lens.shade
        self._places, self._focal_px = lens.sample_rays, lens.focal_px
        self._ceiling_px = 4 if scenario.camera_noise_sigma >= _COVERING_SIGMA else 2
        self._noise: NDArray[np.int16] | None = None
        if scenario.camera_noise_sigma > 0.0:
            self._noise, self._noise_at = self._noise_bank(scenario.camera_noise_sigma)
        self._analogue = min(max(float(scenario.extra.get("analogue", 0.0)), 0.0), 1.0)

    def move_target(self, xy_m: tuple[float, float]) -> None:
        """Move the target's centre to `xy_m`, world axes."""
        scenario = self.scenario
        z_m = scenario.ceiling_z_m + scenario.target_above_ceiling_m
        turn = rotation_from_rpy(*scenario.target_tilt_rad, 0.0) @ rot_z(scenario.target_yaw_rad)
        self.T_world_target = make_T(turn, (*xy_m, z_m))
        self._T_target_world = invert_T(self.T_world_target)

    def render(
        self,
        T_world_cam_samples: Sequence[Array] | Array,
        defocus_px: float | None = None,
        frame_index: int = 0,
    ) -> Picture:
        """The image of one exposure.

        Args:
            T_world_cam_samples: poses (4, 4) at equal steps over the exposure,
                first and last included; a single pose means a still camera.
            defocus_px: sigma of the lens's blur; the scenario's if None.
            frame_index: chooses the noise.

        Returns: uint8, shape (height, width).
        """
        shot = Exposure((tuple(T_world_cam_samples),))
        return self.expose([shot], frame_index=frame_index, defocus_px=defocus_px)

    def expose(
        self, shots: Sequence[Exposure], frame_index: int = 0, defocus_px: float | None = None
    ) -> Picture:
        """The frame of one `Exposure`, or of two fields, the earlier first, woven as the scenario's
        `camera_fields` specifies. Otherwise as `render`."""
        exposed = [self._exposed(shot, defocus_px) for shot in shots]
        picture = exposed[0]
        if len(shots) > 1:
            later = 0 if self.scenario.camera_fields == "bottom" else 1
            picture[later::2] = exposed[1][later::2]
        if self._noise is not None:
            width, height = self.camera.size_px
            r, c = self._noise_at[frame_index % len(self._noise_at)]
            noise = self._noise[r : r + height, c : c + width]
            picture = np.asarray(cv2.add(picture, noise, dtype=cv2.CV_8U), np.uint8)
        if self._analogue > 0.0:
            rng = np.random.default_rng([self.seed, FRAME_STREAM, frame_index])
            picture = add_analogue_faults(picture, self._analogue, rng)
        return picture

    def _exposed(self, shot: Exposure, defocus_px: float | None) -> Picture:
        """Return the light that reaches the sensor in one shot, before noise."""
        rows = [self._T_target_world @ np.array(poses) for poses in shot.row_poses]
        motion_px = self._paths_px(rows[len(rows) // 2])
        length_px = longest_path_px(motion_px)
        sigma = self.scenario.camera_defocus_px if defocus_px is None else defocus_px
        if length_px < STILL_EXPOSURE_PX and len(rows) == 1:
            rows = [round_pose(rows[0][len(rows[0]) // 2])[None]]
            motion_px, length_px = np.zeros((5, 1, 2)), 0.0
        picture = self._projected(rows, motion_px, length_px, sigma)
        if shot.row_brightness is None:
            return picture
        factor = np.broadcast_to(shot.row_brightness.astype(np.float32)[:, None], picture.shape)
        lit = cv2.multiply(picture, np.ascontiguousarray(factor), dtype=cv2.CV_8U)
        return np.asarray(lit, np.uint8)

    # --- through the lens ---

    def _projected(
        self, rows: list[Array], motion_px: Array, length_px: float, sigma_px: float
    ) -> Picture:
        """Return the image at the poses T_target_cam (n, 4, 4) of its rows."""
        count = blur_sample_count(length_px)
        by_row = [ray_to_plane_map(resample_poses(poses, count)) for poses in rows]
        maps = by_row[0] if len(rows) == 1 else np.stack(by_row, axis=1)
        middle = maps[count // 2]
        if count % 2 == 0:
            middle = (maps[count // 2 - 1] + middle) / 2.0
        nodes, misses = trace_rays(self._coarse, middle)
        views = [view for s in self._sheets if (view := s.view(nodes, length_px)) is not None]
        # The grids of rays are padded to this size.
        if any(view.covers_all for view in views):
            picture = np.zeros(self._pixels.xy.shape[:2], np.uint8)
        else:
            picture = self._background(nodes, misses, motion_px, length_px)
        for view in views:
            self._add_sheet(picture, view, maps)
        lens = math.sqrt(max(sigma_px**2 - SAMPLING_SIGMA_PX**2, 0.0))
        if lens > _PLAIN_PX:
            picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), lens), np.uint8)
        elif lens > 0.05 and views:
            defocus_blocks(picture, lens, union_box([view.box for view in views]))
        width, height = self.camera.size_px
        seen = picture[:height, :width]
        return np.asarray(cv2.multiply(seen, self._shade, seen, scale=1.0 / 255.0), np.uint8)

    def _background(
        self,
        nodes: NDArray[np.float32],
        misses: NDArray[np.bool_],
        motion_px: Array,
        length_px: float,
    ) -> Picture:
        """Draw the bare ceiling at reduced resolution."""
        rows, cols = nodes.shape[:2]
        mid = nodes[rows // 2, cols // 2]
        px_per_m = local_px_per_m(nodes, rows // 2, cols // 2, COARSE_PX)
        step = self._ceiling_px
        texture, texels_per_m = self._ceiling.tile_and_texels_per_m(px_per_m / step)
        # Shift by whole tiles to centre the view in the texture.
        tile = np.clip(np.round(mid / TILE_M), -1e3, 1e3) * TILE_M
        texels = nodes * np.float32(texels_per_m)
        texels += (_CENTER_TEXEL - tile * texels_per_m).astype(np.float32)
        crop = COARSE_PX // step
        wider = cv2.resize(texels, None, fx=crop, fy=crop)
        picture = sample_texture(texture, wider[crop:-crop, crop:-crop], cv2.BORDER_WRAP)
        if misses.any():
            mask = cv2.resize(
                misses[1:-1, 1:-1].astype(np.uint8),
                picture.shape[::-1],
                interpolation=cv2.INTER_NEAREST,
            )
            picture[mask > 0] = FLOOR_GREY
        kernel = motion_blur_kernel(motion_px / step)
        if length_px >= SHARP_MOTION_PX and kernel is not None:
            picture = np.asarray(cv2.filter2D(picture, -1, kernel), np.uint8)
        return np.asarray(cv2.resize(picture, None, fx=step, fy=step), np.uint8)

    def _add_sheet(self, picture: Picture, view: SheetView, maps: Array) -> None:
        pixels = self._pixels
        if maps.ndim > 3:  # with a rolling shutter, each row has its own map
            rows, cols = pixel_slices(view.box)
            xy = np.ascontiguousarray(pixels.xy[rows, cols])
            rays = RayGrid(xy, pixels.row_share[rows], pixels.boundary_xy)
            picture[rows, cols] = draw_sheet_over(picture[rows, cols], view, maps, rays)
            return
        blocks, is_paper = as_blocks(picture)[view.box], view.is_uniform & (view.alpha > 0)
        blocks[is_paper] = view.value[is_paper][:, None, None]
        if view.is_uniform.all():
            return
        below = blocks[~view.is_uniform]
        xy = as_blocks(pixels.xy)[view.box][~view.is_uniform].reshape(len(below), -1, 2)
        rays = RayGrid(xy, pixels.row_share, pixels.boundary_xy)
        covered = draw_sheet_over(below.reshape(len(below), -1), view, maps, rays)
        blocks[~view.is_uniform] = covered.reshape(below.shape)

    # --- motion ---

    def _paths_px(self, poses: Array) -> Array:
        """Return the path of the ceiling in the image during the exposure at five places, (5, n, 2)
        px, for poses (n, 4, 4)."""
        if len(poses) == 1:
            return np.zeros((5, 1, 2))
        points = ray_to_plane_map(poses[len(poses) // 2]).dot(self._places)
        points /= np.maximum(points[2], LEAST_RISE)
        points[2] = 0.0
        R, t = poses[:, :3, :3], poses[:, :3, 3:]
        cam = R.transpose(0, 2, 1) @ (points - t)  # (n, 3, 5)
        path = cam[:, :2] * (self._focal_px / np.maximum(cam[:, 2:], 1e-3))
        return np.asarray(path.transpose(2, 0, 1))

    def _noise_bank(self, sigma: float) -> tuple[NDArray[np.int16], list[tuple[int, int]]]:
        width, height = self.camera.size_px
        size = (height + _NOISE_ROOM_PX, width + _NOISE_ROOM_PX)
        rng = np.random.default_rng([self.seed, NOISE_STREAM])
        bank = np.rint(rng.standard_normal(size, np.float32) * np.float32(sigma))
        across = _NOISE_ROOM_PX + 1
        places = np.stack(np.divmod(rng.permutation(across**2), across), axis=1).tolist()
        return np.clip(bank, -255.0, 255.0).astype(np.int16), places


# --- Sums, lookups and shading of whole images ---


def as_blocks(pixels: NDArray[Any]) -> NDArray[Any]:
    """Return a view of an image (h, w, ...) as blocks (rows, columns, 8, 8, ...)."""
    height, width, *rest = pixels.shape
    shape = (height // COARSE_PX, COARSE_PX, width // COARSE_PX, COARSE_PX, *rest)
    return pixels.reshape(shape).swapaxes(1, 2)


def draw_sheet_over(below: Picture, view: SheetView, maps: Array, rays: RayGrid) -> Picture:
    """Draw the sheet over `below`; `maps` (n, 3, 3): rays to plane at moments of the exposure."""
    texels = [trace_rays(rays, view.to_texels @ each)[0] for each in maps]
    seen = mean_picture([sample_texture(view.texture.value, each) for each in texels])
    if view.covers_all:
        return seen
    alpha = mean_picture([sample_texture(view.texture.alpha, each) for each in texels])
    rest: Any = cv2.multiply(below, ~alpha, scale=1.0 / 255.0)
    return np.asarray(cv2.add(rest, seen), np.uint8)


def mean_picture(pictures: Sequence[Picture]) -> Picture:
    """Return the mean of the images, rounded once."""
    if len(pictures) == 1:
        return pictures[0]
    total: Any = pictures[0].astype(np.uint16)
    for picture in pictures[1:]:
        total = cv2.add(total, picture, dtype=cv2.CV_16U)
    return np.asarray(cv2.convertScaleAbs(total, alpha=1.0 / len(pictures)), np.uint8)


def sample_texture(texture: Picture, texels: Any, border: int = cv2.BORDER_CONSTANT) -> Picture:
    """Return the bilinear values at `texels` (h, w, 2) float32; outside, by OpenCV's `border`
    mode."""
    remap: Any = cv2.remap  # OpenCV's stub does not know that the second map may be None
    return np.asarray(remap(texture, texels, None, cv2.INTER_LINEAR, borderMode=border), np.uint8)


def defocus_blocks(picture: Picture, sigma_px: float, box: Box) -> None:
    """Blur a box of blocks in place with a Gaussian, with the margin that the blur reaches."""
    reach = math.ceil(3.0 * sigma_px) + 1
    near, far = pixel_slices(box, reach), pixel_slices(box, 2 * reach)
    blurred = cv2.GaussianBlur(picture[far], (0, 0), sigma_px)
    top, left = (a.start - b.start for a, b in zip(near, far, strict=True))
    into = picture[near]
    into[:] = blurred[top : top + into.shape[0], left : left + into.shape[1]]


# --- A camera that does not move ---
# If the image moves by less than `STILL_EXPOSURE_PX` within the exposure, the pose is rounded, so
# that a vehicle at rest sees the same image each time, apart from the noise.


STILL_EXPOSURE_PX = 0.005
POSE_STEP = 2.0**-17
"""Rounding steps of the directions, and of the position relative to the distance: below 0.01 px."""


def round_pose(T_target_cam: Array) -> Array:
    """A still camera's pose (4, 4), rounded to steps of `POSE_STEP`."""
    steps = np.full((3, 4), POSE_STEP)
    steps[:, 3] *= 2.0 ** np.floor(np.log2(max(abs(float(T_target_cam[2, 3])), 1e-3)))
    T = np.eye(4)
    T[:3] = np.rint(T_target_cam[:3] / steps) * steps
    return T


# --- Motion within one exposure: the number of poses needed, and the motion blur as a kernel ---


SHARP_MOTION_PX = 0.25
"""Motion during one exposure below which one pose is enough, px (its blur has a sigma of 0.07
px)."""
SAMPLE_SPACING_PX = 1.3
"""Distance between the poses that are averaged for motion blur, px: the resulting ripple is finer
than the pixels can resolve."""
MAX_SAMPLES = 16
MAX_KERNEL_REACH_PX = 12


def longest_path_px(motion_px: Array) -> float:
    """The length of the longest path of the points `motion_px` (points, times, 2)."""
    steps = motion_px[:, 1:] - motion_px[:, :-1]
    return float(np.sqrt((steps * steps).sum(axis=2)).sum(axis=1).max())


def blur_sample_count(length_px: float) -> int:
    """Return the number of poses needed for the motion blur of a path of `length_px`; 1 for a sharp
    frame."""
    if length_px < SHARP_MOTION_PX:
        return 1
    return min(max(math.ceil(length_px / SAMPLE_SPACING_PX), 2), MAX_SAMPLES)


def resample_poses(poses: Array, count: int) -> Array:
    """Return `count` poses (count, 4, 4) at the middles of equal parts of the exposure.

    The poses are interpolated linearly between the matrices `poses` (n, 4, 4): the rotation within
    an exposure is so small that the error is below 1e-3 of a pixel.
    """
    if len(poses) == 1:
        return np.broadcast_to(poses, (count, 4, 4))
    last = len(poses) - 1
    places = [(i + 0.5) / count * last for i in range(count)]
    low = [min(int(place), last - 1) for place in places]
    part = np.array([p - i for p, i in zip(places, low, strict=True)])[:, None, None]
    return np.asarray((1.0 - part) * poses[low] + part * poses[[i + 1 for i in low]])


def motion_blur_kernel(motion_px: Array) -> NDArray[np.float32] | None:
    """Return the blur kernel of the path at the image's centre; None if the path is too short."""
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


# --- Faults of an analogue video link: line jitter, hum bars, torn and lost lines ---


LINE_JITTER_PX = 1.2
HUM_GREY = 18.0
TEAR_PX = 30.0
TEARS_PER_FRAME = 1.5
SNOW_LINES_PER_FRAME = 12.0
"""Mean numbers of torn bands and of snow lines per frame at full strength."""


def add_analogue_faults(
    image: NDArray[np.uint8], strength: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Return the image as a receiver shows it; `strength` is 0 (clean) to 1 (about to be
    lost)."""
    height, width = image.shape
    shift = np.asarray(rng.standard_normal(height) * LINE_JITTER_PX * strength)
    for _ in range(rng.poisson(TEARS_PER_FRAME * strength)):
        start, length = int(rng.integers(height)), int(rng.integers(4, 40))
        # A torn band drifts back into place along its length, as the receiver's line lock recovers.
        band = slice(start, min(start + length, height))
        fade = np.linspace(1.0, 0.0, length)[: band.stop - band.start]
        shift[band] += rng.normal(0.0, TEAR_PX * strength) * fade
    cols, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height))
    cols = cols + shift[:, None].astype(np.float32)
    out = cv2.remap(
        image, cols, rows.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    ).astype(np.float32)
    phase, bars = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.7, 2.5)
    hum = np.sin(2.0 * np.pi * bars * np.arange(height) / height + phase)
    out += (HUM_GREY * strength * hum)[:, None].astype(np.float32)
    for _ in range(rng.poisson(SNOW_LINES_PER_FRAME * strength)):
        row, left = int(rng.integers(height)), int(rng.integers(width))
        length = int(min(rng.exponential(0.3 * width) + 1.0, width - float(left)))
        out[row, left : left + length] = rng.uniform(0.0, 255.0, size=length)
    return np.clip(np.rint(out), 0.0, 255.0).astype(np.uint8)
