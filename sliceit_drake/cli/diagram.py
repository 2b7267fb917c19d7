"""Draw the block diagram of a scenario.

With Graphviz installed (its program `dot`) the picture is written in the format of FILE's ending:
.svg, .png or .pdf. Without it, give a .dot file and draw that elsewhere.
"""

import argparse
import math
import shutil
import subprocess
from pathlib import Path

from sliceit_drake.cli.arguments import (
    add_scenario_arguments,
    check_numbers,
    output_path,
    scenario_of,
)
from sliceit_drake.configuration import ConfigurationError

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's arguments."""
    add_scenario_arguments(parser)
    parser.add_argument(
        "--output",
        metavar="FILE",
        type=output_path,
        default=Path("diagram.svg"),
        help="picture to write",
    )
    parser.add_argument(
        "--depth", type=int, default=2, help="levels of nested diagrams (default 2)"
    )
    parser.add_argument(
        "--ports", action="store_true", help="print the station's port contract and draw nothing"
    )


def run(options: argparse.Namespace) -> int:
    """Runs the command."""
    if options.ports:
        from sliceit_drake.diagrams.ports import ports_as_markdown

        print(ports_as_markdown())
        return 0

    from sliceit_drake.diagrams.scenario_diagram import ScenarioDiagram

    kind = options.output.suffix.lstrip(".")
    dot = shutil.which("dot")
    if kind not in ("dot", "svg", "png", "pdf"):
        raise ConfigurationError(
            f'"{options.output}" has an ending that is not known',
            field="--output",
            fix="Give .svg, .png, .pdf or .dot.",
        )
    if kind != "dot" and dot is None:
        raise ConfigurationError(
            "the program `dot` of Graphviz is not installed, and it draws the picture",
            field="--output",
            fix="Install Graphviz (Debian: apt install graphviz), or give a .dot file.",
        )
    check_numbers(options, depth=(0, math.inf))
    text = ScenarioDiagram(scenario_of(options)).GetGraphvizString(options.depth)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    if kind == "dot" or dot is None:
        options.output.write_text(text, encoding="utf-8")
    else:
        subprocess.run(
            [dot, f"-T{kind}", "-o", str(options.output)], input=text.encode(), check=True
        )
    print(f"Wrote {options.output}")
    return 0
