"""What came of each slice of a sequence: a table and a figure."""

import dataclasses as dc
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sliceit_drake.diagrams.outputs.figures import (
    BOARD_PHASE,
    CONTACT_THRESHOLD,
    SIMULATED,
    add_picture,
)
from sliceit_drake.diagrams.outputs.run_log import Record

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["SliceReport", "plot_sequence", "slice_reports"]


@dc.dataclass
class SliceReport:
    """One slice of a record.

    Attributes:
        start_s, end_s: From when the knife was ready for it until it was ready for the next.
        contact_s: Time in which the knife touched the food on its way down.
        peak_force_N: Largest norm of the food's force on the knife.
        mean_contact_force_N: Mean norm over `contact_s`.
        lower_quartile_N, median_N, upper_quartile_N: Of the norm over `contact_s`.
        board_peak_N: Largest norm of the board's force.
        work_of_cutting_J: Work of the knife on the food.
        section_area_mm2: Area of the cut.
        work_per_area_J_m2: Their ratio.
        cut_share: Fraction of the section that is cut.
        least_volume_ratio: Of any element.
    """

    start_s: float
    end_s: float
    contact_s: float
    peak_force_N: float
    mean_contact_force_N: float
    lower_quartile_N: float
    median_N: float
    upper_quartile_N: float
    board_peak_N: float
    work_of_cutting_J: float
    section_area_mm2: float
    work_per_area_J_m2: float
    cut_share: float
    least_volume_ratio: float


def _descents(record: Record) -> list[tuple[slice, np.ndarray]]:
    """Rows of each slice that was begun, and those of its way down in contact with the food."""
    index = record["food_index"]
    parts = []
    for k in np.unique(index):
        rows = np.flatnonzero(index == k)
        deepest = rows[0] + int(np.argmin(record["knife_pose_p_z"][rows]))
        force = np.linalg.norm(record.vector("food_wrench_f")[rows], axis=1)
        contact = rows[(force > CONTACT_THRESHOLD) & (rows <= deepest)]
        parts.append((slice(int(rows[0]), int(rows[-1]) + 1), contact))
    return parts


def slice_reports(record: Record, section_areas: Sequence[float]) -> list[SliceReport]:
    """The slices that the record holds, in order; the last may be unfinished.

    Args:
        record: The run.
        section_areas: Of all slices of the sequence, m^2.
    """
    time, work = record["time"], record["energy_work"]
    food = np.linalg.norm(record.vector("food_wrench_f"), axis=1)
    board = np.linalg.norm(record.vector("board_wrench_f"), axis=1)
    reports = []
    for k, (rows, contact) in enumerate(_descents(record)):
        before = float(work[rows.start - 1]) if rows.start > 0 else 0.0
        done = float(work[rows.stop - 1]) - before
        area = section_areas[k]
        forces = food[contact] if len(contact) else np.zeros(1)
        quartiles = np.percentile(forces, (25.0, 50.0, 75.0))
        reports.append(
            SliceReport(
                start_s=float(time[rows.start]),
                end_s=float(time[rows.stop - 1]),
                contact_s=float(time[contact[-1]] - time[contact[0]]) if len(contact) else 0.0,
                peak_force_N=float(food[rows].max()),
                mean_contact_force_N=float(forces.mean()),
                lower_quartile_N=float(quartiles[0]),
                median_N=float(quartiles[1]),
                upper_quartile_N=float(quartiles[2]),
                board_peak_N=float(board[rows].max()),
                work_of_cutting_J=done,
                section_area_mm2=1e6 * area,
                work_per_area_J_m2=done / area,
                cut_share=float(record["cut_progress"][rows].max()),
                least_volume_ratio=float(record["energy_least_volume_ratio"][rows].min()),
            )
        )
    return reports


def plot_sequence(
    record: Record,
    section_areas: Sequence[float],
    title: str,
    board_height: float,
    caption: str,
    picture: np.ndarray | None = None,
) -> "Figure":
    """Draws the force over time, over the edge's height slice by slice, and its spread by slice.

    Args:
        record: The run.
        section_areas: Of all slices of the sequence, m^2.
        title: What is shown.
        board_height: World height of the board's top, metres.
        caption: Conditions and provenance, below the plots.
        picture: Knife and food at some instant [H, W, 3]; None to leave that panel out.
    """
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    time = record["time"]
    food = np.linalg.norm(record.vector("food_wrench_f"), axis=1)
    board = np.linalg.norm(record.vector("board_wrench_f"), axis=1)
    height = 1e3 * (record["knife_pose_p_z"] - board_height)
    parts = _descents(record)
    reports = slice_reports(record, section_areas)

    figure = Figure(figsize=(12.0, 7.0), layout="constrained")
    rows = figure.add_gridspec(2, 1, height_ratios=[1.0, 1.15])
    over_time = figure.add_subplot(rows[0])
    widths = [1.0, 1.2] if picture is None else [0.8, 1.0, 1.2]
    below = rows[1].subgridspec(1, len(widths), width_ratios=widths)
    over_height, by_slice = figure.add_subplot(below[-2]), figure.add_subplot(below[-1])
    if picture is not None:
        add_picture(figure, below[0], picture)

    over_time.plot(time, board, color=BOARD_PHASE, lw=0.9, label="of the board")
    over_time.plot(time, food, color=SIMULATED, lw=1.1, label="of the food")
    for k, (report, (span, _)) in enumerate(zip(reports, parts, strict=True)):
        peak = span.start + int(np.argmax(food[span]))
        over_time.plot(time[peak], food[peak], "v", color="0.15", ms=4)
        if k % 2 == 1:
            over_time.axvspan(report.start_s, report.end_s, color="0.94", lw=0, zorder=0)
    over_time.plot([], [], "v", color="0.15", ms=4, label="peak of the food in each slice")
    over_time.set_xlim(time[0], time[-1])
    over_time.set_xlabel("time [s]")
    over_time.set_ylabel("norm of the force\non the knife [N]")
    over_time.set_title(title, loc="left", fontsize=11)
    over_time.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False)

    colours = colormaps["viridis"](np.linspace(0.0, 0.9, len(parts)))
    for k, ((_, contact), colour) in enumerate(zip(parts, colours, strict=True)):
        label = f"slice {k + 1}" if k in (0, len(parts) - 1) else None
        over_height.plot(height[contact], food[contact], color=colour, lw=1.0, label=label)
    over_height.invert_xaxis()
    over_height.set_xlabel("height of the edge over the board [mm]")
    over_height.set_ylabel("food's force [N]")
    over_height.set_title("each slice on the way down", loc="left", fontsize=11)
    over_height.legend(frameon=False, fontsize=8.5)

    boxes = by_slice.boxplot(
        [food[contact] for _, contact in parts],
        whis=(0.0, 100.0),
        widths=0.6,
        patch_artist=True,
        medianprops={"color": "0.1"},
    )
    for box, colour in zip(boxes["boxes"], colours, strict=True):
        box.set(facecolor=(*colour[:3], 0.55), edgecolor="0.3")
    by_slice.set_xlabel("slice")
    by_slice.set_title("its spread: quartiles, least and peak", loc="left", fontsize=11)
    by_slice.set_ylim(over_height.get_ylim())
    for axes in (over_time, over_height, by_slice):
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    figure.supxlabel(caption, fontsize=7.5, color="0.35", wrap=True)
    return figure
