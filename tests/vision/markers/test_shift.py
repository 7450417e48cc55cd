from __future__ import annotations

import numpy as np
import pytest

from perchctl.geometry import Array
from perchctl.vision.markers.corners import UNIT, Border, edge_shift, known_from
from perchctl.vision.types import EdgeShift

CELLS, CELL_PX = 6, 20.0
HALF = 0.5 * CELLS * CELL_PX
PRIOR_PX = 0.4


def border(shift_px: float, n: int = 24, blur_px: float = 1.0, spread_px: float = 0.0) -> Border:
    """A marker's border, its corners in px, after white has grown over black: the outer
    edges moved in, the inner ones out."""
    inner = HALF - CELL_PX + shift_px
    ends = inner * np.stack([UNIT, np.roll(UNIT, -1, axis=0)], axis=1)
    along = np.linspace(0.1, 0.9, n)[None, :, None]
    points: Array = ends[:, :1] * (1.0 - along) + ends[:, 1:] * along
    points = points + np.random.default_rng(1).normal(0.0, 1.0, points.shape) * spread_px
    return Border(
        corners=(HALF - shift_px) * UNIT,
        points=points,
        weight=np.ones((4, n)),
        blur_px=np.full(4, blur_px),
        depth_px=np.full(4, CELL_PX),
        cells=CELLS,
        cell_px=CELL_PX,
        tolerance=0.0,
    )


@pytest.mark.parametrize("shift_px", [-0.2, 0.0, 0.1, 0.3])
def test_the_width_of_the_border_gives_the_shift(shift_px: float) -> None:
    found = edge_shift(border(shift_px), PRIOR_PX)
    assert found.shift_px == pytest.approx(shift_px, abs=0.02)
    assert found.sigma_px < 0.03
    assert found.age == 0


def test_scatter_makes_it_less_certain() -> None:
    sharp, rough = (edge_shift(border(0.2, spread_px=s), PRIOR_PX) for s in (0.05, 0.4))
    assert sharp.sigma_px < rough.sigma_px < PRIOR_PX


@pytest.mark.parametrize("useless", [border(0.2, n=2), border(0.2, blur_px=0.6 * CELL_PX)])
def test_without_inner_edges_only_the_prior_is_left(useless: Border) -> None:
    found = edge_shift(useless, PRIOR_PX)
    assert (found.shift_px, found.sigma_px) == (0.0, PRIOR_PX)


def test_a_shift_holds_for_five_pictures() -> None:
    shift: EdgeShift | None = EdgeShift(0.2, 0.01)
    ages = []
    while shift is not None:
        ages.append(shift.age)
        shift = known_from(shift)
    assert ages == [0, 1, 2, 3, 4]
    assert known_from(None) is None
