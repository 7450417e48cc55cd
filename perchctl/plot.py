"""What all of perchctl's plots share: palette, resolution, figure and file.

Figures are drawn without pyplot, so nothing is kept open and no display is asked for.
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from perchctl.files import write_files

# Okabe and Ito's palette: told apart with any colour vision.
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILLION, PURPLE, GREY = "#0072B2", "#D55E00", "#CC79A7", "#8C8C8C"
GRID = "#D8D8D8"
DPI = 110


def new_figure(width_in: float, height_in: float, dpi: float = DPI) -> Figure:
    """An empty figure whose panels do not overlap."""
    figure = Figure(figsize=(width_in, height_in), dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_png(figure: Figure, file: Path | BinaryIO) -> None:
    """Write the figure; a file is there whole or not at all. Raises InvalidValue."""
    content = BytesIO()
    figure.savefig(content, format="png", metadata={"Software": None})
    if isinstance(file, Path):
        write_files({file: content.getvalue()})
    else:
        file.write(content.getvalue())
