"""Calibrate a food from slice records (NAME.csv and NAME.yaml, see docs/reference/records.md).

Compares structures of the food (skin, puncture, blunt edge, core, compliance, support) on depth
that is left out, says why it takes or leaves each, polishes what it took with Gauss-Newton, and
says how sure it is. With --structure setup it keeps the setup's, searches with Optuna's TPE and
refines the best places with Adam on the exact gradient. Without --food the record says name, shape
and size. Writes to DIR:
  food.yaml         the calibrated food: scenarios load it with `calibration: DIR/food.yaml`; from
                    two records on with what the simulation gets wrong in them, for a diagnosis of
                    later ones
  calibration.json  errors by stage, held-out errors, parameters
  first_fit.png     a fit on a coarse mesh, after a few seconds: do record and setup go together?
  fit.png           measured and predicted force
  structure.json    what was compared, and setup.yaml, the setup with what was taken
  points.csv        with --per-point: factors of the cut points' toughness
  trials.log        all trials of a search; a run that was killed goes on, and so do others
  adam-*.npz        checkpoints of Adam

Several machines: give all the same --storage and different --seed, as
  PGPASSWORD=... sliceit calibrate records/*.csv --food cucumber --output a \\
    --storage postgresql://user@host/sliceit --seed 1
PostgreSQL needs pip install 'sliceit_drake[database]'; what it gains: docs/how_to/scaling.md.
A journal file (--storage trials.log) serves several processes that share a file system.

  sliceit calibrate calibration/records/cucumber.csv --food cucumber --output output/cucumber
  sliceit calibrate --show cucumber

A food that nobody recorded, from published levels in its setup:
  sliceit calibrate --food carrot --literature --output output/carrot
"""

import argparse
import math
import os
from typing import TYPE_CHECKING

from sliceit_drake.cli.arguments import (
    DIAGNOSIS_REFINEMENT,
    WORKERS,
    add_output_folder,
    check_numbers,
)
from sliceit_drake.cli.progress import StageBars
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.resources import here_or_shipped

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sliceit_drake.calibration.result import Calibration
    from sliceit_drake.calibration.setup import CalibrationSetup
    from sliceit_drake.records.slice_record import SliceRecord

__all__ = ["add_arguments", "run"]

TRIALS = 500
"""Of a search."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's arguments."""
    parser.add_argument(
        "records", metavar="RECORD", nargs="*", type=here_or_shipped, help="NAME.csv or folder"
    )
    parser.add_argument(
        "--food",
        metavar="NAME",
        help="a setup by name, or a YAML file of one (default: what the first record says)",
    )
    parser.add_argument(
        "--other-food",
        action="store_true",
        help="records of a food of another name than the setup's are meant",
    )
    add_output_folder(parser, "where the results go")
    parser.add_argument("--show", metavar="NAME", help="print a calibrated food and stop")
    parser.add_argument(
        "--literature",
        action="store_true",
        help="take the setup's published levels in place of records",
    )
    parser.add_argument(
        "--start",
        metavar="NAME",
        help="polish a calibrated food, by name or YAML file, in place of a search",
    )
    parser.add_argument(
        "--structure",
        choices=("choose", "setup"),
        help="choose it from the curves, or keep that of the setup (default: choose; with "
        "--trials, --storage or --start: setup)",
    )
    parser.add_argument("--trials", type=int, help=f"of the search (default {TRIALS})")
    parser.add_argument("--steps", type=int, default=100, help="of Adam (default 100)")
    parser.add_argument("--starts", type=int, default=2, help="places refined (default 2)")
    parser.add_argument("--seed", type=int, default=0, help="of the search (default 0)")
    parser.add_argument(
        "--workers", type=int, default=os.cpu_count() or 1, help="processors (default: all)"
    )
    parser.add_argument("--storage", metavar="URL", help="journal file or URL shared by workers")
    parser.add_argument(
        "--hold-out",
        metavar="NAME",
        nargs="+",
        default=[],
        help="records that are predicted but not fitted",
    )
    parser.add_argument(
        "--per-point",
        metavar="STEPS",
        type=int,
        default=0,
        help="then fit a toughness for each cut point, STEPS of Adam (points.csv; default: not)",
    )
    parser.add_argument(
        "--blocks",
        type=int,
        default=5,
        help="blocks of depth held out in turn (default 5; 0: none)",
    )
    parser.add_argument(
        "--block-length",
        metavar="METRES",
        type=float,
        help="hold out every --blocks-th piece of this depth together (default: whole blocks)",
    )
    parser.set_defaults(resumes=True)


