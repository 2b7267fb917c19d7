"""`python -m studies real`: what the simulation gets wrong in the paper's three measured slices."""

import argparse
import os
from pathlib import Path

from sliceit_drake.cli.progress import StageBars

__all__ = ["add_real_study"]

FOODS = ("cucumber", "tomato", "potato")
REPLICATES = 1000

DESCRIPTION = """\
Say what the simulation gets wrong in the paper's cucumber, tomato and potato.

Describes each slice of calibration/records as `sliceit diagnose` does with a single record, with
the calibrated food and with the same food without its layers, and writes to FOLDER
what_the_simulation_gets_wrong.md and figures/one_slice_FOOD.png. Takes some ten minutes.
"""


def add_real_study(studies: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the study."""
    parser = studies.add_parser(
        "real",
        help="what the simulation gets wrong in the paper's measured slices",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
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
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    """Runs the study."""
    from sliceit_drake.cutting.foods.calibrated_food import load_calibrated_food
    from sliceit_drake.diagnosis.input_checks import check_records
    from sliceit_drake.diagnosis.one_slice.diagnose_slice import diagnose_slice, setup_of_slice
    from sliceit_drake.output_folder import check_folder
    from sliceit_drake.records.validation import load_record
    from sliceit_drake.resources import resource_path
    from studies.diagnosis.real_slices import SIMULATIONS, MeasuredSlice, draw, page

    check_folder(options.output, "--output")
    items = []
    for name in options.foods:
        record = load_record(resource_path(f"calibration/records/{name}.csv"))
        food = load_calibrated_food(name)
        remarks = check_records([record], food.food)
        item = MeasuredSlice(name, {})
        for simulation in SIMULATIONS:
            setup = setup_of_slice(food, options.refinement, simulation == "plain")
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
    command = "python -m studies real --output docs"
    if options.refinement != 1.0:
        command += f" --refinement {options.refinement:g}"
    if options.foods != list(FOODS):
        command += f" --foods {' '.join(options.foods)}"
    file.write_text(page(items, REPLICATES, command), encoding="utf-8")
    print(f"{file} and {options.output}/figures/one_slice_FOOD.png")
    return 0
