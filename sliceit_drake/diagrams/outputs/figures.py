"""Figures of a run."""

from typing import TYPE_CHECKING, Any

import numpy as np

from sliceit_drake.diagrams.outputs.measurement_comparison import Comparison
from sliceit_drake.diagrams.outputs.run_log import Record

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["BOARD_PHASE", "CONTACT_THRESHOLD", "SIMULATED", "add_picture", "plot_force"]

# Okabe and Ito's palette: distinct for colour-blind readers and in grey.
SIMULATED = "#0072B2"
NORM = "#56B4E9"
MEASURED = "#000000"
FOOD_PHASE = "#009E73"
BOARD_PHASE = "#E69F00"
CONTACT_THRESHOLD = 0.05
"""Force from which knife and food, or knife and board, count as touching, N."""


def add_picture(figure: "Figure", place: Any, picture: np.ndarray) -> None:
    """Shows the middle of a picture [H, W, 3] at a place in the grid of a figure."""
    axes = figure.add_subplot(place)
    margin = (picture.shape[1] - picture.shape[0]) // 2
    axes.imshow(picture[:, margin : picture.shape[1] - margin])
    axes.set_axis_off()


def plot_force(
    record: Record,
    title: str,
    top_height: float,
    comparison: Comparison | None,
    caption: str,
    picture: np.ndarray | None = None,
) -> "Figure":
    """Draws the knife in the food, and its force over time and over depth.

    Args:
        record: The run.
        title: What is shown.
        top_height: World height of the food's top at the cut, metres.
        comparison: Measured profile with its fitted offset, or None.
        caption: Conditions and provenance, below the plots.
        picture: Knife and food at some instant [H, W, 3]; None to leave that panel out.
    """
    from matplotlib.figure import Figure

    time = record["time"]
    food, board = record.vector("food_wrench_f"), record.vector("board_wrench_f")
    total = food + board
    norm = np.linalg.norm(total, axis=1)
    depth = 1e3 * (top_height - record["knife_pose_p_z"])

    figure = Figure(figsize=(9.0 if picture is None else 12.0, 4.6), layout="constrained")
    widths = [1.5, 1.0] if picture is None else [1.0, 1.5, 1.0]
    grid = figure.add_gridspec(1, len(widths), width_ratios=widths)
    over_time = figure.add_subplot(grid[-2])
    over_depth = figure.add_subplot(grid[-1], sharey=over_time)
    over_depth.tick_params(labelleft=False)
    if picture is not None:
        add_picture(figure, grid[0], picture)
    for axes, x in ((over_time, time), (over_depth, depth)):
        axes.plot(x, norm, color=NORM, lw=3.2, label="simulated norm")
        axes.plot(x, total[:, 2], color=SIMULATED, lw=1.2, label="simulated vertical")
        axes.axhline(0.0, color="0.8", lw=0.8, zorder=0)
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    for forces, colour, label in ((food, FOOD_PHASE, "food"), (board, BOARD_PHASE, "board")):
        touching = np.linalg.norm(forces, axis=1) > CONTACT_THRESHOLD
        over_time.fill_between(
            time,
            0.0,
            1.0,
            where=touching,
            transform=over_time.get_xaxis_transform(),
            color=colour,
            alpha=0.14,
            lw=0,
            label=f"contact with {label}",
        )
    if comparison is not None:
        first_contact = time[int(np.argmax(depth > 0.0))]
        measured_time = first_contact + comparison.time_since_contact
        label = "measured (SliceIt! UR5e)"
        style: dict[str, Any] = {"color": MEASURED, "lw": 1.3, "ls": (0, (4, 1.5)), "label": label}
        over_time.plot(measured_time, comparison.measured, **style)
        over_depth.plot(1e3 * comparison.depth, comparison.measured, **style)
    end = max(float(depth.max()), 1.0)
    over_depth.set_xlim(-0.12 * end, 1.05 * end)
    over_time.set_xlim(time[0], max(time[-1], time[0] + 1e-3))
    over_time.set_xlabel("time [s]")
    over_depth.set_xlabel("depth of the edge below the food's top [mm]")
    over_time.set_ylabel("force on the knife [N]")
    over_time.margins(y=0.08)
    handles, labels = over_time.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=len(labels), frameon=False, fontsize=8.5
    )
    over_time.set_title(title, loc="left", fontsize=11)
    over_depth.set_title("the same over depth", loc="left", fontsize=11)
    figure.supxlabel(caption, fontsize=7.5, color="0.35", wrap=True)
    return figure
