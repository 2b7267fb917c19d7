"""Draws more pictures of the guides: words, files and states.

Writes glossary.png, formats.png, hardware.png, scaling.png, paraview.png and next_experiment.png to
docs/figures. Two of them show a slice that is simulated for them.
"""

import argparse
import tempfile
from pathlib import Path

import meshio
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from sliceit_drake.cutting.motion import Motion, Pose
from sliceit_drake.diagnosis.experiments.designs import Scale, menu
from sliceit_drake.diagrams.outputs.paraview import FoodFrames, write_series
from sliceit_drake.diagrams.run import prepare_run, simulate
from sliceit_drake.diagrams.scenario import load_scenario
from studies.figures import (
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    RED,
    draw_boxes,
    new_figure,
    save_guide_figures,
    tidy,
)

__all__ = [
    "add_arguments",
    "formats_figure",
    "glossary_figure",
    "hardware_figure",
    "next_experiment_figure",
    "paraview_figure",
    "run",
    "scaling_figure",
]

FLESH, STEEL, WOOD, UNCUT = "#cfe3b4", "0.7", "#e2c79c", "#8e4585"
STOPPED = "#fbe3d6"
STATES = {
    "start": ("at the start\n(--move-to-start:\ntype move)", (0.08, 0.8)),
    "touch": ("board found\n(--touch:\ntype touch)", (0.26, 0.8)),
    "checks": ("checks of robot,\nplan and start", (0.44, 0.8)),
    "word": ("plan is shown,\nwaits for the word\n(type slice)", (0.64, 0.8)),
    "run": ("runs: every target\npasses the limits", (0.85, 0.8)),
    "end": ("record written,\nprogram stopped", (1.06, 0.8)),
    "nothing": ("ends, nothing\nis sent", (0.54, 0.2)),
    "brakes": ("brakes along the\nmotion and holds", (0.76, 0.2)),
    "silent": ("sends nothing\nany more", (0.96, 0.2)),
}
CHANGES = [
    ("start", "touch", ""),
    ("touch", "checks", ""),
    ("checks", "word", ""),
    ("word", "run", ""),
    ("run", "end", ""),
    ("checks", "nothing", ""),
    ("word", "nothing", ""),
    ("run", "brakes", ""),
    ("run", "silent", ""),
]
REASONS = {
    "a check fails": (0.42, 0.48),
    "another word": (0.655, 0.48),
    "a limit would\nbe broken": (0.86, 0.42),
    "fault of link,\nprogram or safety": (0.99, 0.5),
}
MACHINES = {
    "a": ("sliceit calibrate\n--seed 1", (0.12, 0.85)),
    "b": ("sliceit calibrate\n--seed 2", (0.12, 0.5)),
    "c": ("sliceit calibrate\n--seed 3", (0.12, 0.15)),
    "storage": ("--storage:\nPostgreSQL, or a\njournal file", (0.36, 0.5)),
    "command": ("sliceit diagnose\n--backend dask", (0.62, 0.5)),
    "scheduler": ("dask scheduler", (0.8, 0.5)),
    "d": ("dask worker", (0.97, 0.85)),
    "e": ("dask worker", (0.97, 0.5)),
    "f": ("dask worker", (0.97, 0.15)),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """It has none."""


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    save_guide_figures(
        {
            "glossary": glossary_figure,
            "formats": formats_figure,
            "hardware": hardware_figure,
            "scaling": scaling_figure,
            "paraview": paraview_figure,
            "next_experiment": next_experiment_figure,
        }
    )
    return 0


def glossary_figure() -> Figure:
    """A cut in two sections, with the names of its parts."""
    figure = new_figure(9.6, 4.4)
    along, across = figure.subplots(1, 2)
    for axes in (along, across):
        axes.set(xlim=(-31, 31), ylim=(-5, 43), aspect="equal")
        axes.axis("off")
        axes.add_patch(Rectangle((-31, -4), 62, 4, facecolor=WOOD))
    # In the cut plane: what is above the edge is cut.
    along.set_title("in the cut plane", fontsize=11)
    along.add_patch(Circle((0, 13.5), 13.5, facecolor=FLESH, edgecolor=GREEN, lw=1.5))
    intact = Circle((0, 13.5), 13.5, facecolor=UNCUT, alpha=0.55)
    along.add_patch(intact)
    intact.set_clip_path(Rectangle((-31, 0), 62, 12, transform=along.transData))
    along.add_patch(Rectangle((-27, 12), 54, 24, facecolor=STEEL, edgecolor="0.4", alpha=0.75))
    along.plot([-27, 27], [12, 12], color=RED, lw=2.5)
    _axes_of(along, (0, 12), "K", ("x", (1, 0)), ("z", (0, -1)))
    _name(along, "knife (blade)", (12, 32), (15, 40))
    _name(along, "edge", (22, 12), (26, 5))
    _name(along, "cut surface, cut", (-5, 20), (-17, 39))
    _name(along, "cut surface,\nintact", (-5, 6), (-22, 3))
    along.annotate("", (7, 12), (7, 27), arrowprops={"arrowstyle": "<->", "color": "k"})
    along.text(-0.3, 17, "edge\ndepth", fontsize=8)
    along.text(-9, -3, "board", fontsize=8)
    # Across it.
    across.set_title("across the cut plane", fontsize=11)
    across.add_patch(Polygon([(0.3, 0), (0.3, 12), (1.5, 27), (26, 27), (26, 0)], facecolor=FLESH))
    across.add_patch(
        Polygon([(-0.3, 0), (-0.3, 12), (-2.5, 27), (-10, 26), (-8, 0)], facecolor=FLESH)
    )
    across.plot([0, 0], [0, 12], color=UNCUT, lw=3)
    across.add_patch(
        Polygon([(0, 12), (-1.1, 24), (-1.1, 40), (1.1, 40), (1.1, 24)], facecolor=STEEL, ec="0.4")
    )
    across.add_patch(Rectangle((22, 0), 9, 31, facecolor="0.85", edgecolor="0.5", hatch="//"))
    across.plot([0], [12], marker="o", color=RED, ms=5)
    for y in np.linspace(1.5, 11, 6):
        across.plot([0], [y], ".", color="k", ms=3)
    _axes_of(across, (0, 0), "F", ("y", (1, 0)), ("z", (0, 1)))
    _name(across, "flanks press\nand rub", (-1.0, 22), (-19, 33))
    _name(across, "flanks", (1.0, 22), (10, 38))
    _name(across, "edge does work\nper area", (0, 12), (-20, 14))
    _name(across, "slice\n(free side)", (-6, 22), (-24, 22))
    _name(across, "cut points", (0, 9.1), (-19, 6))
    across.text(9, 18, "food\n(held side)", fontsize=8, ha="center")
    across.text(26.5, 33, "holder", fontsize=8, ha="center")
    across.text(-14, -3, "board", fontsize=8)
    return figure


def _name(axes: Axes, words: str, at: tuple[float, float], beside: tuple[float, float]) -> None:
    """A name and a line from it to what it names."""
    line = {"arrowstyle": "-", "color": "0.3", "lw": 0.8}
    axes.annotate(words, at, beside, fontsize=8, ha="center", va="center", arrowprops=line)


def _axes_of(
    axes: Axes,
    origin: tuple[float, float],
    frame: str,
    *directions: tuple[str, tuple[float, float]],
) -> None:
    """The axes of a frame that lie in the picture."""
    x, y = origin
    axes.text(x - 1.8, y - 1.8, frame, fontsize=10, weight="bold", ha="center", va="center")
    for (letter, (u, v)), colour in zip(directions, (RED, BLUE), strict=True):
        arrow = {"arrowstyle": "-|>", "color": colour, "lw": 1.5}
        axes.annotate("", (x + 6.0 * u, y + 6.0 * v), origin, arrowprops=arrow)
        axes.text(x + 7.6 * u + 1.0, y + 7.6 * v + 1.0, letter, color=colour, fontsize=8)


def formats_figure() -> Figure:
    """Columns of the record of a run, by what they are."""
    record = simulate("cucumber_measured", replay=False).record()
    time = record["time"]
    panels = {
        "height of the edge over W [mm]": (
            1e3,
            ("knife_pose_p_z", "commanded_pose_p_z", "target_pose_p_z"),
        ),
        "force, vertical [N]": (1.0, ("food_wrench_f_z", "board_wrench_f_z", "sensor_wrench_f_z")),
        "joint position, from its start [rad]": (1.0, ("q_1", "q_2", "q_3")),
        "fraction of the section": (1.0, ("cut_progress",)),
    }
    figure = new_figure(9.6, 5.0)
    for axes, (label, (factor, columns)) in zip(
        figure.subplots(2, 2, sharex=True).ravel(), panels.items(), strict=True
    ):
        for column, colour in zip(columns, (BLUE, ORANGE, GREEN), strict=False):
            values = record[column] - (record[column][0] if "q_" in column else 0.0)
            axes.plot(time, factor * values, color=colour, label=column, lw=1.3)
        axes.set_ylabel(label, fontsize=9)
        axes.legend(fontsize=7.5, frameon=False)
        tidy(axes)
    for axes in figure.axes[2:]:
        axes.set_xlabel("time [s]")
    return figure


def hardware_figure() -> Figure:
    """States of a run on a robot, and what leads from one to the next."""
    figure = new_figure(11.0, 3.8)
    axes = figure.subplots()
    axes.set(xlim=(0.0, 1.14), ylim=(0.0, 1.0))
    draw_boxes(axes, STATES, CHANGES, {name: STOPPED for name in ("nothing", "brakes", "silent")})
    for words, (x, y) in REASONS.items():
        axes.text(x, y, words, fontsize=8, ha="center", va="center")
    axes.text(0.86, 0.03, "latched: only a new run goes on", ha="center", fontsize=9, color=RED)
    return figure


def scaling_figure() -> Figure:
    """Which processes share the work of a search, and of a diagnosis."""
    figure = new_figure(10.0, 3.2)
    axes = figure.subplots()
    axes.set(xlim=(0.0, 1.06), ylim=(0.0, 1.1))
    draw_boxes(
        axes,
        MACHINES,
        [(each, "storage", "") for each in "abc"]
        + [("storage", each, "") for each in "abc"]
        + [("command", "scheduler", "")]
        + [("scheduler", "command", "")]
        + [("scheduler", each, "") for each in "def"]
        + [(each, "scheduler", "") for each in "def"],
        {"storage": "#f6e3c5", "scheduler": "#f6e3c5"},
    )
    axes.text(0.36, 0.2, "trials, there and back", fontsize=8, ha="center")
    axes.text(0.75, 0.2, "slices there, results back", fontsize=8, ha="center")
    axes.text(0.24, 1.05, "a search", fontsize=11, ha="center")
    axes.text(0.8, 1.05, "a diagnosis, a recording, a study", fontsize=11, ha="center")
    return figure


def paraview_figure() -> Figure:
    """A frame of a series in the middle of a cut: the held half and its cut face by damage."""
    run = prepare_run(load_scenario("cucumber_measured", {"food.held_sides": "plus"}))
    frames = FoodFrames(run, 30.0)
    run.advance(0.95)
    with tempfile.TemporaryDirectory() as folder:
        write_series(frames, Path(folder))
        *_, last = sorted(Path(folder).rglob("food*.vtu"))
        mesh = meshio.read(last)
    figure = new_figure(9.0, 3.8)
    corners = mesh.points
    cells = next(block.data for block in mesh.cells if block.type == "tetra")
    # The end at the cut alone.
    middle = corners[mesh.point_data["damage"] > 0.5].mean(axis=0)
    near = np.linalg.norm(corners[cells] - middle, axis=2).max(axis=1) < 0.03
    for k, (values, label, colours, factor) in enumerate(
        (
            (mesh.point_data["damage"], "damage", "plasma", 1.0),
            (
                np.linalg.norm(mesh.point_data["displacement"], axis=1),
                "displacement [mm]",
                "viridis",
                1e3,
            ),
        )
    ):
        axes = figure.add_subplot(1, 2, k + 1, projection="3d", proj_type="ortho")
        axes.view_init(elev=20.0, azim=120.0 - 180.0 * k)
        half = cells[near & (mesh.point_data["side"][cells].max(axis=1) == k)]
        faces = np.concatenate([half[:, [a, b, c]] for a, b, c in _FACES])
        _, first, count = np.unique(
            np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
        )
        outside = faces[first[count == 1]]
        mean = factor * values[outside].mean(axis=1)
        top = max(1e-9, mean.max())
        surface = Poly3DCollection(1e3 * corners[outside], cmap=colours, lw=0.1, edgecolor="0.5")
        surface.set_array(mean)
        surface.set_clim(0.0, top)
        axes.add_collection3d(surface)
        low, high = 1e3 * corners[half].min(axis=(0, 1)), 1e3 * corners[half].max(axis=(0, 1))
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        axes.set_box_aspect(high - low, zoom=1.1)
        axes.set_axis_off()
        axes.set_title(f"side {k}, by {label.split()[0]}", fontsize=10)
        figure.colorbar(surface, ax=axes, shrink=0.6, label=label)
    return figure


_FACES = ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))


