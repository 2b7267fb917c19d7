"""The cutting physics against exact solutions, finer computations and the measured cuts.

Prints the page that docs/results/verification.md holds; takes a few minutes. With --output it also
writes the numbers beside it (.json) and the figures (figures/verification_*.png). Ends with status
1 if a number is beyond its limit.
"""

import argparse
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from sliceit_drake.resources import resource_path
from studies.figures import BLUE, RED, new_figure, save_figure, tidy
from studies.pages import percent, publish, render
from studies.physics import measured_curves as curves
from studies.physics.measured_curves import MeasuredCut
from studies.physics.verification import CHECKS, limits, run_verification

__all__ = [
    "add_arguments",
    "plot_convergence",
    "plot_measured_cuts",
    "run",
    "verification_page",
]

COMMAND = "python -m studies verification --output docs/results/verification.md"
FOODS = "calibration/verification_foods.yaml"
CURVES = ("measured", "DiSECt", "spring", "ours")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument(
        "--output",
        metavar="FILE",
        type=Path,
        help="write the page there, as docs/results/verification.md, with its numbers and figures",
    )
    parser.add_argument(
        "--foods", metavar="FILE", type=Path, help=f"fitted foods; default: {FOODS}"
    )
    parser.add_argument(
        "--fit",
        action="store_true",
        help="first fit the foods to the measured cuts, some minutes each, and write that file",
    )


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    file = options.foods or resource_path(FOODS)
    foods = curves.load_measured_foods(file)
    if options.fit:
        for k, case in enumerate(foods.foods):
            with tqdm(total=len(curves.STARTS), desc=f"fit of {case.food.name}") as bar:
                foods.foods[k] = curves.fit_measured_food(case, progress=bar.update)
        curves.save_measured_foods(foods, file, "python -m studies verification --fit")
    with tqdm(total=CHECKS + len(foods.foods), desc="checks") as bar:
        results, cuts = run_verification(foods.foods, lambda: bar.update() and None)
    publish(verification_page(results), options.output, results)
    if options.output is not None:
        figures = options.output.parent / "figures"
        named = [(case.food.name, cut) for case, cut in zip(foods.foods, cuts, strict=True)]
        plot_measured_cuts(named, figures / "verification_curves.png")
        plot_convergence(results, figures / "verification_convergence.png")
    missed = [limit.what for limit in limits(results) if not limit.holds]
    for what in missed:
        print(f"beyond its limit: {what}")
    return 1 if missed else 0


def verification_page(results: Mapping[str, Any]) -> str:
    """The page, from the results of `run_verification` alone."""
    foods, beam = results["foods"], results["beam"]
    mesh, step = results["mesh"], results["step"]
    return render(
        "verification",
        command=COMMAND,
        hold=results["hold"],
        gradient=results["gradient"],
        mesh=mesh,
        step=step,
        limits=[
            (x.what, _short(x.value), f"{x.bound:g}", "yes" if x.holds else "**no**")
            for x in limits(results)
        ],
        patch=[
            (r["name"], r["elements"])
            + tuple(f"{r[k]:.1e}" for k in ("inside", "surface", "rigid", "one_body"))
            for r in results["patch"]
        ],
        beam=[
            (n, f"{ratio:.3f}", order)
            for n, ratio, order in zip(
                beam["divisions"], beam["ratio"], ["-", *map(_order, beam["order"])], strict=True
            )
        ],
        edge=[
            (r["divisions"], f"{r['draw_ratio']:g}", _ratio(r["vertical"]), _ratio(r["along"]))
            + (percent(r["ripple"]), _ratio(r["work"]))
            for r in results["edge"]
        ],
        friction=[
            (r["divisions"], f"{r['friction']:g}", f"{r['draw_ratio']:g}", _ratio(r["vertical"]))
            + (_ratio(r["along"]), f"{r['share']:.2f}")
            for r in results["friction"]
        ],
        mesh_rows=[
            (f"{h:.3g}", n, error, order)
            for h, n, (error, order) in zip(
                mesh["size"], mesh["elements"], _errors(mesh), strict=True
            )
        ],
        step_rows=[
            (f"{1e3 * h:.4g}", error, order)
            for h, (error, order) in zip(step["size"], _errors(step), strict=True)
        ],
        curves=[
            (food["name"] if name == "measured" else "", name)
            + ("-" if name == "measured" else f"{curve['rms']:.2f}", f"{curve['peak']:.1f}")
            + (f"{curve['work']:.0f}",)
            for food in foods
            for name in CURVES
            for curve in [food["curves"][name]]
        ],
        parameters=[
            (food["name"], f"{food['toughness']:.0f}", f"{1e-6 * food['youngs_modulus']:.2f}")
            + (f"{food['friction']:.3f}", f"{food['skin']:.3f}", f"{food['contact_time']:.3f}")
            + (f"{food['softness']:.2f}", food["budget"]["elements"], _verdict(food))
            for food in foods
        ],
        budgets=[("", "", *7 * ["[J/m2]"], "of work"), *map(_budget, foods)],
        measured_work=_listing(f"{food['curves']['measured']['work']:.0f}" for food in foods),
        edge_shares=_listing(
            f"{percent(food['budget']['edge'] / food['budget']['work'])} ({food['name']})"
            for food in foods
        ),
    )


