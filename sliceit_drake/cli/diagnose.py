"""Compare slice records with a calibrated food, name what causes the difference, measure the gain.

RECORDS_DIR holds slice records (docs/reference/records.md), or is one; best three or more of each
condition at several speeds, with a hold, a withdrawal and draws. Writes to DIR:
  diagnosis.json  verdict, evidence, values, errors
  report.html     prediction against measurement, evidence, angles between causes; opens anywhere
  extended.yaml   the food and its bench with the cause in them: `calibration: DIR/extended.yaml`
                  in a scenario

The verdict is one of: nothing beyond noise; one to three causes with size; a group of causes that
these records cannot tell apart, and the experiment that would; unknown; too few replicates. For a
single record it is `one_slice`: what that slice shows, and no diagnosis; no food is extended by it.

With --next-experiment FILE it writes what to cut next: a scenario for `sliceit simulate`, for
`sliceit record` and for the robot, with the angles to expect and the number of slices. This
simulates a menu of motions, some 200 slices for a group of three causes. Old and new records are
then diagnosed together; give the folders in the order in which they were recorded.

  sliceit diagnose records/monday --model cucumber --output output/diagnosis
  sliceit diagnose records/monday --model cucumber --output output/a --next-experiment next.yaml
  sliceit diagnose records/monday records/tuesday --model cucumber --output output/b
  sliceit diagnose records/monday --model cucumber --output output/c \\
      --backend dask --scheduler tcp://192.168.0.5:8786
"""

import argparse
import functools
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sliceit_drake.cli.arguments import (
    DIAGNOSIS_REFINEMENT,
    SEEDS,
    WORKERS,
    add_cluster_arguments,
    add_output_folder,
    check_numbers,
    cluster_of,
)
from sliceit_drake.cli.progress import StageBars
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.output_folder import check_folder
from sliceit_drake.resources import here_or_shipped

if TYPE_CHECKING:
    from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood
    from sliceit_drake.records.slice_record import SliceRecord

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's arguments."""
    parser.add_argument(
        "records",
        metavar="RECORDS_DIR",
        type=here_or_shipped,
        nargs="+",
        help="folder of records; sessions in order",
    )
    parser.add_argument(
        "--model", metavar="FOOD", required=True, help="a calibrated food by name, or its YAML file"
    )
    add_output_folder(parser, "where results go", required=True)
    parser.add_argument(
        "--cause", metavar="FILE", type=Path, action="append", default=[], help="a cause of yours"
    )
    parser.add_argument(
        "--other-food",
        action="store_true",
        help="records of a food of another name than the model's are meant",
    )
    parser.add_argument(
        "--next-experiment", metavar="FILE", type=Path, help="write what to cut next, as a scenario"
    )
    parser.add_argument(
        "--refinement",
        type=float,
        default=DIAGNOSIS_REFINEMENT,
        help="elements along an edge for changes of the force, relative to the food's mesh; the"
        " force itself is computed with one and a half times as many (default 0.75)",
    )
    parser.add_argument("--no-report", action="store_true", help="write no report.html")
    parser.add_argument(
        "--replicates", type=int, default=200, help="of the bootstrap (default 200)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the bootstrap (default 0)")
    parser.add_argument("--cache", metavar="DIR", type=Path, help="default: DIR of the output")
    parser.add_argument(
        "--workers", type=int, default=os.cpu_count() or 1, help="processors (default: all)"
    )
    add_cluster_arguments(parser, "threads", "slices are simulated")
    parser.set_defaults(resumes=True)


def run(options: argparse.Namespace) -> int:
    """Runs the command."""
    from sliceit_drake.cutting.foods.calibrated_food import load_calibrated_food
    from sliceit_drake.diagnosis.registry import load_cause
    from sliceit_drake.prediction.cluster import on_cluster
    from sliceit_drake.records.validation import load_sessions

    for folder in options.records:
        if not folder.is_dir() and folder.suffix not in (".csv", ".yaml"):
            raise ConfigurationError(
                "is no folder", source=str(folder), fix="Give folders of slice records."
            )
    ranges = {"refinement": (0.2, 4.0), "replicates": (1, 100_000)}
    check_numbers(options, workers=WORKERS, seed=SEEDS, **ranges)
    cluster = cluster_of(options, on_cluster)
    food = load_calibrated_food(options.model)
    extra = [load_cause(file) for file in options.cause]
    records = load_sessions(options.records)
    # Before hours are spent for what cannot be kept.
    cache = options.cache or options.output / "cache"
    check_folder(options.output, "--output")
    check_folder(cache, "--cache")
    if options.next_experiment is not None:
        check_folder(options.next_experiment.parent, "--next-experiment")
    with cluster as executor, StageBars() as bars:
        settings = {
            "extra": extra,
            "cache": cache,
            "replicates": options.replicates,
            "seed": options.seed,
            "workers": executor or options.workers,
            "progress": bars.show,
        }
        if len(records) == 1:
            return _one_slice(options, food, records[0], settings)
        return _diagnose(options, food, records, settings)


def _diagnose(
    options: argparse.Namespace,
    food: "CalibratedFood",
    records: "list[SliceRecord]",
    settings: dict[str, Any],
) -> int:
    """Diagnoses several slices."""
    from sliceit_drake.diagnosis.diagnose import diagnose, setup_of_food
    from sliceit_drake.diagnosis.experiments.next_experiment import next_experiment
    from sliceit_drake.diagrams.planned_scenario import scenario_of_slice

    setup = setup_of_food(food, options.refinement)
    result = diagnose(
        setup, records, **settings, other_food=options.other_food, known=food.known_error
    )
    if options.next_experiment is not None:
        show = functools.partial(settings["progress"], "motions of the menu")
        result.next_experiment = next_experiment(
            result, records, settings["cache"], settings["workers"], show
        )
        result.next_experiment.write(options.next_experiment, scenario_of_slice)
    print(result.sentence())
    print(result.table())
    result.save(options.output, not options.no_report)
    report = "" if options.no_report else ", report.html"
    print(f"Results in {options.output}/: diagnosis.json, extended.yaml{report}")
    return 0


def _one_slice(
    options: argparse.Namespace,
    food: "CalibratedFood",
    record: "SliceRecord",
    settings: dict[str, Any],
) -> int:
    """Says what one slice shows."""
    from sliceit_drake.diagnosis.input_checks import check_records
    from sliceit_drake.diagnosis.one_slice.diagnose_slice import diagnose_slice, setup_of_slice

    if options.next_experiment is not None:
        raise ConfigurationError(
            "one slice carries no diagnosis that an experiment could follow from",
            field="--next-experiment",
            fix="Leave it out: the table says what is needed first. With two records or more the"
            " scenario is written.",
        )
    remarks = check_records([record], food.food, options.other_food)
    setup = setup_of_slice(food, options.refinement)
    result = diagnose_slice(setup, record, **settings, remarks=remarks)
    print(result.table())
    result.save(options.output)
    print(f"Results in {options.output}/: diagnosis.json, report.html")
    return 0
