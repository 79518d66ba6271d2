"""The look of every figure: colours, width, axes; figures are made without a display and Matplotlib's global state.

The colours are Okabe and Ito's palette, which readers with any colour vision can tell apart, also in grey print.
"""

from __future__ import annotations

import os
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

from outlap.errors import OutlapError
from outlap.files import replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BLUE, VERMILION = "#0072B2", "#D55E00"
# In an order that keeps neighbours apart.
COLOURS = (BLUE, VERMILION, "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")
WALL_GREY, INK = "#BDBDBD", "#222222"

WIDTH = 7.0  # [inch] of the figure: the text width of a page
TITLE_WIDTH = 90  # characters


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size [inch] that can be saved without a display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # the colours alone need no Matplotlib
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def entitle(figure: Figure, title: str) -> None:
    """Set the title of a figure, in as many lines as it needs."""
    figure.suptitle(textwrap.fill(title, TITLE_WIDTH), x=0.01, ha="left", fontsize=10, fontweight="bold")


def finish(figure: Figure, path: str | os.PathLike[str] | None = None) -> Figure:
    """Tidy the axes of a figure, and save it if there is a path."""
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(which="both", labelsize=7)
    if path is not None:
        save_figure(figure, path)
    return figure


def save_figure(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure beside its place and rename it. Raise OutlapError for an ending that Matplotlib cannot write."""
    ending = Path(path).suffix.lstrip(".").lower()
    if ending not in figure.canvas.get_supported_filetypes():
        raise OutlapError(f"{os.fspath(path)}: ending is {ending!r}; must be png, pdf or svg")
    with replacing(path) as partial:
        figure.savefig(partial, dpi=200)
