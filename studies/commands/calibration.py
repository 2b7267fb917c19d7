"""`python -m studies calibration`: the paper's measured curves, calibrated and compared."""

import argparse
import os
from pathlib import Path

from sliceit_drake.cli.calibrate import fit_points_shown
from sliceit_drake.cli.progress import StageBars

__all__ = ["add_calibration_study"]

FOODS = ("cucumber", "tomato", "potato")

DESCRIPTION = """\
Calibrate the three foods that the paper measured, and compare with its two simulators.

Runs `sliceit calibrate` on calibration/records for each food and writes to FOLDER the table
(calibration.md), the figure (calibration.png), and a folder for each food with what `calibrate`
leaves. A run that was killed goes on where it was. docs/calibration.md explains what comes out.
"""


def add_calibration_study(studies: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the study."""
    parser = studies.add_parser(
        "calibration",
        help="the paper's measured curves, calibrated and compared",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--output", metavar="FOLDER", type=Path, required=True, help="where the results go"
    )
    parser.add_argument(
        "--foods", nargs="+", choices=FOODS, default=list(FOODS), help="default: all"
    )
    parser.add_argument("--trials", type=int, default=500, help="of the search (default 500)")
    parser.add_argument("--steps", type=int, default=100, help="of Adam (default 100)")
    parser.add_argument(
        "--point-steps",
        type=int,
        default=100,
        help="of Adam on a toughness for each cut point (default 100; 0: none)",
    )
    parser.add_argument(
        "--workers", type=int, default=os.cpu_count() or 1, help="default: all processors"
    )
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    """Runs the study."""
    import time

    from sliceit_drake.calibration.calibrate import CalibrationOptions, calibrate
    from sliceit_drake.calibration.setup import load_setup
    from sliceit_drake.records.force_profile import load_force_profile
    from sliceit_drake.records.validation import load_record
    from sliceit_drake.resources import resource_path
    from studies.calibration.comparison import compare, plot_comparisons, table

    comparisons = []
    for food in options.foods:
        record = load_record(resource_path(f"calibration/records/{food}.csv"))
        profile = load_force_profile(
            resource_path(f"calibration/measured/sliceit_real_{food}_force.csv")
        )
        folder = options.output / food
        begin = time.monotonic()
        settings = CalibrationOptions(
            trials=options.trials, steps=options.steps, workers=options.workers
        )
        with StageBars(f"{food}: ") as bars:
            result = calibrate(
                load_setup(food), [record], folder, settings, progress=bars.show_error
            )
        minutes = (time.monotonic() - begin) / 60.0
        command = (
            f"python -m studies calibration --foods {food} --trials {options.trials} --steps "
            f"{options.steps}"
        )
        result.save(folder, command)
        comparison = compare(result, profile, minutes)
        if options.point_steps:
            comparison.per_point_rms = fit_points_shown(result, options.point_steps).rms
        comparisons.append(comparison)
        for line in result.posterior.remarks():
            print(f"{food}: {line}")
    text = table(comparisons) + "\n"
    print(text)
    (options.output / "calibration.md").write_text(text, encoding="utf-8")
    plot_comparisons(comparisons, options.output / "calibration.png")
    return 0
