"""`python -m studies coverage`: the numbers of docs/coverage.md."""

import argparse
import shlex
import sys
from pathlib import Path

__all__ = ["add_coverage"]

DESCRIPTION = """\
How often the 90 % intervals of calibrations hold the truth.

Simulates cuts with known parameters and noise, calibrates each set and prints a page of what share
of the intervals holds the truth; half a minute a replicate and processor. With --output it writes
the page (coverage.md) and each replicate as it is done (coverage.jsonl), from which it goes on if
it was stopped. Ends with status 1 if the share is not within 80 to 98 %.
"""


def add_coverage(studies: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the study."""
    parser = studies.add_parser(
        "coverage",
        help="how often intervals of calibrations hold the truth",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--replicates", metavar="N", type=int, default=20, help="calibrations; default: 20"
    )
    parser.add_argument("--workers", metavar="N", type=int, default=2, help="processes; default: 2")
    parser.add_argument(
        "--output", metavar="FOLDER", type=Path, help="write coverage.md and coverage.jsonl there"
    )
    parser.set_defaults(run=_run_coverage, resumes=True)


def _run_coverage(options: argparse.Namespace) -> int:
    """Runs the study."""
    from tqdm import tqdm

    from sliceit_drake.configuration import ConfigurationError
    from studies.calibration import coverage

    if options.replicates < 1 or options.workers < 1:
        raise ConfigurationError(
            "is below 1", field="--replicates or --workers", fix="Give 1 or more."
        )
    file = None
    if options.output is not None:
        options.output.mkdir(parents=True, exist_ok=True)
        file = options.output / "coverage.jsonl"
    problem = coverage.Problem()
    with tqdm(total=options.replicates, desc="replicates") as bar:
        results = coverage.coverage_study(
            problem,
            options.replicates,
            file,
            options.workers,
            lambda done: bar.update(done - bar.n) and None,
        )
    page = coverage.coverage_page(problem, results, shlex.join(["sliceit", *sys.argv[1:]]))
    print(page)
    if options.output is not None:
        (options.output / "coverage.md").write_text(page, encoding="utf-8")
    share = coverage.coverage_share(results)
    return 0 if coverage.LEAST <= share <= coverage.MOST else 1