def next_experiment_figure() -> Figure:
    """The motions that may be proposed without something to do by hand."""
    scale = Scale(height=0.027, width=0.027, length=0.2)
    shown = [each for each in menu(scale) if not each.by_hand]
    figure = new_figure(10.0, 4.4)
    panels = figure.subplots(2, 4, sharey=True)
    for axes, experiment in zip(panels.ravel(), shown, strict=True):
        start = Pose(
            np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, scale.height + experiment.clearance])
        )
        motion = Motion(experiment.motion, start)
        times = np.linspace(0.0, motion.duration, 500)
        path = 1e3 * np.array([motion.pose(t).p for t in times])
        if experiment.clearance < 0.02:
            axes.axhspan(0.0, 1e3 * scale.height, color=FLESH, lw=0.0)
        axes.plot(times, path[:, 2], color=BLUE, label="height of the edge over the board")
        axes.plot(times, path[:, 0], color=PURPLE, ls="--", label="way along the edge")
        tidy(axes, experiment.name)
    for axes in panels[:, 0]:
        axes.set_ylabel("[mm]")
    for axes in panels[1]:
        axes.set_xlabel("time [s]")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    handles.append(Rectangle((0, 0), 1, 1, facecolor=FLESH))
    figure.legend(handles, [*labels, "food"], loc="outside lower center", ncols=3, frameon=False)
    return figure
