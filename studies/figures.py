"""How figures of the studies are made, styled and saved."""

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

__all__ = ["BLUE", "GREEN", "ORANGE", "PURPLE", "RED", "new_figure", "save_figure", "tidy"]

BLUE, ORANGE, GREEN, RED, PURPLE = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7"
"""Colours of Okabe and Ito, which the colour-blind can tell apart."""


def new_figure(width: float, height: float) -> Figure:
    """An empty figure that needs no display.

    Args:
        width, height: Inches.
    """
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def tidy(axes: Axes, title: str = "") -> None:
    """A light grid, no frame above and to the right, and a title to the left."""
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    if title:
        axes.set_title(title, loc="left", fontsize=11)


def save_figure(figure: Figure, file: Path, dpi: int = 130) -> None:
    """Writes a figure, and says so; its folder is made."""
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=dpi)
    print(f"wrote {file}")
