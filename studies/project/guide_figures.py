"""Draws pictures of the guides: foods, shapes, frames, the station's loop, the servo, a record.

Writes foods.png, shapes.png, frames.png, station.png, servo.png, record.png and environment.png to
docs/figures.
"""

import argparse
import itertools

import gymnasium
import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from sliceit_drake.cutting.foods.shapes import Box, Cylinder, Ellipsoid, HalfCylinder, Tapered
from sliceit_drake.cutting.mesh.tetrahedra import boundary_faces
from sliceit_drake.diagrams.run import simulate
from sliceit_drake.records.validation import load_record
from sliceit_drake.resources import resource_path
from sliceit_drake.systems.servo import ServoConfig, ServoLaw
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
    "environment_figure",
    "foods_figure",
    "frames_figure",
    "record_figure",
    "run",
    "servo_figure",
    "shapes_figure",
    "station_figure",
]

SCENARIOS = {
    "cucumber": "cucumber_sequence",
    "carrot": "carrot_sequence",
    "potato": "potato_sequence",
    "tomato": "tomato_sequence",
    "apple": "apple",
}
# Rows and columns of a picture of 480 x 640 around the food.
CROP = (slice(130, 430), slice(150, 450))
# Name, what it is made of, and its place.
BOXES = {
    "policy": ("policy or motion", (0.11, 0.72)),
    "controller": ("compliance control\n(FDCC)", (0.37, 0.72)),
    "arm": ("servo, arm, knife, board\n(plant), or a UR5e", (0.66, 0.72)),
    "cutting": ("cutting system\n(food)", (0.66, 0.2)),
    "sensor": ("wrench sensor", (0.37, 0.2)),
}
ARROWS = [
    ("policy", "controller", "target_pose"),
    ("controller", "arm", "joint_positions_command"),
    ("arm", "cutting", "knife_pose, knife_velocity"),
    ("cutting", "arm", "food_wrench"),
    ("arm", "sensor", ""),
    ("sensor", "controller", "sensor_wrench"),
    ("sensor", "policy", ""),
]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """It has none."""


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    save_guide_figures(
        {
            "foods": foods_figure,
            "shapes": shapes_figure,
            "frames": frames_figure,
            "environment": environment_figure,
            "station": station_figure,
            "servo": servo_figure,
            "record": record_figure,
        }
    )
    return 0


def foods_figure() -> Figure:
    """Each food that ships, as it lies before the knife."""
    figure = new_figure(10.0, 2.4)
    for axes, (food, scenario) in zip(figure.subplots(1, 5), SCENARIOS.items(), strict=True):
        film = simulate(scenario, duration=0.02, replay=False, animation=True).film
        assert film is not None
        axes.imshow(next(film.draw(film.frames[:1]))[CROP])
        axes.set_title(food, fontsize=11)
        axes.axis("off")
    return figure


def shapes_figure() -> Figure:
    """A food of each shape that is generated, with its mesh, on the same scale."""
    shapes = {
        "!Cylinder": Cylinder(),
        "!HalfCylinder": HalfCylinder(),
        "!Box": Box([0.04, 0.09, 0.03]),
        "!Box, a plate": Box([0.06, 0.1, 0.008], [12, 2]),
        "!Ellipsoid": Ellipsoid([0.05, 0.07, 0.048]),
        "!Tapered": Tapered(),
    }
    figure = new_figure(10.0, 2.2)
    for k, (name, shape) in enumerate(shapes.items()):
        mesh = shape.mesh()
        faces, _ = boundary_faces(mesh.tetrahedra)
        axes = figure.add_subplot(1, len(shapes), k + 1, projection="3d", proj_type="ortho")
        axes.view_init(elev=24.0, azim=-55.0)
        corners = 1e3 * mesh.vertices[faces]
        axes.add_collection3d(
            Poly3DCollection(corners, facecolors="#e2f0cf", edgecolors="0.4", lw=0.2, shade=True)
        )
        axes.set(xlim=(-45, 45), ylim=(-60, 60), zlim=(0, 50))
        axes.set_box_aspect((90, 120, 50), zoom=1.45)
        axes.set_axis_off()
        axes.set_title(name, fontsize=10)
    return figure


