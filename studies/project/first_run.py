"""A newcomer's first run, and a release.

Builds source distribution and wheel, installs the wheel into an empty environment outside the
checkout (from the index that pip is set to), and calls `sliceit` as a user would who has nothing:
an empty home, an empty folder with a blank in its name, no display. Each stage is timed. Ends with
status 1 if a command fails. docs/results/benchmarks.md shows what --json
docs/results/benchmarks/first_run.json writes.

Needs pip and hatchling. Takes a minute or two, and 2 GB in the folder for temporary files.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from studies.results import add_json_argument, write_results

__all__ = ["add_arguments", "run"]

ROOT = Path(__file__).resolve().parents[2]
SHOW_RECORD = ["diagnose", "calibration/records/cucumber.csv", "--model", "cucumber"]
COMMANDS = (
    ["--help"],
    ["calibrate", "--show", "cucumber"],
    ["records", "check", "calibration/records"],
    ["record", "--list-effects"],
    ["diagram", "--ports"],
    [*SHOW_RECORD, "--output", "diagnosis", "--replicates", "20"],
    ["record", "calibration/protocols/poor.yaml", "--world", "curves", "--output", "records"],
    ["simulate", "scenarios/apple.yaml", "--duration", "0.1", "--no-replay"],
    *([command, "--help"] for command in ("emulate", "hardware", "train")),
)
"""What has to work with the wheel alone."""


def call(
    arguments: list[str], cwd: Path | None = None, env: dict[str, str] | None = None
) -> tuple[float, str]:
    """Runs a program; its time, s, and what it prints.

    Raises:
        SystemExit: It failed.
    """
    begin = time.perf_counter()
    done = subprocess.run(
        arguments, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=cwd, env=env
    )
    if done.returncode != 0:
        sys.exit(f"{' '.join(arguments)} ended with {done.returncode}:\n{done.stdout}")
    return time.perf_counter() - begin, done.stdout


def build(folder: Path) -> tuple[Path, Path]:
    """Source distribution, and the wheel that is made from it."""
    call([sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", str(folder)], cwd=ROOT)
    (source,) = folder.glob("*.tar.gz")
    pip = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation"]
    call([*pip, "-w", str(folder), str(source)], cwd=folder)
    (wheel,) = folder.glob("*.whl")
    return source, wheel


def first_run(folder: Path, python: str) -> dict[str, float]:
    """Times of the stages, s, and sizes, B, with this Python."""
    source, wheel = build(folder)
    home, work, venv = folder / "home", folder / "a folder", folder / "venv"
    home.mkdir()
    work.mkdir()
    values: dict[str, float] = {
        "sdist_bytes": source.stat().st_size,
        "wheel_bytes": wheel.stat().st_size,
    }
    values["environment_s"], _ = call([python, "-m", "venv", str(venv)])
    pip = [str(venv / "bin" / "python"), "-m", "pip", "install", "-q"]
    values["install_s"], _ = call([*pip, "-c", str(ROOT / "constraints.txt"), str(wheel)])
    environment = {"PATH": "/usr/bin:/bin", "HOME": str(home)}
    sliceit = str(venv / "bin" / "sliceit")

    def run(arguments: list[str]) -> float:
        print("sliceit", *arguments, flush=True)
        return call([sliceit, *arguments], cwd=work, env=environment)[0]

    values["first_picture_s"] = run(["simulate"])
    missing = {"force.png", "replay.html"} - {p.name for p in (work / "output/cucumber").iterdir()}
    if missing:
        sys.exit(f"sliceit simulate wrote no {', '.join(missing)}")
    values["second_picture_s"] = run(["simulate"])
    for arguments in COMMANDS:
        run(arguments)
    return values


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument(
        "--python", default=sys.executable, help="that the wheel is installed for (default: this)"
    )
    add_json_argument(parser)


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    with tempfile.TemporaryDirectory() as folder:
        values = first_run(Path(folder), options.python)
    for name, value in values.items():
        print(f"{name}: {value:.4g}")
    write_results(options, values)
    return 0
