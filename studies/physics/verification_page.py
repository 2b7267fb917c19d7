"""The cutting physics against exact solutions, finer computations and the measured cuts.

Prints the page that docs/verification.md holds; takes a few minutes. With --output it also writes
the numbers beside it (.json) and the figures (figures/verification_*.png). Ends with status 1 if
a number is beyond its limit.
"""

import argparse
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from sliceit_drake.resources import resource_path
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

COMMAND = "python -m studies verification --output docs/verification.md"
FOODS = "calibration/verification_foods.yaml"
CURVES = ("measured", "DiSECt", "spring", "ours")

PAGE = """\
# Verification

The cutting physics ([physics.md](physics.md)) against exact solutions, finer computations,
conservation laws and published measurements. Everything on this page is computed by

    {command}

which takes a few minutes and writes the page from `verification.json`. A test renders the page
anew, recomputes the quick numbers, and asserts the limits below. A dash stands for what does not
apply.

| limit | found | at most | holds |
|---|---|---|---|
{limits}

## Patch tests

A box of distorted elements, in double precision, split into two halves that are bonded and not
cut. Forces are relative to the largest load on a vertex at 15 % of homogeneous strain. *Inside*:
force on inner vertices at that strain, where none belongs. *Surface*: load on surface vertices
against the stress. *Rigid*: forces after rotations and translations. *One body*: difference from
the body that is not split, at a strain that varies.

| cut | elements | inside | surface | rigid | one body |
|---|---|---|---|---|---|
{patch}

## Bending

A cantilever under its own weight, six times as long as high, Poisson's ratio 0: fall of its end
over that of Timoshenko's beam. The forces are the kernels', linearised, the cut bonded across the
bar. Linear tetrahedra are too stiff in bending, by design; the error falls with their size h to
the order shown.

| elements across | deflection / exact | order |
|---|---|---|
{beam}

## Edge

A bar of 24 mm width is cut by a blade so thin that its wedge opens nothing, without friction.
Mean force over that of Atkins, Xu and Jeronimidis (2004), R w / (1 + xi^2) down and xi times that
along the edge; ripple is the standard deviation over the mean; work is the edge's dissipation
over R A.

| elements across | xi | down / exact | along / exact | ripple | work / R A |
|---|---|---|---|---|---|
{edge}

## Flanks

A bar without toughness, 15 to 20 mm deep, so that only the wedge acts. A flank of half angle
theta that is pressed by N is pushed out with N sin theta and, sliding, held back with mu N along
its sliding. N is taken from the normal force, and the friction compared. Vertical friction is mu
/ tan theta times the wedge's own force (last column): for a thin knife friction is nearly all.
The normal force also holds what the growth of the contact at its front takes (physics.md, "Flanks
and friction"), which vanishes with the mesh; so does the difference.

| elements across | mu | xi | down / exact | along / exact | friction / wedge |
|---|---|---|---|---|---|
{friction}

## Hold

A press that stops 12 mm deep at {hold_force} N and stays for {hold_duration} s. The force drifts
by {hold_drift} (from 0.1 s after the stop to the end) and no node moves faster than {hold_creep}
m/s on average over the second half: the model has no relaxation unless it is given one
(`effects.relaxation`).

## Gradients

A random function of all wrenches of a draw-and-press cut of {gradient_exchanges} exchanges, in
double precision, by {gradient_parameters} shared parameters of bulk, edge, flanks, skin and
knife: adjoint and central differences differ by at most {gradient_largest} (`{gradient_worst}`).
`tests/test_gradient.py` has the rest.

## Convergence of a whole cut

Norm of the force through 26.5 mm of the cucumber of `scenarios/cucumber.yaml`: RMS difference
from the finest run over the RMS force. The order p is that of an error C (h^p - h_finest^p);
"none" where no p gives the errors. Meshes are refined together with the step, because at a
constant step the masses of a finer mesh are scaled higher, and their inertia hides the
convergence. Extrapolated to zero (with order 1 where there is none), the default mesh is
{mesh_estimate} off, and the default step, on that mesh, {step_estimate}.

The edge's force acts along a line, and under a line load R an elastic body yields by
2 (1 - nu^2) R / (pi E) log(1/h): 0.08 mm here for each factor e of the mesh size, without end. We
take that for the reason why the force of finer meshes keeps moving by some tenths of a per cent
instead of following an order, but have not separated it from other causes.

![Error against mesh size and step](figures/verification_convergence.png)

| mesh size / default | elements | error | order |
|---|---|---|---|
{mesh}

| step [ms] | error | order |
|---|---|---|
{step}

## The measured cuts

The curves of the SliceIt! paper ([calibration/measured](../calibration/measured/README.md))
beside its authors' calibrated DiSECt, their spring, and ours. The depth at contact is unknown and
is fitted, as time of first contact, for ours; toughness, Young's modulus, friction and skin come
from `calibration/verification_foods.yaml`, fitted to the same curve by

    python -m studies verification --fit

So ours are five numbers fitted in sample, as DiSECt's are fitted (how many we do not know): the
table compares what the models can follow, it predicts nothing. One press cut does not tell E from
friction, and fits that differ in both are as good: no fitted value is a material constant.

![Measured and simulated force of three foods](figures/verification_curves.png)

| food | curve | RMS error [N] | peak [N] | apparent work [J/m2] |
|---|---|---|---|---|
{curves}

| food | R [J/m2] | E [MPa] | mu | skin [J/m] | contact [s] | R/(E h) | elements | error |
|---|---|---|---|---|---|---|---|---|
{parameters}

**Where it fails.** The measured tomato has two peaks, 12 and 23 mm below the top, with a third
less force between them. Ours is one homogeneous flesh with a skin that costs energy per length,
and has no such shape. With the configured E of 0.04 MPa and the measured apparent work as R the
food yields by about two elements (R / (E h) = 2.4 with elements of 4 mm in the section) before it
parts: the run is refused, as elements invert above about 0.5, and with R = 200 J/m2 already
because the food snaps and the kinetic energy passes 5 %. So the fit must go to a stiffer flesh,
and a coarse mesh, and draws a smooth curve through the peaks.

## Where the work goes

The knife's work on the food, and what it went into, per area that the edge passed. These cuts go
as deep as the record would if it began at contact, so 1 to 3 mm beyond the end of the curves
above. *Cut* is the share of the section; *rest* is the friction of food on board and the blade's
damping; *stored* is elastic, in bonds and contacts, and kinetic, at the end, with the knife still
in the food. The imbalance is the work (with that of the food's weight) less everything it went
into.

| food | cut | work | edge | opening | friction | damping | rest | stored | imbalance |
|---|---|---|---|---|---|---|---|---|---|
| | | [J/m2] | [J/m2] | [J/m2] | [J/m2] | [J/m2] | [J/m2] | [J/m2] | of work |
{budgets}

**Apparent work of cutting.** The measured force over its travel and the whole round section gives
the {measured_work} J/m2 of the table before. It is no toughness: friction on the flanks is in it,
and the strain of what is clamped beside the cut. The part of the section that is left when the
record ends is counted as if it were cut. The board is not in ours: at the fitted depths the edge
ends above it. Per area that was cut, ours splits into the columns here: of the knife's work, the
edge takes {edge_shares}.

Published values for toughness itself: potato 1,230 and 1,350 J/m2 (two cultivars), from
compression until tubers crack (Schoorl and Holt 1983, J. Texture Stud.), which is more than the
whole work of the measured cut; we know of none for cucumber or tomato flesh.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument(
        "--output",
        metavar="FILE",
        type=Path,
        help="write the page there, as docs/verification.md, with its numbers and figures",
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
    page = verification_page(results)
    print(page)
    if options.output is not None:
        output: Path = options.output
        figures = output.parent / "figures"
        named = [(case.food.name, cut) for case, cut in zip(foods.foods, cuts, strict=True)]
        plot_measured_cuts(named, figures / "verification_curves.png")
        plot_convergence(results, figures / "verification_convergence.png")
        text = json.dumps(results, indent=1, allow_nan=True)
        output.with_suffix(".json").write_text(text + "\n", encoding="utf-8")
        output.write_text(page, encoding="utf-8")
    missed = [limit.what for limit in limits(results) if not limit.holds]
    for what in missed:
        print(f"beyond its limit: {what}")
    return 1 if missed else 0


def verification_page(results: Mapping[str, Any]) -> str:
    """The page, from the results of `run_verification` alone."""
    foods = results["foods"]
    hold, gradient = results["hold"], results["gradient"]
    beam, mesh, step = results["beam"], results["mesh"], results["step"]
    return PAGE.format(
        command=COMMAND,
        limits=_rows(
            (x.what, _short(x.value), f"{x.bound:g}", "yes" if x.holds else "**no**")
            for x in limits(results)
        ),
        patch=_rows(
            (r["name"], r["elements"], *(f"{r[k]:.1e}" for k in ("inside", "surface", "rigid")))
            + (f"{r['one_body']:.1e}",)
            for r in results["patch"]
        ),
        beam=_rows(
            (n, f"{ratio:.3f}", order)
            for n, ratio, order in zip(
                beam["divisions"], beam["ratio"], ["-", *map(_order, beam["order"])], strict=True
            )
        ),
        edge=_rows(
            (r["divisions"], f"{r['draw_ratio']:g}", _ratio(r["vertical"]), _ratio(r["along"]))
            + (_percent(r["ripple"]), _ratio(r["work"]))
            for r in results["edge"]
        ),
        friction=_rows(
            (r["divisions"], f"{r['friction']:g}", f"{r['draw_ratio']:g}", _ratio(r["vertical"]))
            + (_ratio(r["along"]), f"{r['share']:.2f}")
            for r in results["friction"]
        ),
        hold_force=f"{hold['force']:.1f}",
        hold_duration=f"{hold['duration']:g}",
        hold_drift=_percent(hold["drift"]),
        hold_creep=f"{hold['creep']:.1e}",
        gradient_exchanges=gradient["exchanges"],
        gradient_parameters=gradient["parameters"],
        gradient_largest=f"{gradient['largest']:.1e}",
        gradient_worst=gradient["worst"],
        mesh_estimate=_percent(mesh["estimate"]),
        step_estimate=_percent(step["estimate"]),
        mesh=_rows(
            (f"{h:.3g}", n, error, order)
            for h, n, (error, order) in zip(
                mesh["size"], mesh["elements"], _errors(mesh), strict=True
            )
        ),
        step=_rows(
            (f"{1e3 * h:.4g}", error, order)
            for h, (error, order) in zip(step["size"], _errors(step), strict=True)
        ),
        curves=_rows(
            (food["name"] if name == "measured" else "", name)
            + ("-" if name == "measured" else f"{curve['rms']:.2f}", f"{curve['peak']:.1f}")
            + (f"{curve['work']:.0f}",)
            for food in foods
            for name in CURVES
            for curve in [food["curves"][name]]
        ),
        parameters=_rows(
            (food["name"], f"{food['toughness']:.0f}", f"{1e-6 * food['youngs_modulus']:.2f}")
            + (f"{food['friction']:.3f}", f"{food['skin']:.3f}", f"{food['contact_time']:.3f}")
            + (f"{food['softness']:.2f}", food["budget"]["elements"], _verdict(food))
            for food in foods
        ),
        budgets=_rows(map(_budget, foods)),
        measured_work=_listing(f"{food['curves']['measured']['work']:.0f}" for food in foods),
        edge_shares=_listing(
            f"{_percent(food['budget']['edge'] / food['budget']['work'])} ({food['name']})"
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
    return (food["name"], _percent(b["cut"]), *numbers, _percent(b["imbalance"]))


def _errors(refinement: Mapping[str, Any]) -> list[tuple[str, str]]:
    errors = [*map(_percent, refinement["error"]), "reference"]
    return list(zip(errors, ["-", *map(_order, refinement["order"]), "-"], strict=True))


def _rows(rows: Iterable[Sequence[object]]) -> str:
    return "\n".join("| " + " | ".join(str(cell) for cell in row) + " |" for row in rows)


def _short(value: float) -> str:
    return f"{value:.1e}" if value < 1e-3 else f"{value:.3g}"


def _percent(value: float) -> str:
    return f"{100.0 * value:.2g} %" if abs(value) < 0.1 else f"{100.0 * value:.0f} %"


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
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (name, cut) in zip(figure.subplots(1, len(cuts)), cuts, strict=True):
        profile, comparison = cut.profile, cut.comparison
        axes.plot(profile.time, profile.force, color="#000000", lw=2.0, label="measured")
        for reference, colour, style in (("DiSECt", "#D55E00", "--"), ("spring", "0.6", ":")):
            force = profile.references[reference]
            rms = float(np.sqrt(np.mean((force - profile.force) ** 2)))
            label = f"{'calibrated DiSECt' if reference == 'DiSECt' else reference}: {rms:.2f} N"
            axes.plot(profile.time, force, style, color=colour, lw=1.5, label=label)
        label = f"ours: {comparison.rms:.2f} N"
        axes.plot(profile.time, comparison.simulated, color="#0072B2", lw=1.5, label=label)
        axes.set_title(name, loc="left", fontsize=11)
        axes.set_xlabel("time [s]")
        axes.set_ylim(0.0, 1.45 * max(profile.force.max(), comparison.simulated_peak))
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(
            frameon=False, fontsize=8, loc="upper left", title="RMS error", title_fontsize=8
        )
    figure.axes[0].set_ylabel("force on the knife [N]")
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=130)


def plot_convergence(results: Mapping[str, Any], file: Path) -> None:
    """Draws the errors of `refine_mesh` and `refine_step`.

    Args:
        results: Of `run_verification`.
        file: PNG to write.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.4, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 2)
    mesh, step = results["mesh"], results["step"]
    parts = (
        (mesh, 1.0, "edge length over the default [1]", 2.0, "mesh, with the step"),
        (step, 1e3, "time step [ms]", 1.0, "step, on the default mesh"),
    )
    for axes, (part, scale, label, slope, title) in zip(panels, parts, strict=True):
        size = scale * np.array(part["size"][:-1])
        error = 100.0 * np.array(part["error"])
        axes.loglog(size, error, "o-", color="#0072B2", label="against the finest")
        guide = error[0] * (size / size[0]) ** slope
        axes.loglog(size, guide, "--", color="0.5", label=f"order {slope:g}")
        axes.set_xticks(size, [f"{x:.3g}" for x in size])
        axes.set_yticks(error, [f"{e:.2g}" for e in error])
        axes.minorticks_off()
        axes.set_xlabel(label)
        axes.set_title(title, loc="left", fontsize=11)
        axes.grid(alpha=0.25, which="both")
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, fontsize=8)
    panels[0].set_ylabel("RMS error of the force [%]")
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=130)
