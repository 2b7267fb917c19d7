"""What the simulation gets wrong in the paper's cucumber, tomato and potato.

Describes each slice of calibration/records as `sliceit diagnose` does with a single record, with
the calibrated food and with the same food without its layers, and writes to FOLDER
what_the_simulation_gets_wrong.md and figures/one_slice_FOOD.png. Takes some ten minutes.
"""

import argparse
import dataclasses as dc
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sliceit_drake.calibration.setup import CalibrationSetup
from sliceit_drake.cli.progress import StageBars
from sliceit_drake.configuration import unit_of
from sliceit_drake.cutting.foods.calibrated_food import load_calibrated_food
from sliceit_drake.cutting.foods.effects import Effects
from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.diagnosis.cause import EXPERIMENTS
from sliceit_drake.diagnosis.evidence.verdict import DecisionRule
from sliceit_drake.diagnosis.experiments.identifiability import ANGLE, short
from sliceit_drake.diagnosis.input_checks import check_records
from sliceit_drake.diagnosis.one_slice.diagnose_slice import diagnose_slice, setup_of_slice
from sliceit_drake.diagnosis.one_slice.slice_evidence import LEVEL
from sliceit_drake.diagnosis.one_slice.slice_result import MIN_GAIN, OneSlice, slice_figure
from sliceit_drake.output_folder import check_folder
from sliceit_drake.records.validation import load_record
from sliceit_drake.resources import resource_path
from studies.figures import save_figure
from studies.pages import publish, render_and_store

__all__ = ["SIMULATIONS", "MeasuredSlice", "add_arguments", "draw", "page_values", "run"]

FOODS = ("cucumber", "tomato", "potato")
REPLICATES = 1000

SIMULATIONS = {
    "calibrated": "the calibrated food",
    "plain": "the same without skin, core and centre",
}

