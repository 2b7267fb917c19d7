"""What a diagnosis takes: python studies/diagnosis/diagnosis_speed.py [--json FILE].

Records the 18 slices of the rich protocol, with nothing hidden, and has `sliceit diagnose` look at
them with all causes, twice: first with nothing computed before, then with what it has kept.
docs/benchmarks.md shows what --json docs/benchmarks/diagnosis_speed.json writes.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from studies.results import write_results


def sliceit(*arguments: str) -> float:
    """Time of a command, s."""
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-m", "sliceit_drake.cli.main", *arguments], check=True)
    return time.perf_counter() - begin


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--json", type=Path, help="also write the values there")
    options = parser.parse_args()
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
    if options.json is not None:
        write_results(options.json, values)


if __name__ == "__main__":
    main()
