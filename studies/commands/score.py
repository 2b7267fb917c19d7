"""`python -m studies score`: judge the diagnoses of a study of hidden effects."""

import argparse
from pathlib import Path

__all__ = ["add_parser"]

DESCRIPTION = """\
Judge the diagnoses of `python -m studies hidden`: what was said against what was hidden.

Prints rates with Wilson's bounds, what is asked for, rates by cause, detection curves and
what was said where it was not right. With --output FOLDER it also writes hidden_effects.md,
hidden_effects.json, hidden_effects.jsonl (the runs, from which the study can be judged again and
gone on with) and figures/hidden_effects.png there. A study that is not done is judged by what there
is. In place of its folder such a file of runs will do.

  python -m studies score output/hidden --output docs
  python -m studies score docs/hidden_effects.jsonl
"""


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the command."""
    parser = commands.add_parser(
        "score",
        help="judge the diagnoses of a study of hidden effects",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("study", metavar="DIR", type=Path, help="folder of the study, or its runs")
    parser.add_argument("--output", metavar="FOLDER", type=Path, help="also write the report there")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    """Runs the command."""
    import json
    import tempfile

    from studies.hidden_effects.archive import pack, unpack
    from studies.hidden_effects.report import numbers, plot_curves, report
    from studies.hidden_effects.score import judge_study
    from studies.hidden_effects.study import read_facts

    with tempfile.TemporaryDirectory() as folder:
        study = options.study
        if study.is_file():
            unpack(study, Path(folder))
            study = Path(folder)
        judgements, facts = judge_study(study), read_facts(study / "study.json")
        if options.output is not None:
            pack(study, options.output / "hidden_effects.jsonl")
    figure = "figures/hidden_effects.png" if options.output is not None else None
    text = report(judgements, figure, facts)
    print(text)
    if options.output is not None:
        options.output.mkdir(parents=True, exist_ok=True)
        (options.output / "hidden_effects.md").write_text(text, encoding="utf-8")
        found = numbers(judgements)
        (options.output / "hidden_effects.json").write_text(
            json.dumps(found, indent=2) + "\n", encoding="utf-8"
        )
        if found["curves"]:
            plot_curves(judgements, options.output / "figures" / "hidden_effects.png")
    return 0
