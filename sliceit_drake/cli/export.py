"""`sliceit export`: the run of a folder as a series for ParaView."""

import argparse
import logging
from pathlib import Path

__all__ = ["add_parser"]

AGREES = 1e-6
"""Difference of the force from the record's, N, up to which the run is the same: it is printed with
eight digits."""

DESCRIPTION = """\
Write a run that `sliceit simulate` left in FOLDER as a time series for ParaView.

FOLDER has the scenario and the record, not the food's states: the scenario is simulated once more,
which repeats it bit for bit on the same machine and version, and its force is compared with
FOLDER/record.csv. To do without, give `sliceit simulate --paraview vtu`.

Writes to DIR (docs/paraview.md):
  run.pvd and *.vtu   with --format vtu (the default): open run.pvd
  food.xdmf, knife.xdmf, force.xdmf   with --format xdmf

  sliceit export output/cucumber
  sliceit export output/cucumber --format xdmf --fps 10 --output /tmp/series
"""


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the command."""
    parser = commands.add_parser(
        "export",
        help="write a run as a series for ParaView",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="of `sliceit simulate`")
    parser.add_argument("--format", choices=("vtu", "xdmf"), default="vtu", help="default: vtu")
    parser.add_argument("--fps", type=float, default=30.0, help="frames a second (default 30)")
    parser.add_argument(
        "--output", metavar="DIR", type=Path, help="default: paraview, in the folder"
    )
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    """Runs the command."""
    from sliceit_drake.configuration import ConfigurationError

    for name in ("scenario.yaml", "record.csv"):
        if not (options.folder / name).is_file():
            raise ConfigurationError(
                f"there is no {name}",
                source=str(options.folder),
                fix="Give the folder that `sliceit simulate --output FOLDER` wrote.",
            )

    import numpy as np
    from tqdm import tqdm

    from sliceit_drake.diagrams.outputs.paraview import FoodFrames, write_series
    from sliceit_drake.diagrams.run import prepare_run
    from sliceit_drake.diagrams.scenario import load_scenario
    from sliceit_drake.tables import read_columns

    logging.getLogger("drake").setLevel(logging.WARNING)
    kept = read_columns(options.folder / "record.csv", ["time", "food_wrench_f_z"])
    prepared = prepare_run(load_scenario(options.folder / "scenario.yaml"))
    frames = FoodFrames(prepared, options.fps)
    duration = float(kept["time"][-1])
    shown = "{desc}: {percentage:3.0f}%|{bar}| {n:.2f}/{total:.2f} s"
    with tqdm(total=duration, desc=prepared.scenario.name, bar_format=shown) as bar:
        prepared.advance(duration, lambda time, _: (bar.update(time - bar.n), None)[1])
    force = prepared.record()["food_wrench_f_z"]
    count = min(len(force), len(kept["time"]))
    difference = float(np.abs(force[:count] - kept["food_wrench_f_z"][:count]).max())
    if difference > AGREES * max(1.0, float(np.abs(force).max())):
        print(
            f"This run differs from the record by up to {difference:.3g} N: it was made by another"
            " version or on another machine. The series is of this run."
        )
    files = write_series(frames, options.output or options.folder / "paraview", options.format)
    print(f"{len(frames)} frames. Open in ParaView: {', '.join(map(str, files))}")
    return 0
