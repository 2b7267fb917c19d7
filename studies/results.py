"""Writes what a benchmark measured as JSON, for docs/benchmarks.md."""

import json
import os
import platform
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path

__all__ = ["write_results"]


def write_results(file: Path, values: Mapping[str, float]) -> None:
    """Writes values with the command that measured them, the machine and its load.

    Args:
        file: Made, with its folder.
        values: By name, the unit at the end of it.
    """
    load = f"load {os.getloadavg()[0]:.1f} at the end"
    facts = {
        "command": shlex.join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *sys.argv[1:]]),
        "machine": f"{os.cpu_count()} cores ({platform.machine()}), {load}",
        "values": {name: float(f"{value:.4g}") for name, value in values.items()},
    }
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
