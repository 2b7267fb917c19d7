"""Write a run that `sliceit simulate` left in FOLDER as a time series for ParaView.

FOLDER has the scenario and the record, not the food's states: the scenario is simulated once more,
which repeats it bit for bit on the same machine and version, and its force is compared with
FOLDER/record.csv. To do without, give `sliceit simulate --paraview vtu`.

Writes to DIR (docs/how_to/paraview.md):
  run.pvd and *.vtu   with --format vtu (the default): open run.pvd
  food.xdmf, knife.xdmf, force.xdmf   with --format xdmf

  sliceit export output/cucumber
  sliceit export output/cucumber --format xdmf --fps 10 --output /tmp/series
"""

import argparse
import functools
from pathlib import Path

from sliceit_drake.cli.arguments import add_output_folder
from sliceit_drake.cli.progress import SIMULATED_TIME, StageBars

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's arguments."""
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="of `sliceit simulate`")
    parser.add_argument("--format", choices=("vtu", "xdmf"), default="vtu", help="default: vtu")
    parser.add_argument("--fps", type=float, default=30.0, help="frames a second (default 30)")
    add_output_folder(parser, "default: paraview, in the folder")


def run(options: argparse.Namespace) -> int:
    """Runs the command."""
    from sliceit_drake.diagrams.outputs.paraview import run_again, write_series

    folder = options.folder
    with StageBars(bar_format=SIMULATED_TIME) as bars:
        show = functools.partial(bars.show, folder.name)
        frames, difference = run_again(folder, options.fps, show)
    if difference is not None:
        print(
            f"This run differs from the record by up to {difference:.3g} N, as one of another"
            " version or machine can. The series is of this run."
        )
    output = options.output or folder / "paraview"
    files = write_series(frames, output, options.format)
    print(f"{len(frames)} frames. Open in ParaView: {', '.join(map(str, files))}")
    return 0