CLAIMS = (
    ("skin apart (7)", "apart", [("skin", "section_shape"), ("skin", "core")]),
    ("shape and core as one class (11, 12)", "together", [("section_shape", "core")]),
    ("slip apart, as an event (15)", "apart", [("slip", "core")]),
    ("sensor's zero apart (16)", "apart", [("sensor_zero", "material.toughness")]),
    ("delay or height as one class (19, dz)", "together", [("sensor_delay", "own.height")]),
    (
        "relaxation, rate, toughness, gain not apart (1, 2, 6, 17)",
        "together",
        [
            ("viscoelasticity", "material.toughness"),
            ("toughness_rate", "material.toughness"),
            ("sensor_gain", "material.toughness"),
        ],
    ),
    (
        "friction and toughness not apart (4, 6)",
        "together",
        [("material.friction", "material.toughness")],
    ),
    ("friction and adhesion not apart (4, 5)", "together", [("material.friction", "adhesion")]),
    (
        "compliance of the arm and modulus not apart (14, E)",
        "together",
        [("arm_compliance", "material.youngs_modulus")],
    ),
)
"""What a list of causes, made beforehand, says of one push cut at one speed."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument(
        "--output", metavar="FOLDER", type=Path, required=True, help="where page and figures go"
    )
    parser.add_argument(
        "--foods", nargs="+", choices=FOODS, default=list(FOODS), help="default: all"
    )
    parser.add_argument(
        "--refinement",
        type=float,
        default=1.0,
        help="elements along an edge, relative to the food's mesh (default 1)",
    )
    parser.add_argument("--cache", metavar="DIR", type=Path, help="keep simulations there")
    parser.add_argument(
        "--workers", type=int, default=os.cpu_count() or 1, help="default: all processors"
    )


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    check_folder(options.output, "--output")
    items = []
    for name in options.foods:
        record = load_record(resource_path(f"calibration/records/{name}.csv"))
        food = load_calibrated_food(name)
        remarks = check_records([record], food.food)
        item = MeasuredSlice(name, {})
        for simulation in SIMULATIONS:
            setup = setup_of_slice(food, options.refinement)
            if simulation == "plain":
                setup = without_layers(setup)
            with StageBars(f"{name}, {simulation}: ") as bars:
                item.results[simulation] = diagnose_slice(
                    setup,
                    record,
                    cache=options.cache,
                    replicates=REPLICATES,
                    workers=options.workers,
                    progress=bars.show,
                    remarks=remarks,
                )
            print(item.results[simulation].table(), end="\n\n")
        draw(item, options.output / "figures")
        items.append(item)
    file = options.output / "what_the_simulation_gets_wrong.md"
    command = "python -m studies real --output docs/results"
    if options.refinement != 1.0:
        command += f" --refinement {options.refinement:g}"
    if options.foods != list(FOODS):
        command += f" --foods {' '.join(options.foods)}"
    results = {i.food: {name: each.facts() for name, each in i.results.items()} for i in items}
    values = page_values(items, REPLICATES, command)
    publish(render_and_store(file.stem, file, values, results), file)
    return 0


def without_layers(setup: CalibrationSetup) -> CalibrationSetup:
    """The same without skin, core and centre, so that the food is the same all through: what is
    fitted is the material and the contact alone."""
    none = Effects()
    effects = dc.replace(setup.food.effects, skin=none.skin, core=none.core, centre=none.centre)
    parameters = [p for p in setup.parameters if not p.name.startswith("effects.")]
    return dc.replace(setup, food=dc.replace(setup.food, effects=effects), parameters=parameters)


@dc.dataclass
class MeasuredSlice:
    """One food.

    Attributes:
        food: Its name.
        results: By the names of `SIMULATIONS`.
    """

    food: str
    results: dict[str, OneSlice]


def draw(item: MeasuredSlice, folder: Path) -> Path:
    """Draws the figure of a food."""
    titles = [f"{item.food}: {SIMULATIONS[name]}" for name in item.results]
    figure = slice_figure(list(item.results.values()), titles)
    file = folder / f"one_slice_{item.food}.png"
    save_figure(figure, file, 110)
    return file


def page_values(items: Sequence[MeasuredSlice], replicates: int, command: str) -> dict[str, object]:
    """What the page shows.

    Args:
        items: One a food.
        replicates: Of the bootstrap.
        command: That wrote it.
    """
    return dict(
        command=command,
        replicates=replicates,
        level=LEVEL,
        least=100 * MIN_GAIN,
        tetrahedra=", ".join(f"{i.food} {i.results['plain'].elements}" for i in items),
        simulations=" and ".join(f"*{k}* ({v})" for k, v in SIMULATIONS.items()),
        fits=[_fit_row(i.food, *named) for i in items for named in i.results.items()],
        layers="; ".join(map(_layers, items)),
        foods=[_food(item) for item in items],
        names=[item.food for item in items],
        angle=ANGLE,
        claims=[
            [text, *(_cell(item.results["plain"], expected, pairs) for item in items)]
            for text, expected, pairs in CLAIMS
        ],
        slices=DecisionRule.replicates,
        experiments={
            item.food: ", then ".join(
                f"{EXPERIMENTS[e]} (`{e}`)" for e in item.results["plain"].experiments()[:5]
            )
            for item in items
        },
    )


def _fit_row(food: str, simulation: str, result: OneSlice) -> tuple[str, ...]:
    """Errors of a fit, and what was found in it."""
    causes = "; ".join(" or ".join(map(short, g)) for g in result.supported_classes)
    errors = "; ".join(f"{c.name} {c.confirmed:.2f}" for c in result.supported)
    fit, held_out = (result.error(f) for f in (result.fit.predicted, result.fit.held_out))
    return (food, simulation, f"{fit:.2f}", f"{held_out:.2f}", causes or "none", errors)


def _layers(item: MeasuredSlice) -> str:
    """What the layers of a calibrated food are worth, in a sentence."""
    given, plain = (item.results[k] for k in ("calibrated", "plain"))
    with_them, without = given.error(given.fit.held_out), plain.error(plain.fit.held_out)
    if abs(without - with_them) > MIN_GAIN * without:
        how = "better" if with_them < without else "worse"
        return (
            f"the {item.food}'s predict left-out depth {how} ({with_them:.2f} N with them, "
            f"{without:.2f} N without)"
        )
    return f"the {item.food}'s make no difference there ({with_them:.2f} N and {without:.2f} N)"


def _food(item: MeasuredSlice) -> dict[str, Any]:
    """What the template tells of a food."""
    plain, food = item.results["plain"], load_calibrated_food(item.food).food
    groups = "; ".join("{" + ", ".join(map(short, g)) + "}" for g in plain.classes)
    return {
        "name": item.food,
        "results": [
            {
                "simulation": SIMULATIONS[name],
                "verdict": result.verdict,
                "worst": _worst(result),
                "depths": [
                    (depth, rows, f"{mean:+.2f}", f"{rms:.2f}", f"{out:.2f}")
                    for depth, rows, mean, rms, out in result.by_depth()
                ],
                "evidence": _evidence_rows(result),
                "fitted": _fitted(result, food),
            }
            for name, result in item.results.items()
        ],
        "groups": groups or "nothing that shows",
        "hidden": _list(plain.hidden),
        "drowned": _list(plain.drowned),
    }


def _list(names: Sequence[str]) -> str:
    return ", ".join(names) if names else "nothing"


def _worst(result: OneSlice) -> str:
    """Where most is left, in a sentence."""
    rows = result.by_depth()
    fit = max(rows, key=lambda row: row[3])
    out = max(rows, key=lambda row: row[4])
    noise = result.evidence.noise[0]
    span = float(result.record.time[-1] - result.record.time[0])
    text = (
        f"The residual of the fit is largest at {fit[0]} ({fit[3]:.2f} N RMS, mean {fit[2]:+.2f}"
        f" N), and the error where depth was left out at {out[0]} ({out[4]:.2f} N). The residual"
        f" is correlated over {1e3 * noise.tau:.0f} ms ({noise.ar:.2f} N; {noise.white:.2f} N are"
        " white)."
    )
    if noise.tau > 0.45 * span:
        text += (
            " This is the longest time that was allowed. The residual is then not stationary, and p"
            " cannot be trusted here."
        )
    return text


def _fitted(result: OneSlice, food: Food) -> str:
    shown = []
    for c in result.evidence.causes:
        if c.confirmed is not None:
            values = ", ".join(
                f"{k} {v:.2g} {p.unit}".rstrip()
                for k, v in c.values.items()
                for p in result.causes[c.name].parameters
                if p.name == k and abs(v - p.null) > 1e-3 * p.size
            )
            scan = result.causes[c.name].scan
            at = "" if scan is None or c.scan is None else f" at {scan.name} {c.scan:g} {scan.unit}"
            shown.append(f"`{c.name}`{at.rstrip()}: {values or 'none of it'}")
    base = [
        f"{name.removeprefix('material.').removeprefix('effects.')} {value:.3g} "
        f"{unit_of(food, name)}".rstrip()
        for name, value in result.fit.values("base").items()
    ]
    own = result.fit.values("own")
    text = "Fitted: " + ", ".join(base)
    if "height" in own:
        text += f"; knife {1e3 * own['height']:+.2f} mm lower than the onset of the force suggests"
    if "speed" in own:
        text += f", speed {100 * (np.exp(own['speed']) - 1.0):+.0f} % from nominal"
    return text + (f". With a cause: {'; '.join(shown)}." if shown else ".")


def _cell(result: OneSlice, expected: str, pairs: Sequence[tuple[str, str]]) -> str:
    """Whether it is as expected, with the angle of each pair."""
    angles, names = result.angles, result.angles.names
    out, verdicts = [], []
    for a, b in pairs:
        if a not in names or b not in names:
            continue
        i, j = names.index(a), names.index(b)
        silent = [n for n, k in ((a, i), (b, j)) if not angles.visible[k]]
        if silent:
            out.append(f"{short(silent[0])} does not show")
            verdicts.append(expected == "together")
        else:
            angle = min(angles.angles[i, j], angles.angles[j, i])
            out.append(f"{short(a)} / {short(b)} {angle:.0f} deg")
            verdicts.append(angles.equivalent(i, j) == (expected == "together"))
    return f"{'yes' if all(verdicts) else 'no'}: {'; '.join(dict.fromkeys(out))}"


def _evidence_rows(result: OneSlice, most: int = 8) -> Sequence[tuple[str, ...]]:
    """Evidence of the causes that come nearest."""
    before = result.error(result.fit.held_out)
    blocks = len(np.unique(result.block))
    rows = [("none", "", "", f"{result.evidence.held_out:.2f}", f"{before:.2f}", "", "")]
    names = {c.name for c in result.supported}
    for k, c in enumerate(result.evidence.causes):
        if k >= most and c.confirmed is None:
            continue
        confirmed = ("", "", "")
        if c.confirmed is not None:
            better = f"{c.blocks_better} of {blocks}"
            confirmed = (f"{c.confirmed:.2f}", better, f"{c.without_best:.2f}")
        name = f"**`{c.name}`**" if c.name in names else f"`{c.name}`"
        rows.append((name, f"{c.gain:.1f}", f"{c.p_value:.3f}", f"{c.held_out:.2f}", *confirmed))
    return rows
