"""Hide effects on benches of other laws, have their records diagnosed, and keep what is said.

Seeds follow from the hash of a commit, the part (training or reporting), the law and the number of
the draw. Each run is made twice: with the food calibrated (a) to earlier records without the effect
and (b) to the affected records. The diagnosis gets the folder of records and the food alone. Each
answer is kept as JSON in FOLDER; a study that was stopped goes on. `python -m studies bench_score
FOLDER` judges.

The law `strips` is reserved: nobody diagnoses its records before the rule of the decision is frozen
in a commit, which --frozen names. Each command of the part `reporting` is listed in
docs/results/benches_runs.jsonl.

  python -m studies benches --output output/benches --commit HEAD --laws slice_push bonds
  python -m studies benches --output output/benches --commit HEAD --part reporting --frozen HEAD
"""

import argparse
import dataclasses as dc
import datetime
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from sliceit_drake.configuration import ConfigurationError, dump_yaml
from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood
from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.diagnosis.diagnose import setup_of_food
from sliceit_drake.diagnosis.known_error import learn_known_error
from sliceit_drake.records.slice_record import write_record
from studies.benches.calibrated import calibrated, food_records, misfit_of
from studies.benches.draw import LAWS, PARTS, RESERVED, Draw, seed_of
from studies.benches.effects import HIDDEN
from studies.benches.sizes import Sizes
from studies.hidden_effects.bench import DIAGNOSIS_REFINEMENT
from studies.results import plain, write_json

__all__ = ["CALIBRATED_TO", "Case", "add_arguments", "cases_of", "commit_of", "diagnosed", "run"]

ROOT = Path(__file__).resolve().parents[2]
LOG = ROOT / "docs" / "results" / "benches_runs.jsonl"
"""All reporting runs."""

CALIBRATED_TO = ("earlier", "affected")
"""Records that the food is calibrated to: (a) and (b)."""

EARLIER = 999
"""Number of the session that comes before all others."""

SIZES = (2.0, 4.0, 2.0, 1.0, 4.0, 2.0, 0.5, 4.0)
"""Standardised sizes of the listed effects of a draw, in turn."""


@dc.dataclass(frozen=True)
class Case:
    """A run.

    Attributes:
        law, draw: Of the bench.
        number: In its draw; that of its session too.
        effect: Name; "" where nothing is hidden.
        wanted: Its standardised size.
    """

    law: str
    draw: int
    number: int
    effect: str
    wanted: float

    @property
    def name(self) -> str:
        """Of its file."""
        return f"{self.law}_{self.draw:02d}_{self.number:02d}"


