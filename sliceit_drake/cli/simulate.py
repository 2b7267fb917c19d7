"""Simulate a scenario: the arm moves the knife through the food under compliance control.

Writes to DIR:
  replay.html    the run in 3-D, opens in any browser without a server
  slice.gif      the run as a short animation, with the force below it
  force.png      knife, and force over time and depth beside a measured curve if there is one
  record.csv     joints, poses, wrenches, energies at every coupling step (500 Hz), SI units
  summary.json   peak and mean force, work by mechanism, real-time factor, discretisation error, ...
  scenario.yaml  what was simulated, complete
  paraview/      with --paraview: food, knife and forces as a series for ParaView

In the replay and in the live view (--meshcat) you see:
  blue arrow     force of the food on the knife, at the middle of the edge, 200 N a metre
  orange arrow   force of the board on the knife
  purple arrow   force that the wrist sensor measures, at the flange
  two heads      moments, 20 Nm a metre, in lighter colours
  cut faces      plum where the food is intact, orange half cut, the food's own colour where cut
"Open Controls" > Scene is a tree of what is shown. Untick drake > food > minus (or plus) to look at
the cut face of the other half, wrench for no arrows; tick frames (or give --frames) for the
coordinate frames W world, B robot base, S sensor, K knife, F food.
"""

import argparse
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from sliceit_drake.cli.arguments import (
    add_output_folder,
    add_scenario_arguments,
    output_of,
    scenario_of,
)
from sliceit_drake.cli.progress import SIMULATED_TIME, StageBars
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.output_folder import check_output, results_in
from sliceit_drake.overrides import changed_fields

if TYPE_CHECKING:
    from sliceit_drake.diagrams.scenario import Scenario

__all__ = ["add_arguments", "run"]

WAIT_FOR_BROWSER = 60.0
INTERRUPTED = 130
MEASURED = ("food.", "knife", "board.", "motion.", "calibration", "placement.yaw")
"""Fields of what a measured curve belongs to."""
MESH = (".rings", ".layers", ".refinements", ".name")
"""Fields in these that change nothing which is measured."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's arguments."""
    add_scenario_arguments(parser)
    add_output_folder(parser, "default: output/NAME")
    parser.add_argument("--duration", metavar="S", type=float, help="default: the motion's")
    parser.add_argument(
        "--meshcat",
        action="store_true",
        help="show the run live in a browser, with a slider for its speed and a stop button; says "
        "how to see it by ssh or without a display",
    )
    parser.add_argument(
        "--frames",
        action="store_true",
        help="show coordinate frames at first, live and in the replay",
    )
    parser.add_argument(
        "--paraview",
        choices=("vtu", "xdmf"),
        help="also write DIR/paraview, the run as such a series (docs/how_to/paraview.md)",
    )
    parser.add_argument("--fps", type=float, default=30.0, help="its frames a second (default 30)")
    parser.add_argument("--no-replay", action="store_true", help="do not write replay.html")
    parser.add_argument("--no-animation", action="store_true", help="do not draw slice.gif")


