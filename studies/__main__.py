"""`python -m studies`: lists the studies of the project, and runs one."""

import difflib
import os
import shlex
import sys
from collections.abc import Sequence

from sliceit_drake.cli.main import BAD_INPUT, run_program
from studies.registry import TOPICS, find_study, study_parser

__all__ = ["main", "study_list"]

PROGRAM = "python -m studies"


def study_list() -> str:
    """The studies by topic, a line each, with the time that each takes."""
    lines = [
        f"usage: {PROGRAM} NAME ...",
        "",
        "Measures the project itself; docs show the results.",
    ]
    for topic, studies in TOPICS.items():
        lines += ["", f"{topic}:"]
        lines += [f"  {s.name:18} {s.line} [{s.duration}]" for s in studies]
    return "\n".join(
        [*lines, "", f"`{PROGRAM} NAME --help` explains a study. SI units everywhere."]
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Lists the studies, or runs one.

    Args:
        arguments: Command line without the program's name; None for that of the process.

    Returns:
        As `sliceit_drake.cli.main.main`; many studies return 1 where what they measure misses its
        limit.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        print(study_list())
        return 0
    study = find_study(words[0])
    if study is None:
        names = [s.name for studies in TOPICS.values() for s in studies]
        close = difflib.get_close_matches(words[0], names, n=1)
        hint = f"Do you mean {close[0]}?" if close else f"`{PROGRAM}` lists them."
        print(f"{PROGRAM}: there is no study {words[0]!r}. {hint}", file=sys.stderr)
        return BAD_INPUT
    # Threads of the linear algebra library count when it is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from sliceit_drake.configuration import ConfigurationError

    try:
        parser = study_parser(study)
    except ConfigurationError as error:
        print(f"{PROGRAM} {study.name}: {error}", file=sys.stderr)
        return BAD_INPUT
    parser.set_defaults(command=shlex.join([*PROGRAM.split(), *words]))
    return run_program(parser, words[1:])


if __name__ == "__main__":
    sys.exit(main())
