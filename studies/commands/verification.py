"""`python -m studies verification`: the numbers of docs/verification.md."""

import argparse
import json
from pathlib import Path

__all__ = ["add_verification"]

DESCRIPTION = """\
The cutting physics against exact solutions, finer computations and the measured cuts.

Prints the page that docs/verification.md holds; takes a few minutes. With --output it also writes
the numbers beside it (.json) and the figures (figures/verification_*.png). Ends with status 1 if
a number is beyond its limit.
"""
FOODS = "calibration/verification_foods.yaml"


def add_verification(studies: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the study."""
    parser = studies.add_parser(
        "verification",
        help="the physics against exact solutions and measured cuts",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
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
    parser.set_defaults(run=_run_verification)


def _run_verification(options: argparse.Namespace) -> int:
    """Runs the verification."""
    from tqdm import tqdm

    from sliceit_drake.resources import resource_path
    from studies.physics import measured_curves as curves
    from studies.physics import verification, verification_page

    file = options.foods or resource_path(FOODS)
    foods = curves.load_measured_foods(file)
    if options.fit:
        for k, case in enumerate(foods.foods):
            with tqdm(total=len(curves.STARTS), desc=f"fit of {case.food.name}") as bar:
                foods.foods[k] = curves.fit_measured_food(case, progress=bar.update)
        curves.save_measured_foods(foods, file, "python -m studies verification --fit")
    with tqdm(total=verification.CHECKS + len(foods.foods), desc="checks") as bar:
        results, cuts = verification.run_verification(foods.foods, lambda: bar.update() and None)
    page = verification_page.verification_page(results)
    print(page)
    if options.output is not None:
        output: Path = options.output
        figures = output.parent / "figures"
        named = [(case.food.name, cut) for case, cut in zip(foods.foods, cuts, strict=True)]
        verification_page.plot_measured_cuts(named, figures / "verification_curves.png")
        verification_page.plot_convergence(results, figures / "verification_convergence.png")
        text = json.dumps(results, indent=1, allow_nan=True)
        output.with_suffix(".json").write_text(text + "\n", encoding="utf-8")
        output.write_text(page, encoding="utf-8")
    missed = [limit.what for limit in verification.limits(results) if not limit.holds]
    for what in missed:
        print(f"beyond its limit: {what}")
    return 1 if missed else 0