def _verdict(food: Mapping[str, Any]) -> str:
    ours, theirs = (food["curves"][name]["rms"] for name in ("ours", "DiSECt"))
    return f"{ours / theirs:.2f} x DiSECt's"


def _budget(food: Mapping[str, Any]) -> tuple[object, ...]:
    b = food["budget"]
    per = 1.0 / (b["cut"] * b["area"])
    rest = b["board_friction"] + b["blade"]
    parts = [b[name] for name in ("work", "edge", "opening", "friction", "damping")]
    parts += [rest, b["stored"]]
    numbers = (f"{part * per:.1f}" for part in parts)
    return (food["name"], percent(b["cut"]), *numbers, percent(b["imbalance"]))


def _errors(refinement: Mapping[str, Any]) -> list[tuple[str, str]]:
    errors = [*map(percent, refinement["error"]), "reference"]
    return list(zip(errors, ["-", *map(_order, refinement["order"]), "-"], strict=True))


def _short(value: float) -> str:
    return f"{value:.1e}" if value < 1e-3 else f"{value:.3g}"


def _ratio(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _order(value: float | None) -> str:
    return "none" if value is None else f"{value:.1f}"


def _listing(items: Iterable[str]) -> str:
    *first, last = items
    return f"{', '.join(first)} and {last}"


def plot_measured_cuts(cuts: Sequence[tuple[str, MeasuredCut]], file: Path) -> None:
    """Draws measured force, DiSECt, spring and ours over time.

    Args:
        cuts: By the food's name.
        file: PNG to write.
    """
    figure = new_figure(12.0, 4.2)
    for axes, (name, cut) in zip(figure.subplots(1, len(cuts)), cuts, strict=True):
        profile, comparison = cut.profile, cut.comparison
        axes.plot(profile.time, profile.force, color="#000000", lw=2.0, label="measured")
        for reference, colour, style in (("DiSECt", RED, "--"), ("spring", "0.6", ":")):
            force = profile.references[reference]
            rms = float(np.sqrt(np.mean((force - profile.force) ** 2)))
            label = f"{'calibrated DiSECt' if reference == 'DiSECt' else reference}: {rms:.2f} N"
            axes.plot(profile.time, force, style, color=colour, lw=1.5, label=label)
        label = f"ours: {comparison.rms:.2f} N"
        axes.plot(profile.time, comparison.simulated, color=BLUE, lw=1.5, label=label)
        axes.set_xlabel("time [s]")
        axes.set_ylim(0.0, 1.45 * max(profile.force.max(), comparison.simulated_peak))
        tidy(axes, name)
        axes.legend(
            frameon=False, fontsize=8, loc="upper left", title="RMS error", title_fontsize=8
        )
    figure.axes[0].set_ylabel("force on the knife [N]")
    save_figure(figure, file)


def plot_convergence(results: Mapping[str, Any], file: Path) -> None:
    """Draws the errors of `refine_mesh` and `refine_step`.

    Args:
        results: Of `run_verification`.
        file: PNG to write.
    """
    figure = new_figure(8.4, 3.8)
    panels = figure.subplots(1, 2)
    mesh, step = results["mesh"], results["step"]
    parts = (
        (mesh, 1.0, "edge length over the default [1]", 2.0, "mesh, with the step"),
        (step, 1e3, "longest sub-step [ms]", 1.0, "step, on the default mesh"),
    )
    for axes, (part, scale, label, slope, title) in zip(panels, parts, strict=True):
        size = scale * np.array(part["size"][:-1])
        error = 100.0 * np.array(part["error"])
        axes.loglog(size, error, "o-", color=BLUE, label="against the finest")
        guide = error[0] * (size / size[0]) ** slope
        axes.loglog(size, guide, "--", color="0.5", label=f"order {slope:g}")
        axes.set_xticks(size, [f"{x:.3g}" for x in size])
        axes.set_yticks(error, [f"{e:.2g}" for e in error])
        axes.minorticks_off()
        axes.set_xlabel(label)
        tidy(axes, title)
        axes.grid(alpha=0.25, which="both")
        axes.legend(frameon=False, fontsize=8)
    panels[0].set_ylabel("RMS error of the force [%]")
    save_figure(figure, file)
