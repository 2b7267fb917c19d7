"""`python -m studies disect`: the numbers of docs/disect.md."""

import argparse
from pathlib import Path

__all__ = ["add_disect_study"]

DESCRIPTION = """\
The simulator beside DiSECt, in both measures of the knife's force.

Cuts DiSECt's reference case with the opening law alone, set to its parameters, and with the full
model, puts its differences back one by one, and compares with its curves of the measured cuts.
Writes to FOLDER disect.md and figures/disect.png. Takes some minutes.
"""
FOODS = "calibration/verification_foods.yaml"


def add_disect_study(studies: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the study."""
    parser = studies.add_parser(
        "disect",
        help="side by side with DiSECt",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--output", metavar="FOLDER", type=Path, required=True, help="where page and figure go"
    )
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    """Runs the study."""
    import time

    from tqdm import tqdm

    from sliceit_drake.resources import resource_path
    from studies.disect.page import disect_page, plot_disect
    from studies.disect.study import STEPS, disect_study
    from studies.physics.measured_curves import load_measured_foods

    foods = load_measured_foods(resource_path(FOODS)).foods
    begin = time.monotonic()
    with tqdm(total=STEPS + len(foods), desc="cuts") as bar:
        study = disect_study(foods, bar.update)
    minutes = max(1.0, (time.monotonic() - begin) / 60.0)
    figure = options.output / "figures" / "disect.png"
    plot_disect(study, figure)
    file = options.output / "disect.md"
    file.write_text(
        disect_page(study, "python -m studies disect --output docs", minutes), encoding="utf-8"
    )
    print(f"{file} and {figure}")
    return 0