def run(options: argparse.Namespace) -> int:
    """Runs the command."""
    if options.show:
        return _show(options.show)
    for name in ("food", "output"):
        if getattr(options, name) is None and (name != "food" or options.literature):
            raise ConfigurationError(
                "is not given", field=f"--{name}", fix=f"Give --{name}; see --help."
            )
    if options.structure is None:
        beside = (options.trials, options.storage, options.start)
        options.structure = "choose" if beside == (None, None, None) else "setup"
    options.trials = TRIALS if options.trials is None else options.trials
    any_number, some = (0, math.inf), (1, math.inf)
    check_numbers(options, trials=some, starts=some, workers=WORKERS, seed=(0, 2**32 - 1))
    check_numbers(options, steps=any_number, blocks=any_number, per_point=any_number)
    check_numbers(options, block_length=(1e-4, 1.0))
    return _from_literature(options) if options.literature else _calibrate(options)


def _from_literature(options: argparse.Namespace) -> int:
    import datetime

    from sliceit_drake.calibration.literature import food_from_literature
    from sliceit_drake.calibration.setup import load_setup
    from sliceit_drake.configuration import dump_yaml

    setup = load_setup(options.food)
    trials = options.trials
    with StageBars() as bars:
        food = food_from_literature(
            setup, trials, options.seed, lambda done: bars.show("cuts", done, trials)
        )
    food.date = datetime.date.today().isoformat()
    food.command = (
        f"sliceit calibrate --food {options.food} --literature --trials {trials} "
        f"--seed {options.seed}"
    )
    options.output.mkdir(parents=True, exist_ok=True)
    dump_yaml(food, options.output / "food.yaml")
    print(food.distribution.table())
    print(food.note)
    print(f"Results in {options.output}/")
    return 0


def _show(name: str) -> int:
    from sliceit_drake.cutting.foods.calibrated_food import load_calibrated_food

    food = load_calibrated_food(name)
    print(f"{food.food.name}, from {', '.join(food.records)} ({food.date})")
    print(food.command)
    print(food.distribution.table())
    for label, value in (("on the records", food.rms_error), ("held out", food.held_out_error)):
        if value is not None:
            print(f"RMS error {label}: {value:.3f} N")
    if food.spring is not None:
        print(f"Spring-only baseline: {food.spring.stiffness:.0f} N/m")
    if food.note:
        print(food.note)
    return 0


