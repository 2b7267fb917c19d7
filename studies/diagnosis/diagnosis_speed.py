"""What a diagnosis takes.

Records the 18 slices of the rich protocol, with nothing hidden, and has `sliceit diagnose` look at
them with all causes, twice: first with nothing computed before, then with what it has kept.
docs/results/benchmarks.md shows what --json docs/results/benchmarks/diagnosis_speed.json writes.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from studies.results import add_json_argument, write_results

__all__ = ["add_arguments", "run"]


def sliceit(*arguments: str) -> float:
    """Time of a command, s."""
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-m", "sliceit_drake.cli.main", *arguments], check=True)
    return time.perf_counter() - begin


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    add_json_argument(parser)


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    with tempfile.TemporaryDirectory() as folder:
        records, output = f"{folder}/records", f"{folder}/diagnosis"
        sliceit("record", "calibration/protocols/rich.yaml", "--output", records, "--seed", "1")
        diagnose = ("diagnose", records, "--model", "cucumber", "--output", output)
        values = {
            "records": len(list(Path(records).glob("*.csv"))),
            "cold_s": sliceit(*diagnose),
            "warm_s": sliceit(*diagnose),
        }
    print(values)
    write_results(options, values)
    return 0
