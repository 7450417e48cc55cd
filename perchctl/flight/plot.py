"""The heat map of two swept keys: success and miss of each pair of values."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.patches import Rectangle

from perchctl.flight.sweep import Figures, Swept
from perchctl.plot import BLACK, VERMILLION, new_figure, save_png

_CELL_IN, _MARGIN_IN = 0.75, 1.6


def plot_sweep(found: Swept, png_path: Path) -> None:
    """Draw it into a PNG; the profile's own values have a frame, where they are on the map.
    Raises InvalidValue for a file that cannot be written."""
    rows, columns = (len(texts) for texts in found.grid.texts)
    figure = new_figure(
        2 * (_MARGIN_IN + _CELL_IN * columns), _MARGIN_IN + max(1.5, 0.6 * _CELL_IN * rows)
    )
    left, right = figure.subplots(1, 2)
    _panel(left, found, "success [%]", _percent, "Blues", "{:.0f}")
    _panel(right, found, "median miss [mm]", _miss_mm, "Oranges", "{:.1f}")
    flights = found.figures[0].flights
    figure.suptitle(f"{flights} seeds a cell; framed: the profile's own", fontsize=9)
    save_png(figure, png_path)


def _percent(figures: Figures) -> float:
    return 100.0 * figures.good / figures.flights if figures.flights else np.nan


def _miss_mm(figures: Figures) -> float:
    return np.nan if figures.median_m is None else 1e3 * figures.median_m


def _panel(
    axes: Any, found: Swept, title: str, of: Callable[[Figures], float], colours: str, form: str
) -> None:
    grid = found.grid
    rows, columns = (len(texts) for texts in grid.texts)
    values = np.array([of(figures) for figures in found.figures[: rows * columns]])
    axes.imshow(values.reshape(rows, columns), cmap=colours, alpha=0.6, aspect="auto")
    for number, value in enumerate(values):
        row, column = divmod(number, columns)
        text = "-" if np.isnan(value) else form.format(value)
        axes.text(column, row, text, ha="center", va="center", fontsize=8, color=BLACK)
    if grid.own < rows * columns:
        row, column = divmod(grid.own, columns)
        axes.add_patch(
            Rectangle((column - 0.5, row - 0.5), 1, 1, fill=False, edgecolor=VERMILLION, lw=2)
        )
    axes.set_title(title, fontsize=9)
    axes.set_yticks(range(rows), grid.texts[0], fontsize=8)
    axes.set_xticks(range(columns), grid.texts[1], fontsize=8)
    axes.set_ylabel(grid.keys[0], fontsize=8)
    axes.set_xlabel(grid.keys[1], fontsize=8)
    axes.tick_params(length=0)
