"""`python -m studies`: lists the studies of the project, and runs one."""

import argparse
import sys

from sliceit_drake.cli.main import run_program
from studies.commands.score import add_parser as add_score
from studies.commands.study import add_studies

__all__ = ["make_parser"]


def make_parser() -> argparse.ArgumentParser:
    """The parser of all studies."""
    parser = argparse.ArgumentParser(
        prog="python -m studies",
        description="Studies whose tables and figures stand in docs; each says how long it takes.",
    )
    studies = parser.add_subparsers(title="studies", metavar="STUDY", required=True)
    add_studies(studies)
    add_score(studies)
    return parser


if __name__ == "__main__":
    sys.exit(run_program(make_parser()))