def frames_figure() -> Figure:
    """World, food, knife and sensor, and where their frames are; mm."""
    figure = new_figure(6.0, 5.4)
    axes = figure.add_subplot(projection="3d", proj_type="ortho")
    axes.set_axis_off()
    axes.view_init(elev=18.0, azim=-58.0)
    turn, along = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 41), [-60.0, 60.0])
    axes.plot_surface(
        13.5 * np.cos(turn), along, 13.5 + 13.5 * np.sin(turn), color=GREEN, alpha=0.35
    )
    edge, spine = 62.0, 105.0
    blade = np.array([[[-70, 0, edge], [70, 0, edge], [70, 0, spine], [-70, 0, spine]]], float)
    axes.add_collection3d(Poly3DCollection(blade, facecolor="0.6", edgecolor="0.3", alpha=0.6))
    board = np.array([[[-90, -75, 0], [90, -75, 0], [90, 75, 0], [-90, 75, 0]]], float)
    axes.add_collection3d(Poly3DCollection(board, facecolor=ORANGE, edgecolor="0.5", alpha=0.15))
    down = np.diag([1.0, -1.0, -1.0])
    for name, origin, R in (
        ("W", [-90.0, -75.0, 0.0], np.eye(3)),
        ("F", [0.0, 0.0, 0.0], np.eye(3)),
        ("K", [0.0, 0.0, edge], down),
        ("S", [0.0, 0.0, 165.0], down),
    ):
        at = np.array(origin)
        for k, colour in enumerate((RED, GREEN, BLUE)):
            axes.quiver(*at, *(28.0 * R[:, k]), color=colour, lw=2.0, arrow_length_ratio=0.2)
            beside = [7.0, 0.0, 0.0] if k == 2 else [0.0, 0.0, 0.0]
            where = at + (24.0 if k == 2 else 35.0) * R[:, k] + beside
            axes.text(*where, "xyz"[k], color=colour, ha="center", va="center", zorder=20)
        axes.text(*(at + [-9.0, 0.0, 3.0]), name, fontsize=13, weight="bold", zorder=20)
    axes.plot([0.0, 0.0], [0.0, 0.0], [spine, 165.0], color="0.3", lw=4.0)
    axes.set(xlim=(-90, 90), ylim=(-90, 90), zlim=(0, 170))
    axes.set_box_aspect((180, 180, 170), zoom=1.25)
    return figure


def environment_figure() -> Figure:
    """What the environment renders in an episode of draws and presses."""
    env = gymnasium.make(
        "sliceit_drake.learning:sliceit_drake/SlicingCucumber-v0", render_mode="rgb_array"
    )
    env.reset(seed=0)
    pictures: list = []
    done = False
    while not done:
        k = len(pictures)
        draw = 1.0 if k // 12 % 2 else -1.0
        *_, terminated, truncated, _ = env.step(np.array([0.0, 0.0, 0.5, 0.0, draw, 0.5]))
        done = terminated or truncated
        pictures.append(env.render())
    figure = new_figure(9.0, 2.4)
    for column, k in enumerate(np.linspace(0, len(pictures) - 1, 4).astype(int)):
        axes = figure.add_subplot(1, 4, column + 1)
        axes.imshow(pictures[k])
        axes.set_axis_off()
        axes.set_title(f"decision {k + 1}", fontsize=9)
    return figure


def station_figure() -> Figure:
    """The systems of a station and what goes from one to the next."""
    figure = new_figure(9.0, 3.6)
    axes = figure.subplots()
    axes.set(xlim=(0.0, 0.86), ylim=(0.0, 1.0))
    draw_boxes(axes, BOXES, ARROWS)
    return figure


def servo_figure() -> Figure:
    """The servo's answer to a step and to a ramp."""
    figure = new_figure(10.0, 3.4)
    step, ramp = figure.subplots(1, 2)
    period = 1e-3
    time = period * np.arange(600)
    for colour, (lookahead, gain) in zip(
        (BLUE, ORANGE, GREEN, PURPLE),
        [(0.03, 2000.0), (0.03, 300.0), (0.1, 300.0), (0.2, 300.0)],
        strict=True,
    ):
        law = ServoLaw(ServoConfig(lookahead_time=lookahead, gain=gain), period)
        for axes, targets in ((step, np.full(len(time), 10.0)), (ramp, 100.0 * time)):
            state, found = law.state_at_rest(np.zeros(1)), []
            for target in targets:
                found.append(state[0, 0])
                state = law.A @ state + law.B * target
            axes.plot(time, found, color=colour, label=f"lookahead {lookahead:g} s, gain {gain:g}")
    for axes, title, targets in (
        (step, "Step of 10 mrad", np.full(len(time), 10.0)),
        (ramp, "Ramp of 0.1 rad/s", 100.0 * time),
    ):
        axes.plot(time, targets, "k--", lw=1.0, label="target")
        axes.set(xlabel="time [s]", ylabel="joint position [mrad]")
        tidy(axes, title)
    ramp.legend(fontsize=8, frameon=False)
    return figure


def record_figure() -> Figure:
    """What a slice record holds: the motion of the knife, the force on it, and the phases."""
    record = load_record(resource_path("calibration/records/cucumber.csv"))
    figure = new_figure(8.0, 4.2)
    height, force = figure.subplots(2, 1, sharex=True)
    height.plot(record.time, 1e3 * record.position[:, 2], color=BLUE)
    height.set_ylabel("edge above W [mm]")
    tidy(height, "Slice record calibration/records/cucumber")
    force.plot(record.time, record.force_magnitude, color=ORANGE)
    force.set(xlabel="time [s]", ylabel="force on the knife [N]")
    tidy(force)
    shades = itertools.cycle(("0.95", "0.9"))
    for phase, shade in zip(record.metadata.motion.phases, shades, strict=False):
        for axes in (height, force):
            axes.axvspan(phase.start, phase.end, color=shade, zorder=0)
        middle = (phase.start + phase.end) / 2.0
        force.text(middle, 1.0, phase.label, ha="center", fontsize=9)
    return figure
