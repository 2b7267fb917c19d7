"""`sliceit diagnose`: show what the simulation gets wrong, and name the cause."""

import argparse
import os
from pathlib import Path

from sliceit_drake.cli.progress import StageBars

__all__ = ["add_parser"]

DESCRIPTION = """\
Compare slice records with a calibrated food, name what causes the difference and measure the gain.

RECORDS_DIR holds slice records (docs/records.md), best three or more of each condition at several
speeds, with a hold, a withdrawal and draws. Writes to DIR:
  diagnosis.json  verdict, evidence, values, errors
  report.html     prediction against measurement, evidence, angles between causes; opens anywhere
  extended.yaml   the food with the cause in it: `calibration: DIR/extended.yaml` in a scenario

The verdict is one of: nothing beyond noise; a cause (or two) with size; a class of causes that
these records cannot tell apart, and the experiment that would; unknown; too few replicates.

  sliceit diagnose records/monday --model cucumber --output output/diagnosis
"""


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the command."""
    parser = commands.add_parser(
        "diagnose",
        help="show what the simulation gets wrong in records, and name the cause",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("records", metavar="RECORDS_DIR", type=Path)
    parser.add_argument(
        "--model", metavar="FOOD", required=True, help="a calibrated food by name, or its YAML file"
    )
    parser.add_argument("--output", metavar="DIR", type=Path, required=True)
    parser.add_argument(
        "--cause", metavar="FILE", type=Path, action="append", default=[], help="a cause of yours"
    )
    parser.add_argument(
        "--refinement",
        type=float,
        default=1.0,
        help="elements along an edge, relative to the food's mesh (default 1)",
    )
    parser.add_argument(
        "--replicates", type=int, default=200, help="of the bootstrap (default 200)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the bootstrap (default 0)")
    parser.add_argument("--cache", metavar="DIR", type=Path, help="default: DIR of the output")
    parser.add_argument(
        "--workers", type=int, default=os.cpu_count() or 1, help="processors (default: all)"
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Runs the command."""
    from sliceit_drake.configuration import ConfigurationError
    from sliceit_drake.diagnosis.diagnose import diagnose, setup_of_food
    from sliceit_drake.diagnosis.registry import load_cause
    from sliceit_drake.diagrams.calibrated_food import load_calibrated_food
    from sliceit_drake.records.validation import load_records

    if not options.records.is_dir():
        raise ConfigurationError(
            "is no folder", source=str(options.records), fix="Give a folder of slice records."
        )
    records = load_records(options.records)
    setup = setup_of_food(load_calibrated_food(options.model), options.refinement)
    with StageBars() as bars:
        result = diagnose(
            setup,
            records,
            [load_cause(file) for file in options.cause],
            options.cache or options.output / "cache",
            options.replicates,
            options.seed,
            options.workers,
            bars.show,
        )
    print(result.table())
    result.save(options.output)
    print(f"Results in {options.output}/: diagnosis.json, extended.yaml, report.html")
    return 0
