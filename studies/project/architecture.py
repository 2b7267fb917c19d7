"""The picture of docs/explanation/architecture.md: folders, and which imports which.

Reads the layers from the import rules in pyproject.toml and the imports from the code.
"""

import argparse
import tomllib
from pathlib import Path

import grimp
import matplotlib.pyplot as plt

__all__ = ["FIGURE", "add_arguments", "draw", "layers", "needless", "run", "uses"]

ROOT = Path(__file__).resolve().parents[2]
FIGURE = ROOT / "docs" / "figures" / "architecture.png"
CONTRACT = "Folders depend in one direction"
SMALL = "configuration"
"""A module of the lowest layer, which everything stands on and no arrow shows."""
ACROSS = {
    "learning": 0.12,
    "emulator": 0.42,
    "robot_run": 0.62,
    "diagnosis": 0.85,
    "stand_in": 0.12,
    "calibration": 0.85,
    "diagrams": 0.42,
    "prediction": 0.85,
    "systems": 0.42,
    "hardware": 0.15,
    "cutting": 0.42,
    "records": 0.72,
}
"""Where a folder stands across the picture, so that few arrows cross; others in the middle."""


def layers() -> list[list[str]]:
    """The layers of the import contract in pyproject.toml, the highest first, by short names."""
    with open(ROOT / "pyproject.toml", "rb") as stream:
        contracts = tomllib.load(stream)["tool"]["importlinter"]["contracts"]
    (found,) = (c["layers"] for c in contracts if c["name"] == CONTRACT)
    rows = [
        [name.strip().rpartition(".")[2] for name in row.replace(":", "|").split("|")]
        for row in found
    ]
    return [row for row in rows if SMALL not in row]


def uses(rows: list[list[str]]) -> dict[tuple[str, str], int]:
    """How many imports each folder has of each other, by importer and imported."""
    graph = grimp.build_graph("sliceit_drake", "studies")
    folders = {folder for row in rows for folder in row}
    found: dict[tuple[str, str], int] = {}
    for module in graph.modules:
        importer = folder_of(module)
        for other in graph.find_modules_directly_imported_by(module):
            pair = importer, folder_of(other)
            if pair[0] != pair[1] and folders >= set(pair):
                found[pair] = found.get(pair, 0) + 1
    return found


def folder_of(module: str) -> str:
    """The folder of a module, by its short name."""
    parts = module.split(".")
    return parts[0] if parts[0] == "studies" or len(parts) == 1 else parts[1]


def needless(found: dict[tuple[str, str], int]) -> set[tuple[str, str]]:
    """Arrows that a longer path of arrows says as well; without them the picture is readable."""
    below: dict[str, set[str]] = {}

    def reach(folder: str) -> set[str]:
        if folder not in below:
            below[folder] = set()
            for importer, imported in found:
                if importer == folder:
                    below[folder] |= {imported} | reach(imported)
        return below[folder]

    return {
        (a, c)
        for a, c in found
        if any(c in reach(b) for importer, b in found if importer == a and b != c)
    }


def draw(file: Path = FIGURE) -> None:
    """Draws the folders by layer, and an arrow from each to those it stands on."""
    rows = layers()
    found = uses(rows)
    place = {f: (ACROSS.get(f, 0.5), len(rows) - i) for i, row in enumerate(rows) for f in row}
    figure, axes = plt.subplots(figsize=(9.0, 1.05 * len(rows)))
    axes.set(xlim=(0.0, 1.0), ylim=(0.5, len(rows) + 0.5))
    axes.set_axis_off()
    box = {"boxstyle": "round,pad=0.45", "edgecolor": "0.3", "facecolor": "#dceaf7"}
    boxes = {
        folder: axes.text(
            *place[folder],
            folder,
            ha="center",
            va="center",
            fontsize=12,
            zorder=3,
            bbox=box | ({"facecolor": "#f6e3c5"} if folder == "studies" else {}),
        )
        for folder in place
    }
    figure.canvas.draw()  # The boxes have their sizes from here on.
    for importer, imported in sorted(set(found) - needless(found)):
        axes.annotate(
            "",
            place[imported],
            place[importer],
            arrowprops={
                "arrowstyle": "-|>,head_width=0.28,head_length=0.6",
                "color": "0.45",
                "patchA": boxes[importer].get_bbox_patch(),
                "patchB": boxes[imported].get_bbox_patch(),
                "shrinkA": 2,
                "shrinkB": 2,
            },
        )
    axes.set_title("A folder imports those below that its arrows lead to, directly or indirectly")
    figure.tight_layout()
    figure.savefig(file, dpi=130)
    plt.close(figure)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument(
        "--output", metavar="FILE", type=Path, default=FIGURE, help="default: the page's figure"
    )


def run(options: argparse.Namespace) -> int:
    """Draws the picture."""
    draw(options.output)
    print(f"Drawn: {options.output}")
    return 0
