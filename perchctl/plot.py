"""Common parts of all plots: palette, resolution, figure and file.

Figures are drawn without pyplot, so that no figure stays open and no display is needed.
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from perchctl.files import check_output, write_files

# Okabe and Ito's palette, which can be distinguished with any colour vision.
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILLION, PURPLE, GREY = "#0072B2", "#D55E00", "#CC79A7", "#8C8C8C"
GRID = "#D8D8D8"
DPI = 110
_METADATA: dict[str, dict[str, None]] = {  # leave out metadata that changes from run to run
    ".png": {"Software": None},
    ".pdf": {"CreationDate": None},
    ".svg": {"Date": None},
}
FORMATS = tuple(_METADATA)
"""Permitted suffixes of a plot's file name."""


def new_figure(width_in: float, height_in: float, dpi: float = DPI) -> Figure:
    """An empty figure whose panels do not overlap."""
    figure = Figure(figsize=(width_in, height_in), dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write the figure atomically in the format given by the file name's suffix (`FORMATS`). The
    same figure gives the same bytes. Raises InvalidValue."""
    check_output(path, FORMATS, force=True, content="a plot", makes_folder=True)
    write_files({path: figure_bytes(figure, path.suffix.lower())})


def figure_bytes(figure: Figure, suffix: str = ".png") -> bytes:
    """The figure in one of `FORMATS`, the same bytes for the same figure."""
    content = BytesIO()
    with rc_context({"svg.hashsalt": "perchctl"}):
        # Fix the layout first, because the last bits of the solver's result differ from call to
        # call.
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
        for ax in figure.axes:
            left, bottom, width, height = ax.get_position(original=True).bounds
            ax.set_position((round(left, 6), round(bottom, 6), round(width, 6), round(height, 6)))
        figure.savefig(content, format=suffix.removeprefix("."), metadata=_METADATA[suffix])
    return content.getvalue()
