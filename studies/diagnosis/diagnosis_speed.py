"""What a diagnosis takes.

Records the 18 slices of the rich protocol from a food that relaxes, and has `sliceit diagnose` look
at them with the same food without that, and with all causes, twice: first with nothing computed
before, then with what it has kept.
docs/results/benchmarks.md shows what --json docs/results/benchmarks/diagnosis_speed.json writes.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from sliceit_drake.configuration import dump_yaml
from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood
from sliceit_drake.stand_in.protocol import load_protocol
from studies.results import add_json_argument, write_results

__all__ = ["add_arguments", "run"]

PROTOCOL = "calibration/protocols/rich.yaml"
EFFECT = "bulk_relaxation:0.04"


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
        records, output, food = (
            f"{folder}/{name}" for name in ("records", "diagnosis", "food.yaml")
        )
        sliceit("record", PROTOCOL, "--effect", EFFECT, "--output", records, "--seed", "1")
        cut = load_protocol(PROTOCOL)
        dump_yaml(CalibratedFood(food=cut.food, knife=cut.knife), Path(food))
        diagnose = ("diagnose", records, "--model", food, "--output", output)
        values = {
            "records": len(list(Path(records).glob("*.csv"))),
            "cold_s": sliceit(*diagnose),
            "warm_s": sliceit(*diagnose),
        }
    print(values)
    write_results(options, values)
    return 0
