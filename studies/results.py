"""What a study measured, as JSON."""

import argparse
import dataclasses as dc
import json
import os
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["add_json_argument", "describe_machine", "plain", "write_json", "write_results"]

QUIET = 0.5
"""Load above which other work is in the numbers too."""


def add_json_argument(parser: argparse.ArgumentParser) -> None:
    """Adds --json."""
    parser.add_argument("--json", metavar="FILE", type=Path, help="also write the values there")


def write_results(options: argparse.Namespace, values: Mapping[str, float]) -> None:
    """Writes values where --json says, with the command, the machine and its load.

    Args:
        options: With `json`, None for nowhere, and `command`.
        values: By name, the unit at the end of it.
    """
    if options.json is None:
        return
    load = f"load {os.getloadavg()[0]:.1f} at the end"
    facts = {
        "command": options.command,
        "machine": f"{os.cpu_count()} cores ({platform.machine()}), {load}",
        "values": {name: float(f"{value:.4g}") for name, value in values.items()},
    }
    write_json(options.json, facts)


def write_json(file: Path, results: object) -> None:
    """Writes results, made `plain`; the folder is made."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(plain(results), indent=1) + "\n", encoding="utf-8")


def plain(value: Any) -> Any:
    """Results as dictionaries, lists, strings and numbers to six digits.

    Args:
        value: Of these, or of dataclasses, tuples and arrays.
    """
    if dc.is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in dc.fields(value)}
    if isinstance(value, dict):
        return {name: plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    return float(f"{value:.6g}") if isinstance(value, float) else value


def describe_machine() -> str:
    """Cores and load before a measurement, for the line under a table; warns of other work."""
    load = os.getloadavg()[0]
    text = f"{os.cpu_count()} cores ({platform.machine()}), load {load:.2f} in the minute before"
    if load <= QUIET:
        return text
    print(f"The machine is busy (load {load:.2f}): the numbers will be of that too.")
    return f"{text}, so that other work is in the numbers"
