"""Sheets on the ceiling, and where each is seen in one exposure."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array, invert_T, make_T, rot_z
from perchctl.profile import TargetConfig
from perchctl.sim.rays import COARSE_PX, local_px_per_m
from perchctl.sim.scenario import Neighbour
from perchctl.sim.surfaces import Sheet, SheetTexture
from perchctl.sim.tiles import Box, Tiles, box_of, reach_of, tiles_of
from perchctl.target import draw_target


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
