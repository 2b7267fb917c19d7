"""`python -m studies hidden` and `python -m studies sizes`: effects are hidden in records and diagnosed."""

import argparse
from pathlib import Path

from sliceit_drake.cli.cluster_arguments import add_cluster_arguments, cluster_of
from sliceit_drake.cli.progress import StageBars

__all__ = ["add_hidden_study"]

DESCRIPTION = """\
Hide effects in records of the stand-in, have them diagnosed, and keep what the diagnosis says.

Each run draws effects and their sizes (2 to 3 times the noise, after all else is refitted), makes
the records of a session, and starts `sliceit diagnose` on that folder alone. What was hidden is
kept apart, in DIR/truth. `python -m studies score DIR` judges. A study that was stopped goes on, given
the --seed and --replicates that it was begun with.

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

SIZES = """\
Print at which size each effect has a wanted strength against the noise, protocol by protocol.
"""


def add_hidden_study(studies: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the studies."""
    hidden = studies.add_parser(
        "hidden",
        help="hide effects in records and have them diagnosed",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    hidden.add_argument("--output", metavar="DIR", type=Path, required=True, help="where runs go")
    hidden.add_argument(
        "--runs-from", metavar="FILE", type=Path, help="go on with the runs that are in this file"
    )
    hidden.add_argument("--kinds", nargs="+", metavar="KIND", help="only these (default: all)")
    hidden.add_argument(
        "--protocols", nargs="+", metavar="NAME", help="only these (default: rich full poor)"
    )
    hidden.add_argument("--effects", nargs="+", metavar="NAME", help="only these (default: all)")
    hidden.add_argument("--runs", type=int, metavar="N", help="only the first N of the list")
    hidden.add_argument("--minutes", type=float, metavar="M", help="begin no run after these")
    hidden.add_argument("--workers", type=int, default=2, help="processes (default 2)")
    add_cluster_arguments(hidden, "processes", "records are made and diagnosed")
    hidden.add_argument("--seed", type=int, default=0, help="of the list of runs (default 0)")
    hidden.add_argument(
        "--replicates", type=int, default=200, help="of each diagnosis's bootstrap (default 200)"
    )
    hidden.set_defaults(run=_run_hidden, resumes=True)
    sizes = studies.add_parser(
        "sizes",
        help="sizes of effects by their strength against the noise",
        description=SIZES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    sizes.add_argument(
        "--protocols",
        nargs="+",
        metavar="NAME",
        default=["poor", "rich", "full"],
        help="default: all",
    )
    sizes.add_argument("--effects", nargs="+", metavar="NAME", help="default: all")
    sizes.add_argument("--cache", metavar="DIR", type=Path, help="keep what was computed there")
    sizes.add_argument("--output", metavar="FILE", type=Path, help="also write the table there")
    sizes.set_defaults(run=_run_sizes)


def _run_hidden(options: argparse.Namespace) -> int:
    """Runs the study."""
    from sliceit_drake.configuration import ConfigurationError
    from sliceit_drake.stand_in.effect_registry import make_effect
    from studies.hidden_effects.archive import unpack
    from studies.hidden_effects.cases import KINDS
    from studies.hidden_effects.study import StudyOptions, prepare, run_study

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
    print(
        f"{done} of {len(cases)} runs are done. Judge them: python -m studies score {options.output}"
    )
    return 0


def _run_sizes(options: argparse.Namespace) -> int:
    """Prints the table."""
    from tqdm import tqdm

    from sliceit_drake.stand_in.effect_registry import EFFECTS
    from studies.hidden_effects.sizes import ProtocolSizes, sizes_as_markdown

    effects = options.effects or list(EFFECTS)
    protocols = [ProtocolSizes(name, options.cache) for name in options.protocols]
    with tqdm(total=len(effects) * len(protocols), desc="sizes") as bar:
        text = sizes_as_markdown(protocols, effects, bar.update)
    print(text)
    if options.output is not None:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text(text, encoding="utf-8")
    return 0
