"""What a camera's lens makes of its pixels, for all pictures and all flights alike; pure."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from perchctl.geometry import Array
from perchctl.sim.pixels import vignetting
from perchctl.sim.rays import COARSE_PX, FINE_PX, RayGrid, ray_grid
from perchctl.sim.surfaces import Picture
from perchctl.sim.tiles import TileRays, tile_rays
from perchctl.vision import CameraModel


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
