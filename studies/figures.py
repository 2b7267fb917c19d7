"""How figures of the studies are made, styled and saved."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

__all__ = [
    "BLUE",
    "GREEN",
    "ORANGE",
    "PURPLE",
    "RED",
    "add_figure_argument",
    "draw_boxes",
    "new_figure",
    "save_figure",
    "save_guide_figures",
    "tidy",
]

GUIDE_FIGURES = Path(__file__).resolve().parents[1] / "docs" / "figures"

BLUE, ORANGE, GREEN, RED, PURPLE = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7"
"""Colours of Okabe and Ito, which the colour-blind can tell apart."""


def add_figure_argument(parser: argparse.ArgumentParser, name: str) -> None:
    """Adds --output, the picture of a guide, by default docs/figures/NAME.png."""
    file = Path("docs/figures") / f"{name}.png"
    parser.add_argument(
        "--output", metavar="FILE", type=Path, default=file, help=f"figure; default {file}"
    )


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


def draw_boxes(
    axes: Axes,
    boxes: Mapping[str, tuple[str, tuple[float, float]]],
    arrows: Sequence[tuple[str, str, str]],
    colours: Mapping[str, str] | None = None,
) -> None:
    """Draws a diagram of boxes and arrows.

    Args:
        axes: With its limits set; its frame is taken away.
        boxes: Text of each box by name, and where its middle is.
        arrows: From a box to a box, by name, and what stands beside the arrow. Two arrows between
            the same boxes stand side by side.
        colours: Of boxes that are not light blue, by name.
    """
    axes.axis("off")
    style = {"boxstyle": "round,pad=0.6", "edgecolor": BLUE}
    drawn = {}
    for name, (words, (x, y)) in boxes.items():
        box = style | {"facecolor": (colours or {}).get(name, "#eef3f8")}
        drawn[name] = axes.text(x, y, words, ha="center", va="center", fontsize=10, bbox=box)
    pairs = {(begin, end) for begin, end, _ in arrows}
    for begin, end, words in arrows:
        (ax, ay), (bx, by) = boxes[begin][1], boxes[end][1]
        shift = 0.0
        if (end, begin) in pairs:
            shift = 0.02 if (begin, end) < (end, begin) else -0.02
        upright = ax == bx
        sideways = (shift, 0.0) if upright else (0.0, shift)
        ax, bx, ay, by = (
            ax + sideways[0],
            bx + sideways[0],
            ay + sideways[1],
            by + sideways[1],
        )
        arrow = {
            "arrowstyle": "-|>",
            "color": "0.35",
            "patchA": drawn[begin].get_bbox_patch(),
            "patchB": drawn[end].get_bbox_patch(),
        }
        axes.annotate("", xy=(bx, by), xytext=(ax, ay), arrowprops=arrow)
        x, y = (ax + bx) / 2.0, (ay + by) / 2.0
        side = -1.0 if shift < 0.0 else 1.0
        if upright:
            align = "left" if side > 0.0 else "right"
            axes.text(x + 0.01 * side, y, words, ha=align, va="center", fontsize=8)
        else:
            axes.text(x, y + 0.1 * side, words, ha="center", va="center", fontsize=8)


def save_figure(figure: Figure, file: Path, dpi: int = 130) -> None:
    """Writes a figure, and says so; its folder is made."""
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=dpi)
    print(f"wrote {file}")


def save_guide_figures(figures: Mapping[str, Callable[[], Figure]]) -> None:
    """Draws pictures of the guides by name, and writes them into the documentation."""
    for name, draw in figures.items():
        save_figure(draw(), GUIDE_FIGURES / f"{name}.png", dpi=100)