def cases_of(law: str, draw: int, seed: int, count: int) -> list[Case]:
    """The runs of a draw: one in six with nothing hidden, one with an effect that stands in no
    list, the others with those of the list in an order of their own, see `SIZES`."""
    rng = np.random.default_rng([seed, 3])
    listed = [str(n) for n in rng.permutation([n for n, k in HIDDEN.items() if k.right])]
    unlisted = [str(n) for n in rng.permutation([n for n, k in HIDDEN.items() if not k.right])]
    out, named = [], 0
    for number in range(count):
        effect, wanted = "", 0.0
        if number % 6 == 4:
            effect, wanted = unlisted[number // 6 % len(unlisted)], 3.0
        elif number % 6 != 1:
            effect, wanted = listed[named % len(listed)], SIZES[(named + draw) % len(SIZES)]
            named += 1
        out.append(Case(law, draw, number, effect, wanted))
    return out


def commit_of(name: str, field: str) -> str:
    """The hash of a commit of this repository.

    Raises:
        ConfigurationError: There is none of that name.
    """
    command = ["git", "rev-parse", "--verify", "--quiet", f"{name}^{{commit}}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise ConfigurationError(
            f"{name!r} is no commit of this repository", field=field, fix="Give one that is."
        )
    return done.stdout.strip()


def diagnosed(
    law: str, records: Path, food: CalibratedFood, cache: Path, replicates: int, frozen: str | None
) -> dict[str, Any]:
    """What `sliceit diagnose` says of a folder of records, in a process that sees nothing else.

    Args:
        law: By which the records were made.
        records: Their folder.
        food: That is given with them.
        cache: Folder of simulations.
        replicates: Of its bootstrap.
        frozen: Commit in which the rule of the decision is frozen, or None.

    Returns:
        diagnosis.json, or {"failure": what it said}.

    Raises:
        ConfigurationError: The law is reserved, and `frozen` is no commit.
    """
    if law == RESERVED:
        if frozen is None:
            raise ConfigurationError(
                f"{law!r} is reserved for the report, after the rule is frozen",
                field="--laws",
                fix="Leave it out, or name by --frozen the commit that froze the rule.",
            )
        commit_of(frozen, "--frozen")
    with tempfile.TemporaryDirectory(prefix="bench_") as folder:
        place = Path(folder)
        dump_yaml(food, place / "food.yaml")
        (place / "records").symlink_to(records.resolve())
        command = [
            *(sys.executable, "-m", "sliceit_drake.cli.main", "diagnose", "records"),
            *("--model", "food.yaml", "--output", "result", "--no-report", "--workers", "1"),
            *("--refinement", str(DIAGNOSIS_REFINEMENT), "--replicates", str(replicates)),
            *("--cache", str(cache.resolve())),
        ]
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
        done = subprocess.run(
            command, cwd=place, env=environment, capture_output=True, text=True, check=False
        )
        file = place / "result" / "diagnosis.json"
        if done.returncode != 0 or not file.exists():
            return {"failure": done.stderr[-4000:]}
        said: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        return said


class _Bench:
    """A draw with what all of its runs share, which is kept in its folder."""

    def __init__(self, law: str, number: int, seed: int, output: Path) -> None:
        self.draw, self.output = Draw(law, seed), output
        self.folder = output / "draws" / f"{law}_{number:02d}"
        self.misfit, self.model = misfit_of(self.draw)
        self.sizes = Sizes(self.draw, self.misfit)
        earlier = self.draw.records(seed=EARLIER)
        self.food = calibrated(self.model, food_records(earlier))
        # As `sliceit calibrate` leaves it.
        setup = setup_of_food(self.food, DIAGNOSIS_REFINEMENT)
        try:
            self.food.known_error = learn_known_error(setup, earlier, output / "cache", workers=1)
        except ConfigurationError as error:
            print(f"{law} {number}: what the simulation gets wrong is not in the file: {error}")
        write_json(
            self.folder.with_suffix(".json"),
            {"law": law, "draw": number, "seed": seed, "misfit": self.misfit}
            | {"constants": self.draw.constants, "noise": self.draw.noise}
            | {"variation": self.draw.variation},
        )

    def hidden(self, case: Case) -> dict[str, Any] | None:
        """Effect, size and the causes that an oracle could not tell apart; None where no sensible
        size has the strength that was wanted."""
        if not case.effect:
            return {"effect": "", "size": 0.0, "standardised": 0.0, "group": []}
        found = self.sizes.size_for(case.effect, case.wanted)
        if found is None:
            return None
        size, signature = found
        return {
            "effect": case.effect,
            "size": size,
            "standardised": signature.size,
            "over_noise": signature.over_noise,
            "group": sorted(self.sizes.group(case.effect, signature)),
        }

    def run(self, case: Case, replicates: int, frozen: str | None) -> dict[str, Any]:
        """The answers of a run."""
        out: dict[str, Any] = {"case": dc.asdict(case)}
        out["hidden"] = hidden = self.hidden(case)
        if hidden is None:
            return out
        effects = [HIDDEN[case.effect](hidden["size"])] if case.effect else []
        with tempfile.TemporaryDirectory(prefix="records_") as folder:
            records = self.draw.records(effects, seed=case.number)
            for record in records:
                write_record(record, Path(folder) / record.name)
            for to in CALIBRATED_TO:
                food = self.food
                if to == "affected":
                    food = calibrated(food, food_records(records))
                    # What is learnt from records is not used with them.
                    food.known_error = None
                begin = time.monotonic()
                cache = self.output / "cache"
                cache.mkdir(parents=True, exist_ok=True)
                out[to] = diagnosed(case.law, Path(folder), food, cache, replicates, frozen)
                out[f"{to}_s"] = time.monotonic() - begin
        return out


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("--output", metavar="FOLDER", type=Path, required=True, help="for answers")
    parser.add_argument("--commit", required=True, help="that seeds follow from")
    parser.add_argument(
        "--part", choices=PARTS, default="training", help="whose draws (default training)"
    )
    known = [law for law in LAWS if law != RESERVED]
    parser.add_argument(
        "--laws", nargs="+", metavar="LAW", help=f"default: {', '.join(known)}, of a report all"
    )
    parser.add_argument("--draws", type=int, default=12, help="of each law (default 12)")
    parser.add_argument("--runs", type=int, default=12, help="of each draw (default 12)")
    parser.add_argument("--frozen", metavar="COMMIT", help="in which the rule is frozen")
    parser.add_argument("--replicates", type=int, default=100, help="of each bootstrap")
    parser.add_argument("--minutes", type=float, metavar="M", help="begin no run after these")
    parser.add_argument(
        "--kept",
        metavar="FILE",
        type=Path,
        help="what `bench_score --keep` wrote: its runs are done",
    )
    parser.add_argument("--worker", metavar="K/N", default="1/1", help="every Nth draw from K on")
    parser.set_defaults(resumes=True)


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    commit = commit_of(options.commit, "--commit")
    frozen = options.frozen and commit_of(options.frozen, "--frozen")
    known = [law for law in LAWS if law != RESERVED]
    laws = options.laws or (list(LAWS) if options.part == "reporting" else known)
    _check(laws, options.part, commit, frozen)
    if options.part == "reporting":
        _list(options.command, commit, laws, options.draws, options.runs)
    end = None if options.minutes is None else time.monotonic() + 60.0 * options.minutes
    left = list(_left(options, laws, commit))
    with tqdm(total=sum(len(cases) for *_, cases in left), desc="runs") as bar:
        for law, number, seed, cases in left:
            if end is not None and time.monotonic() > end:
                break
            try:
                bench = _Bench(law, number, seed, options.output)
            except CuttingError as error:
                print(f"{law} {number}: {error}")
                continue
            for case in cases:
                if end is not None and time.monotonic() > end:
                    break
                try:
                    answers = bench.run(case, options.replicates, frozen)
                except CuttingError as error:
                    answers = {"case": dc.asdict(case), "hidden": None, "failure": str(error)}
                facts = {"part": options.part, "commit": commit, "code": commit_of("HEAD", "HEAD")}
                _keep(options.output / "runs" / f"{case.name}.json", facts | answers)
                bar.update()
    print(f"Judge them: python -m studies bench_score {options.output}")
    return 0


def _check(laws: Sequence[str], part: str, commit: str, frozen: str | None) -> None:
    for law in laws:
        if law not in LAWS:
            raise ConfigurationError(
                f"{law!r} is no law", field="--laws", fix=f"Give some of {', '.join(LAWS)}."
            )
    if RESERVED in laws and frozen is None:
        raise ConfigurationError(
            f"{RESERVED!r} is reserved for the report, after the rule is frozen",
            field="--laws",
            fix="Leave it out, or name by --frozen the commit that froze the rule.",
        )
    if part == "reporting" and frozen != commit:
        raise ConfigurationError(
            "seeds of a report follow from the commit that froze the rule",
            field="--frozen",
            fix="Give the same commit to --commit and --frozen.",
        )


def _left(
    options: argparse.Namespace, laws: Sequence[str], commit: str
) -> Iterator[tuple[str, int, int, list[Case]]]:
    """Draws that are not done, law by law in turn, and their runs that are left."""
    first, of = (int(word) for word in options.worker.split("/"))
    done = set(_kept(options.kept)) if options.kept else set()
    draws = [(law, number) for number in range(options.draws) for law in laws]
    for law, number in draws[first - 1 :: of]:
        seed = seed_of(commit, options.part, law, number)
        cases = [
            case
            for case in cases_of(law, number, seed, options.runs)
            if not (options.output / "runs" / f"{case.name}.json").exists()
            and (commit, options.part, case.name) not in done
        ]
        if cases:
            yield law, number, seed, cases


def _kept(file: Path) -> Iterator[tuple[str, str, str]]:
    """Commit, part and name of the runs in a file."""
    for line in file.read_text(encoding="utf-8").splitlines():
        facts = json.loads(line)
        yield facts["commit"], facts["part"], Case(**facts["case"]).name


def _keep(file: Path, facts: dict[str, Any]) -> None:
    """Writes a run's answers at once: a run that is killed leaves no half of a file."""
    part = file.with_suffix(".part")
    write_json(part, plain(facts))
    part.replace(file)


def _list(command: str, commit: str, laws: Sequence[str], draws: int, runs: int) -> None:
    entry = {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": command,
        "commit": commit,
        "code": commit_of("HEAD", "HEAD"),
        "laws": list(laws),
        "draws": draws,
        "runs": runs,
    }
    LOG.parent.mkdir(parents=True, exist_ok=True)
    with LOG.open("a", encoding="utf-8") as file:
        file.write(json.dumps(entry) + "\n")