def run(options: argparse.Namespace) -> int:
    """Runs the command."""
    if options.duration is not None and not 0.0 < options.duration < math.inf:
        raise ConfigurationError(
            f"{options.duration} s is not a duration", field="--duration", fix="Give seconds > 0."
        )
    scenario = scenario_of(options)
    directory = output_of(options, scenario.name)
    check_output(directory, is_folder=True)
    if results_in(directory):
        print(f"{directory}/ has the results of an earlier run, which this one replaces")

    from sliceit_drake.diagrams.live_view import (
        FASTEST,
        LiveControls,
        make_meshcat,
        viewing_instructions,
        wait_for_browser,
    )
    from sliceit_drake.diagrams.outputs.paraview import FoodFrames, write_series
    from sliceit_drake.diagrams.run import prepare_run

    meshcat = None if options.no_replay and not options.meshcat else make_meshcat()
    print("Preparing (the first run on a machine compiles the kernels, about 10 s)", flush=True)
    prepared = prepare_run(scenario, meshcat, animation=not options.no_animation)
    prepared.warnings += _changes_beside_measurement(options, scenario)
    if options.frames and meshcat is not None:
        meshcat.SetProperty("/frames", "visible", True)
    if options.meshcat and meshcat is not None:
        prepared.controls = LiveControls(meshcat)
        print(viewing_instructions(meshcat.port()))
        print(
            f'"Open Controls" has the speed, times real time ({FASTEST:g}: no limit), and stop. '
            f"The run starts when a browser shows it, or in {WAIT_FOR_BROWSER:.0f} s.",
            flush=True,
        )
        wait_for_browser(meshcat, WAIT_FOR_BROWSER)
    frames = FoodFrames(prepared, options.fps) if options.paraview else None
    duration = options.duration or prepared.motion.duration
    with StageBars(bar_format=SIMULATED_TIME) as bars:
        prepared.advance(
            duration,
            lambda time, wall: bars.show(
                scenario.name, time, duration, f"{time / wall:.2f} x real time"
            ),
        )
    print("Writing the results", flush=True)
    try:
        summary = prepared.save(directory, replay=not options.no_replay)
        if frames is not None:
            write_series(frames, directory / "paraview", options.paraview)
    except KeyboardInterrupt:
        print(
            f"sliceit: interrupted. What is done is in {directory}/: "
            f"{', '.join(results_in(directory))}. The same command starts again.",
            file=sys.stderr,
        )
        return INTERRUPTED
    _report(summary, directory)
    if meshcat is not None:
        meshcat.Flush()  # A browser that watched keeps the replay.
    return 1 if prepared.stopped else 0


def _changes_beside_measurement(options: argparse.Namespace, scenario: "Scenario") -> list[str]:
    """A warning where --set makes the slice another than the one that was measured."""
    from sliceit_drake.diagrams.scenario import load_scenario

    if not options.set or scenario.measurement is None:
        return []
    given = load_scenario(options.scenario)
    if given.measurement != scenario.measurement:
        return []
    changed = [
        path
        for path in changed_fields(given, scenario)
        if path.startswith(MEASURED) and not path.endswith(MESH)
    ]
    if not changed:
        return []
    return [
        f"the measured curve is of a slice without your change of {', '.join(changed)}: what "
        "differs from it is no error of the simulation. Leave the curve out with "
        "--set measurement=null"
    ]


def _report(summary: dict, directory: Path) -> None:
    """Prints what came of the run, and what to open."""
    peak, board = summary["peak_force_N"], summary["board_peak_N"]
    print(
        f"Peak force {peak:.1f} N (board {board:.1f} N), cut {100 * summary['cut_progress']:.0f} %"
    )
    if "measurement" in summary:
        m = summary["measurement"]
        print(
            f"Against the measured curve, which ends at a depth of {m['compared_to_depth_mm']:.1f} "
            f"mm: RMS {m['rms_N']:.2f} N, peak up to there {m['simulated_peak_N']:.1f} N (measured "
            f"{m['measured_peak_N']:.1f} N)"
        )
    for warning in summary.get("warnings", ()):
        print(f"Warning: {warning}")
    if summary["stopped"]:
        print(
            f"Stopped early: {summary['stopped']}. What there is so far is kept; the same command "
            "starts again"
        )
    written = results_in(directory)
    print(f"Results in {directory}/: {', '.join(written)}")
    animation = summary.get("animation", "")
    if animation.startswith("none: "):
        print(f"No slice.gif: {animation.removeprefix('none: ')}")
    if "replay.html" in written:
        also = "; slice.gif is the same as an animation" if "slice.gif" in written else ""
        print(f"Open {directory / 'replay.html'} in a browser{also}")
    elif "slice.gif" in written:
        print(f"Open {directory / 'slice.gif'}")
    else:
        print(f"Open {directory / 'force.png'}")