def _calibrate(options: argparse.Namespace) -> int:
    import shlex
    import sys

    from sliceit_drake.calibration.calibrate import CalibrationOptions, calibrate, values_of
    from sliceit_drake.calibration.setup import load_setup, setup_of_record
    from sliceit_drake.calibration.storage import open_storage, without_password
    from sliceit_drake.calibration.structure import choice_in, puncture_lines
    from sliceit_drake.cutting.foods.calibrated_food import load_calibrated_food
    from sliceit_drake.prediction.record_set import check_foods, check_same_slice, one_of_each
    from sliceit_drake.records.validation import check_record, load_record, record_files

    setup = None if options.food is None else load_setup(options.food)
    records = [load_record(file) for path in options.records for file in record_files(path)]
    if not records:
        raise ConfigurationError("no record is given", field="RECORD", fix="Name one.")
    cuts = [record for record in records if record.cut_rows.any()]
    names = [record.name for record in cuts]
    if idle := [record.name for record in records if record.name not in names]:
        print(f"Not fitted, since no phase of theirs cuts food: {', '.join(idle)}")
    if not cuts:
        raise ConfigurationError(
            "no phase of any record is labelled slice or second_pass",
            field="motion.phases",
            fix="Give a record of a cut, or label the cut in it (`sliceit records check`).",
        )
    if setup is None:
        setup = setup_of_record(cuts[0])
    check_same_slice(records)
    fix = "Give a setup of {} by --food, or leave --food out"
    check_foods(records, setup.food.name, "setup", fix, options.other_food)
    for record in records:
        for finding in check_record(record):
            print(finding)
    for name in options.hold_out:
        if name not in names:
            raise ConfigurationError(
                f"{name!r} is not among the cuts {', '.join(names)}",
                field="--hold-out",
                fix="Give the names of records that are given.",
            )
    if options.storage is not None:
        # One that cannot be opened is said before anything is computed.
        open_storage(options.storage)
    fitted = [r for r in cuts if r.name not in options.hold_out]
    start = values_of(load_calibrated_food(options.start)) if options.start else None
    warnings: list[str] = []
    if start is None:
        _first_fit(setup, fitted, options)
    if options.structure == "choose":
        with StageBars() as bars:
            bars.show("structures", 0, None)
            choice = choice_in(
                options.output,
                setup,
                one_of_each(fitted),
                options.workers,
                lambda done, all, error: bars.show_error("structures", done, all, error),
            )
        print("\n".join(choice.lines))
        setup, start, warnings = choice.setup, choice.values, choice.warnings
    with StageBars() as bars:
        result = calibrate(
            setup,
            fitted,
            options.output,
            CalibrationOptions(
                trials=options.trials,
                steps=options.steps,
                starts=options.starts,
                seed=options.seed,
                workers=options.workers,
                storage=options.storage,
                blocks=options.blocks,
                block_length=options.block_length,
                start=start,
            ),
            [r for r in cuts if r.name in options.hold_out],
            bars.show_error,
        )
    if options.structure == "setup":
        warnings = puncture_lines(setup, result.predictor.targets)
    # The command is kept with the food, for others to read.
    command = shlex.join(["sliceit", *(without_password(a) for a in sys.argv[1:])])
    result.save(options.output, command)
    print("\n".join([result.table(), *(f"Warning: {text}" for text in warnings)]))
    if options.per_point:
        _fit_points(options, result)
    if len(fitted) > 1:
        _learn_known_error([r for r in records if r.name not in options.hold_out], options)
    print(f"Results in {options.output}/")
    return 0


def _first_fit(
    setup: "CalibrationSetup", records: "Sequence[SliceRecord]", options: argparse.Namespace
) -> None:
    """Draws a first fit. Where there is none, a search may still find what can be cut."""
    from sliceit_drake.calibration.first_fit import first_fit
    from sliceit_drake.cutting.solver import CuttingError

    try:
        with StageBars() as bars:
            found = first_fit(
                setup, records, options.workers, lambda done, all: bars.show("first fit", done, all)
            )
    except CuttingError as error:
        print(f"No first fit: {error}")
        return
    options.output.mkdir(parents=True, exist_ok=True)
    found.save(options.output / "first_fit.png")
    print(f"First fit, on a coarse mesh: {found.rms:.3f} N, {options.output}/first_fit.png")


def _learn_known_error(records: "Sequence[SliceRecord]", options: argparse.Namespace) -> None:
    """Adds to food.yaml what the simulation gets wrong by itself in the records."""
    from sliceit_drake.configuration import dump_yaml
    from sliceit_drake.cutting.foods.calibrated_food import load_calibrated_food
    from sliceit_drake.cutting.solver import CuttingError
    from sliceit_drake.diagnosis.diagnose import setup_of_food
    from sliceit_drake.diagnosis.known_error import learn_known_error

    file = options.output / "food.yaml"
    food = load_calibrated_food(file)
    try:
        with StageBars("what it gets wrong: ") as bars:
            food.known_error = learn_known_error(
                setup_of_food(food, DIAGNOSIS_REFINEMENT),
                records,
                workers=options.workers,
                progress=bars.show,
                other_food=options.other_food,
            )
    except (ConfigurationError, CuttingError) as error:
        print(f"What the simulation gets wrong is not in food.yaml: {error}")
        return
    dump_yaml(food, file)


def _fit_points(options: argparse.Namespace, result: "Calibration") -> None:
    """Fits a toughness for each cut point and writes it."""
    from sliceit_drake.calibration.per_point import fit_points

    steps = options.per_point
    with StageBars() as bars:
        points = fit_points(
            result.predictor,
            result.unit,
            steps,
            lambda done, error: bars.show_error("each point", done, steps, error),
        )
    points.save(options.output / "points.csv")
    print(
        f"With a toughness for each of {len(points.factors)} cut points: RMS {points.rms:.3f} N, "
        "on the records that they were fitted to"
    )
