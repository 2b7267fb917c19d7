"""Runs the notebooks in their quick form and stores what they print and draw in their files.

Each runs as a reader would run it, in an empty folder. A notebook that fails, writes to the
standard error, or prints a folder of this machine or a place in memory is not stored. The second
tier of the tests compares fresh outputs with the stored ones. Notebook 4 needs the extra "learn" as
well, 6 needs "hardware".
"""

import argparse
import asyncio
import os
import re
import sys
import tempfile
from pathlib import Path

import nbformat
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient

__all__ = ["add_arguments", "execute", "run", "tidy"]

FOLDER = Path(__file__).resolve().parents[2] / "notebooks"
METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}
QUIET = {"OPENBLAS_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore", "TQDM_DISABLE": "1"}
"""Of the kernel: sums in one order on any number of cores, no warnings, no bars."""


def execute(notebook: nbformat.NotebookNode, folder: Path) -> None:
    """Runs all cells of a notebook in a folder, and fills in their outputs.

    Raises:
        nbclient.exceptions.CellExecutionError: A cell fails.
    """
    with tempfile.TemporaryDirectory() as sockets:
        # Not by TCP: on a machine with several users any of them could talk to the kernel.
        manager = AsyncKernelManager(
            kernel_name="python3", transport="ipc", ip=str(Path(sockets) / "k")
        )
        client = NotebookClient(
            notebook,
            km=manager,
            timeout=900,
            record_timing=False,
            resources={"metadata": {"path": str(folder)}},
        )

        async def run_cells() -> None:
            try:
                await client.async_execute(env=os.environ | QUIET)
            finally:
                # A client ends only kernels whose manager it made.
                await manager.shutdown_kernel(now=True)

        asyncio.run(run_cells())


def tidy(notebook: nbformat.NotebookNode, folder: Path) -> list[str]:
    """Takes out of an executed notebook what another run would write differently.

    Args:
        notebook: It changes.
        folder: Where it ran.

    Returns:
        What must not be stored, one entry each.
    """
    notebook.metadata = nbformat.from_dict(METADATA)
    faults = []
    for cell in notebook.cells:
        cell.metadata = {}
        outputs: list[nbformat.NotebookNode] = []
        for output in cell.get("outputs", []):
            if output.output_type == "stream":
                output.text = re.sub(r"localhost:\d+|(?<=-L )\d+", _default_port, output.text)
                if output.name == "stderr":
                    faults.append(f"cell {cell.id} writes to the standard error: {output.text}")
                if outputs and outputs[-1].get("name") == output.name:
                    outputs[-1].text += output.text
                    continue
            outputs.append(output)
            text = output.get("text", "") + output.get("data", {}).get("text/plain", "")
            for private in (str(folder), tempfile.gettempdir() + "/", str(FOLDER.parent), " at 0x"):
                if private in text:
                    faults.append(f"cell {cell.id} prints {private!r}: {text}")
        if cell.cell_type == "code":
            cell.outputs = outputs
    return faults


def _default_port(found: re.Match[str]) -> str:
    """Meshcat's first port, in the place of one that was free."""
    return re.sub(r"\d+", "7000", found[0])


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("notebooks", metavar="FILE", type=Path, nargs="*", help="default: all")


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    status = 0
    for file in options.notebooks or sorted(FOLDER.glob("*.ipynb")):
        notebook = nbformat.read(file, as_version=4)
        with tempfile.TemporaryDirectory() as folder:
            execute(notebook, Path(folder))
            faults = tidy(notebook, Path(folder))
        for fault in faults:
            print(f"{file.name}: {fault}", file=sys.stderr)
        if faults:
            status = 1
            continue
        file.write_text(nbformat.writes(notebook) + "\n", encoding="utf-8")
        print(f"{file.name}: {file.stat().st_size / 1e3:.0f} kB", flush=True)
    return status
