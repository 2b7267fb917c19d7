"""Draws pictures of results that are stored: intervals of calibrations, many machines, aims.

Writes coverage.png, scaling.png and benchmarks.png to docs/results/figures. Nothing is measured.
"""

import argparse
import json

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from studies.figures import BLUE, GREEN, ORANGE, RED, new_figure, save_figure, tidy
from studies.project.aims import RESULTS, SECTIONS, Docs

__all__ = ["add_arguments", "aims_figure", "coverage_figure", "run", "scaling_figure"]

NORMAL_90 = 1.645
"""Half the width of a 90 % interval, in standard deviations."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """It has none."""


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    for name, draw in (
        ("coverage", coverage_figure),
        ("scaling", scaling_figure),
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
        tidy(axes, shared[k].removeprefix("material."))
    figure.axes[0].set_ylabel(f"{len(replicates)} replicates")
    return figure


def scaling_figure() -> Figure:
    """What more workers bring by the model of the page, and what was measured."""
    stored = json.loads((RESULTS / "data" / "scaling.json").read_text(encoding="utf-8"))["values"]
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
