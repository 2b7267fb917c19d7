"""Hide effects in records of the stand-in, have them diagnosed, and keep what the diagnosis says.

Each run draws effects and their sizes (2 to 3 times the noise, after all else is refitted), makes
the records of a session, and starts `sliceit diagnose` on that folder alone. What was hidden is
kept apart, in DIR/truth. `python -m studies score DIR` judges. A study that was stopped goes on,
given the --seed and --replicates that it was begun with.

Kinds of runs
  single   one effect, rich or full protocol      nothing  nothing hidden, all protocols
  unknown  an effect that stands in no list       pairs    two effects at once
  poor     an effect of an ambiguous class, poor protocol
  base     a shift of a base parameter            curve    one effect at several strengths

  python -m studies hidden --output output/hidden --minutes 120
  python -m studies hidden --output output/hidden --runs-from FILE.jsonl --seed 1 --replicates 100
  python -m studies hidden --output output/hidden --backend dask --scheduler tcp://192.168.0.5:8786
On a cluster the list of runs and the sizes are made here, the runs there; no disk is shared.
"""

import argparse
from pathlib import Path

from sliceit_drake.cli.arguments import add_cluster_arguments, cluster_of
from sliceit_drake.cli.progress import StageBars
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.stand_in.effect_registry import make_effect
from studies.hidden_effects.archive import unpack
from studies.hidden_effects.cases import KINDS
from studies.hidden_effects.study import StudyOptions, prepare, run_study

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("--output", metavar="DIR", type=Path, required=True, help="where runs go")
    parser.add_argument(
        "--runs-from", metavar="FILE", type=Path, help="go on with the runs that are in this file"
    )
    parser.add_argument("--kinds", nargs="+", metavar="KIND", help="only these (default: all)")
    parser.add_argument(
        "--protocols", nargs="+", metavar="NAME", help="only these (default: rich full poor)"
    )
    parser.add_argument("--effects", nargs="+", metavar="NAME", help="only these (default: all)")
    parser.add_argument("--runs", type=int, metavar="N", help="only the first N of the list")
    parser.add_argument("--minutes", type=float, metavar="M", help="begin no run after these")
    parser.add_argument("--workers", type=int, default=2, help="processes (default 2)")
    add_cluster_arguments(parser, "processes", "records are made and diagnosed")
    parser.add_argument("--seed", type=int, default=0, help="of the list of runs (default 0)")
    parser.add_argument(
        "--replicates", type=int, default=200, help="of each diagnosis's bootstrap (default 200)"
    )
    parser.set_defaults(resumes=True)


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    for effect in options.effects or ():
        make_effect(effect)
    kinds = tuple(options.kinds or KINDS)
    protocols = tuple(options.protocols or ("rich", "full", "poor"))
    for kind in kinds:
        if kind not in KINDS:
            raise ConfigurationError(
                f"{kind!r} is no kind of run",
                field="--kinds",
                fix=f"Give some of {', '.join(KINDS)}.",
            )
    effects = None if options.effects is None else tuple(options.effects)
    options.output.mkdir(parents=True, exist_ok=True)
    if options.runs_from is not None:
        unpack(options.runs_from, options.output)
    settings = StudyOptions(kinds, options.seed, options.replicates, protocols, effects)
    with cluster_of(options) as client, StageBars() as bars:
        cases = prepare(options.output, settings, bars.show)[: options.runs]
        done = run_study(
            cases,
            options.output,
            options.replicates,
            options.workers,
            options.minutes,
            bars.show,
            client,
        )
    judge = f"python -m studies score {options.output}"
    print(f"{done} of {len(cases)} runs are done. Judge them: {judge}")
    return 0
