"""Draws pictures of results that are stored.

Writes coverage.png (intervals of calibrations), scaling.png (many machines), random_slices.png,
endurance.png, contact.png and benchmarks.png to docs/results/figures. Nothing is measured.
"""

import argparse
import json
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from studies.figures import BLUE, GREEN, ORANGE, RED, new_figure, save_figure, tidy
from studies.project.aims import RESULTS, SECTIONS, Docs

__all__ = [
    "add_arguments",
    "aims_figure",
    "contact_figure",
    "coverage_figure",
    "endurance_figure",
    "random_slices_figure",
    "run",
    "scaling_figure",
]

NORMAL_90 = 1.645
"""Half the width of a 90 % interval, in standard deviations."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """It has none."""


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    for name, draw in (
        ("coverage", coverage_figure),
        ("scaling", scaling_figure),
        ("random_slices", random_slices_figure),
        ("endurance", endurance_figure),
        ("contact", contact_figure),
        ("benchmarks", aims_figure),
    ):
        save_figure(draw(), RESULTS / "figures" / f"{name}.png", dpi=100)
    return 0


def coverage_figure() -> Figure:
    """The 90 % interval of each shared parameter about the truth, in each replicate."""
    lines = (RESULTS / "coverage.jsonl").read_text(encoding="utf-8").splitlines()
    replicates = [json.loads(line) for line in lines]
    shared = [n for n in replicates[0]["names"] if ":" not in n]
    figure = new_figure(10.0, 3.2)
    for k, axes in enumerate(figure.subplots(1, len(shared), sharey=True)):
        error = np.array([r["mean"][k] - r["truth"][k] for r in replicates])
        half = NORMAL_90 * np.array([r["deviation"][k] for r in replicates])
        order = np.argsort(error)
        for row, (e, h) in enumerate(zip(error[order], half[order], strict=True)):
            axes.plot([e - h, e + h], [row, row], color=BLUE if abs(e) <= h else RED)
            axes.plot(e, row, ".", color=BLUE if abs(e) <= h else RED)
        axes.axvline(0.0, color="k", lw=0.8)
        axes.set(xlabel="found minus true [of the range]", yticks=[])
        axes.xaxis.set_major_locator(MaxNLocator(4))
        tidy(axes, shared[k].removeprefix("material."))
    figure.axes[0].set_ylabel(f"{len(replicates)} replicates")
    return figure


def scaling_figure() -> Figure:
    """What more workers bring by the model of the page, and what was measured."""
    stored = _values("scaling")
    *rows, _ = stored["model"]["rows"]
    workers = [int(row[0]) for row in rows]
    _, *titles = stored["model"]["titles"]
    measured: dict[str, list[tuple[int, float]]] = {title: [] for title in titles}
    for row in stored["searches"]:
        (title,) = (each for each in titles if each.startswith(row[0]))
        measured[title].append((row[1], float(row[4])))
    if stored["dask"] is not None:
        measured[titles[2]] = [(row[0], float(row[3])) for row in stored["dask"]["rows"]]
    figure = new_figure(7.5, 4.0)
    axes = figure.subplots()
    for k, (title, colour) in enumerate(zip(titles, (BLUE, ORANGE, GREEN), strict=True), 1):
        rates = [float(row[k].partition(" ")[0]) for row in rows]
        axes.loglog(workers, rates, color=colour, label=f"{title}, model")
        axes.loglog(*zip(*measured[title], strict=True), "o", color=colour, label="measured")
    axes.set(xlabel="workers", ylabel="done a second")
    axes.legend(fontsize=8, frameon=False, ncols=2)
    tidy(axes)
    return figure


def random_slices_figure() -> Figure:
    """What came of the random slices of each shape of food."""
    stored = _values("random_slices")
    *rows, _ = stored["rows"]
    shapes, *counts = zip(*rows[::-1], strict=True)
    figure = new_figure(8.0, 2.4)
    axes = figure.subplots()
    left = np.zeros(len(shapes))
    colours = (BLUE, "0.7", ORANGE, RED)
    for kind, count, colour in zip(stored["kinds"], counts, colours, strict=True):
        label = f"{kind} ({sum(count)})"
        axes.barh(shapes, count, left=left, color=colour, label=label)
        left += count
    axes.set_xlabel("slices")
    axes.legend(frameon=False, fontsize=9, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    tidy(axes)
    return figure


def endurance_figure() -> Figure:
    """Memory over the slices of one station, and what it would be with a new station for each."""
    stored = _values("endurance")
    count, (first, *_) = stored["station"], stored["held"]
    slices = np.linspace(1, count, 50)
    figure = new_figure(8.0, 3.0)
    axes = figure.subplots()
    new = (first + stored["left"] * (slices - 1)) / 1e3
    axes.plot(slices, new, "--", color=ORANGE, label="a new station for each slice (computed)")
    held = np.array(stored["held"]) / 1e3
    axes.plot([1, count / 2, count], held, "o-", color=BLUE, label="one station (measured)")
    axes.set(xlabel="slices with the arm", ylabel="memory held [GB]", ylim=(0.0, None))
    axes.legend(frameon=False, fontsize=9)
    tidy(axes)
    return figure


def contact_figure() -> Figure:
    """What a stiffer contact and a finer mesh change of the force, and of its friction."""
    rows = _values("contact")["rows"]
    figure = new_figure(9.0, 2.8)
    variants = ("contact 4 times as stiff", "16 times as stiff", "mesh twice as fine")
    for k, axes in enumerate(figure.subplots(1, 3, sharey=True)):
        cells = [row[2 + k].replace("(", "").replace(" %", "").split() for row in rows[::-1]]
        friction, force = ([float(cell[n].strip(")")) for cell in cells] for n in (1, 0))
        place = np.arange(len(rows))
        axes.barh(place + 0.2, force, 0.4, color=BLUE, label="vertical force")
        axes.barh(place - 0.2, friction, 0.4, color=ORANGE, label="friction of the flanks")
        axes.axvline(0.0, color="k", lw=0.8)
        axes.set(xlabel="change [%]", yticks=place, yticklabels=[row[0] for row in rows[::-1]])
        tidy(axes, variants[k])
    handles = figure.axes[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper right", ncols=2, frameon=False, fontsize=9)
    return figure


def aims_figure() -> Figure:
    """How many aims of each kind are reached."""
    docs = Docs(RESULTS)
    verdicts = {title: [row.met for row in rows_of(docs)] for title, rows_of in SECTIONS.items()}
    figure = new_figure(8.0, 2.6)
    axes = figure.subplots()
    names = list(verdicts)[::-1]
    met = [sum(v is True for v in verdicts[name]) for name in names]
    missed = [sum(v is False for v in verdicts[name]) for name in names]
    axes.barh(names, met, color=BLUE, label="reached")
    axes.barh(names, missed, left=met, color=ORANGE, label="missed")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("aims")
    axes.legend(frameon=False, fontsize=9)
    tidy(axes)
    return figure


def _values(page: str) -> dict[str, Any]:
    """What a page shows, as it is stored beside it."""
    text = (RESULTS / "data" / f"{page}.json").read_text(encoding="utf-8")
    return json.loads(text)["values"]
