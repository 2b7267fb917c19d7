"""What each effect adds to the force of one cut: press, hold, withdrawal.

A bar of 24 x 20 mm is pressed open 14 mm deep, the knife rests for half a second and is withdrawn.
Each panel is the base model and the same cut with one effect of a plausible size, over the depth
that is commanded; for what only a draw shows the knife is drawn as well, by twice its press.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from tqdm import tqdm

from sliceit_drake.cutting.batch import BatchSlice, simulate_batch
from sliceit_drake.cutting.foods.effects import (
    Adhesion,
    Bluntness,
    Compliance,
    Core,
    Effects,
    Relaxation,
    Skin,
    SlicePush,
    Slip,
    ToughnessRate,
)
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Box
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import CuttingModel, Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, Motion, MotionPlan, Retract
from studies.figures import BLUE, add_figure_argument, new_figure, save_figure

WIDTH, HEIGHT, DEPTH, CLEARANCE, PERIOD, HOLD, SPEED = 0.024, 0.02, 0.014, 1e-3, 2e-3, 0.5, 0.02
BASE, CHANGED, DRAW = "0.55", BLUE, 2.0

# Title, size, group; the last shows the force along the edge.
PANELS = [
    ("Rate-dependent toughness", "m = 0.2, at 4 x the reference speed", ToughnessRate(0.2, 5e-3)),
    ("Relaxation", "40 % with 0.15 s", Relaxation([0.4], [0.15])),
    ("Adhesion", "2 kPa + 50 kPa s/m", Adhesion(2e3, 5e4)),
    ("Skin", "0.15 J/m, 0.5 mm", Skin(0.15, 5e-4)),
    ("Core", "half as tough, from 3 mm inwards", Core(3e-3, 1e-3, 0.5)),
    ("Bluntness", "+400 J/m2, falling over 2 mm", Bluntness(400.0, 2e-3)),
    ("Arm", "0.2 mm/N", Compliance(arm=2e-4)),
    ("Slice-push exponent, drawn", "1.5 for 1, draw twice the press", SlicePush(1.5)),
    ("Slip, drawn", "along the edge; at 2 N, half left", Slip(2.0, 0.5)),
]


def effects_of(group: object) -> Effects:
    """The effects with one group; a food that may slip has a holder."""
    base = Effects(compliance=Compliance(holder=1e-4)) if isinstance(group, Slip) else Effects()
    for name, default in vars(base).items():
        if type(default) is type(group):
            setattr(base, name, group)
    return base


def motions(model: CuttingModel) -> dict[bool, Motion]:
    """The press, and the press with a draw; both hold and withdraw."""
    out = {}
    for drawn in (False, True):
        slope = np.hypot(1.0, DRAW) if drawn else 1.0
        cut = ConstantSpeed(
            direction=[DRAW if drawn else 0.0, 0.0, 1.0],
            distance=(DEPTH + CLEARANCE) * slope,
            speed=SPEED * slope,
        )
        plan = MotionPlan(
            [cut, Hold(duration=HOLD), Retract(distance=DEPTH + CLEARANCE, speed=SPEED)]
        )
        shift = -0.5 * DRAW * DEPTH if drawn else 0.0
        out[drawn] = Motion(plan, start_pose(model, CLEARANCE, shift))
    return out


def draw(axes: Axes, command: np.ndarray, cut: BatchSlice, axis: int, style: dict) -> None:
    """Force over the commanded depth on the way in and out, and in between over time, at rest."""
    stop = round((DEPTH + CLEARANCE) / SPEED / PERIOD)
    held = round(HOLD / PERIOD)
    force = cut.food_wrench[:, 3 + axis] * (1.0 if axis == 2 else -1.0)
    depth = 1e3 * (HEIGHT - command[:, 2])
    rest = np.linspace(0.0, 1.0, held)
    x = np.concatenate([depth[:stop], 14.0 + 8.0 * rest, 36.0 - depth[stop + held :]])
    axes.plot(x, force, **style)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    add_figure_argument(parser, "effects")


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    food = Food(
        shape=Box(size=[WIDTH, 0.1, HEIGHT], divisions=[8, 8], layers=[0.0, 0.003, 0.006, 0.012]),
        material=Material(youngs_modulus=2e6, toughness=300.0, friction=0.05),
    )
    model = make_food_model(food, Knife(length=0.4, spine_thickness=2e-3), Numerics(time_step=2e-4))
    paths = motions(model)
    groups = [Effects(), Effects(), *(effects_of(group) for _, _, group in PANELS)]
    drawn = [False, True, *("drawn" in title for title, _, _ in PANELS)]
    with tqdm(total=len(groups), desc="cuts") as bar:
        cuts = simulate_batch(
            [model.derive(effects=effects) for effects in groups],
            [paths[way] for way in drawn],
            PERIOD,
            progress=lambda done: bar.update(done - bar.n),
        )
    figure_of(cuts, drawn, options.output)
    return 0


def figure_of(cuts: list[BatchSlice], drawn: list[bool], output: Path) -> None:
    """Panels of three, with the phases of the motion marked."""
    figure = new_figure(10.0, 7.4)
    grid = figure.subplots(3, 3, sharex=True)
    for k, (axes, (title, size, group)) in enumerate(zip(grid.flat, PANELS, strict=True)):
        axis = 0 if isinstance(group, Slip) else 2
        base = cuts[int(drawn[2 + k])]
        axes.axvspan(14.0, 22.0, color="0.94", lw=0)
        axes.axhline(0.0, color="0.8", lw=0.8)
        draw(axes, base.position, base, axis, {"color": BASE, "lw": 1.4, "label": "base"})
        draw(
            axes,
            base.position,
            cuts[2 + k],
            axis,
            {"color": CHANGED, "lw": 1.4, "label": "with the effect"},
        )
        axes.set_title(title, loc="left", fontsize=10, fontweight="bold", pad=16)
        axes.text(0.0, 1.03, size, transform=axes.transAxes, color="0.35", fontsize=8.5)
        low, high = axes.get_ylim()
        axes.set_ylim(low, high + 0.16 * (high - low))
        for x, phase in ((7.0, "press"), (18.0, "hold"), (29.0, "withdraw")):
            axes.text(
                x,
                0.975,
                phase,
                transform=axes.get_xaxis_transform(),
                color="0.5",
                fontsize=8,
                ha="center",
                va="top",
            )
        axes.set_xlim(-1.0, 37.0)
        axes.set_xticks([0, 5, 10, 14, 22, 26, 31, 36], ["0", "5", "10", "", "", "10", "5", "0"])
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_ylabel("along the edge (N)" if axis == 0 else "vertical force (N)")
    for axes in grid[-1]:
        axes.set_xlabel(f"depth (mm), {HOLD:g} s at rest, depth (mm)")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=2, frameon=False)
    figure.suptitle(
        "What each effect changes in the force of the food on the knife", x=0.01, ha="left"
    )
    save_figure(figure, output, 160)
