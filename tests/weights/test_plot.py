"""The axes of the picture of a fit."""

from __future__ import annotations

import pytest

from perchctl.plot import new_figure
from perchctl.weights.plot import _plain_ticks


@pytest.mark.parametrize(
    "shown",
    [(0.6, 1.1), (0.8, 2.3), (0.45, 1.4), (0.3, 6.0), (0.009, 2.0), (1, 40), (1, 72_000), (1, 3e6)],
)
def test_a_logarithmic_axis_has_a_few_plain_numbers(shown: tuple[float, float]) -> None:
    ax = new_figure(3.0, 2.5).subplots()
    ax.set_yscale("log")
    ax.set_ylim(shown)
    _plain_ticks(ax.yaxis, shown)
    ax.figure.canvas.draw()
    inside = [
        tick.label1.get_text()
        for tick in (*ax.yaxis.get_major_ticks(), *ax.yaxis.get_minor_ticks())
        if shown[0] <= tick.get_loc() <= shown[1]
    ]
    assert 2 <= len(inside) <= 8
    assert [f"{float(text):.10g}" for text in inside] == inside  # no powers of ten
