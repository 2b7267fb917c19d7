"""`sliceit simulate`: run a scenario and write its results."""

import argparse
import logging
from pathlib import Path

from sliceit_drake.cli.scenario_argument import add_scenario_arguments, scenario_of

__all__ = ["add_parser"]

DESCRIPTION = """\
Simulate a scenario: the arm moves the knife through the food under compliance control.

Writes to DIR:
  replay.html    the run in 3-D, opens in any browser without a server
  force.png      knife, and force over time and depth beside a measured curve if there is one
  record.csv     joints, poses, wrenches, energies at every exchange (500 Hz), SI units
  summary.json   peak and mean force, work by mechanism, real-time factor, discretisation error, ...
  scenario.yaml  what was simulated, complete
"""


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the command."""
    parser = commands.add_parser(
        "simulate",
        help="run a scenario and write record, summary, figure and replay",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_scenario_arguments(parser)
    parser.add_argument(
        "--output", metavar="DIR", type=Path, default=None, help="default: output/NAME"
    )
    parser.add_argument("--duration", metavar="S", type=float, help="default: the motion's")
    parser.add_argument(
        "--meshcat",
        action="store_true",
        help="show the run live in a browser, not faster than real time; print its address",
    )
    parser.add_argument("--no-replay", action="store_true", help="do not write replay.html")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Runs the command."""
    scenario = scenario_of(options)

    from tqdm import tqdm

    if not options.meshcat:
        logging.getLogger("drake").setLevel(logging.WARNING)

    from sliceit_drake.diagrams.run import make_meshcat, prepare_run, simulate, write_outputs

    if options.duration is not None and not options.duration > 0.0:
        from sliceit_drake.configuration import ConfigurationError

        raise ConfigurationError(
            f"{options.duration} s is not a duration", field="--duration", fix="Give seconds > 0."
        )
    meshcat = None if options.no_replay and not options.meshcat else make_meshcat()
    print("Preparing (the first run on a machine compiles the kernels, about 5 s)", flush=True)
    prepared = prepare_run(scenario, meshcat)
    if options.meshcat and meshcat is not None:
        print(
            f"Watch at {meshcat.web_url()} . Without a display on this machine, forward its port "
            f"(ssh -L {meshcat.port()}:localhost:{meshcat.port()} HOST) or open replay.html later."
        )
        prepared.simulator.set_target_realtime_rate(1.0)
    duration = options.duration or prepared.motion.duration
    with tqdm(
        total=duration,
        desc=scenario.name,
        unit="s",
        bar_format="{desc}: {percentage:3.0f}%|{bar}| {n:.2f}/{total:.2f} s {postfix}",
    ) as bar:

        def show(time: float, wall: float) -> None:
            bar.set_postfix_str(f"{time / wall:.2f} x real time", refresh=False)
            bar.update(time - bar.n)

        simulate(prepared, duration, show)
    directory = options.output or Path("output") / scenario.name
    summary = write_outputs(prepared, directory, None if options.no_replay else meshcat)
    _report(summary, directory)
    return 1 if prepared.stopped else 0


def _report(summary: dict, directory: Path) -> None:
    peak, board = summary["peak_force_N"], summary["board_peak_N"]
    print(
        f"Peak force {peak:.1f} N (board {board:.1f} N), cut {100 * summary['cut_progress']:.0f} %"
    )
    if "measurement" in summary:
        m = summary["measurement"]
        print(
            f"Against the measured curve: RMS {m['rms_N']:.2f} N, peak {m['simulated_peak_N']:.1f} "
            f"N (measured {m['measured_peak_N']:.1f} N)"
        )
    if summary["stopped"]:
        print(f"Stopped early: {summary['stopped']}. What there is so far is kept.")
    print(f"Results in {directory}/: {', '.join(sorted(p.name for p in directory.iterdir()))}")
