"""The study as a whole: a list of runs, worked off by processes, that can be stopped and go on."""

import dataclasses as dc
import json
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sliceit_drake.configuration import ConfigurationError, dump_yaml
from sliceit_drake.cutting.workers import worker_processes
from studies.hidden_effects.bench import model_food, protocol_named
from studies.hidden_effects.cases import KINDS, Case, make_cases
from studies.hidden_effects.classes import ProtocolClasses, protocol_classes
from studies.hidden_effects.runner import (
    Made,
    food_file,
    is_done,
    keep_case,
    run_case,
    run_case_there,
)
from studies.hidden_effects.sizes import angles_for, size_for
from studies.hidden_effects.truth import CAUSE_OF

if TYPE_CHECKING:
    from distributed import Client

__all__ = [
    "CASES",
    "CLASSES",
    "NEAR",
    "OPTIONS",
    "StudyOptions",
    "load_cases",
    "prepare",
    "read_facts",
    "run_study",
]

Progress = Callable[[str, int, int], None]
"""Called with a stage, what is done and what there is."""


CASES = "cases.json"
"""The list of runs, done or not, and what it follows from."""
CLASSES = "classes.json"
"""By protocol all that its slices cannot tell apart (`classes.ProtocolClasses`)."""
NEAR = "near.json"
"""By protocol and effect the angles to all causes, degrees."""
OPTIONS = "study.json"
"""Seed and replicates."""


@dc.dataclass(frozen=True)
class StudyOptions:
    """What is run.

    Attributes:
        kinds: Of runs.
        seed: All follows from it.
        replicates: Of each diagnosis's bootstrap.
        protocols: That may be used.
        effects: That may be hidden; all by default.
    """

    kinds: tuple[str, ...] = tuple(KINDS)
    seed: int = 0
    replicates: int = 200
    protocols: tuple[str, ...] = ("rich", "full", "poor")
    effects: tuple[str, ...] | None = None


def prepare(output: Path, options: StudyOptions, progress: Progress) -> list[Case]:
    """The list of runs; the foods that are given, and the truth, are written.

    A study that goes on has the runs, sizes and angles that it was begun with.

    Raises:
        ConfigurationError: The folder holds another study.
    """
    file = output / OPTIONS
    facts = {"seed": options.seed, "replicates": options.replicates}
    found = read_facts(file)
    if found is not None and found != facts:
        raise ConfigurationError(
            f"was begun with {found}, not {facts}",
            source=str(file),
            fix="Give the same options, or another --output.",
        )
    cases = _begun(output, options) or _made(output, options, progress)
    for name in options.protocols:
        food_file(output, name).parent.mkdir(parents=True, exist_ok=True)
        dump_yaml(model_food(protocol_named(name)), food_file(output, name))
    truth = output / "truth"
    truth.mkdir(exist_ok=True)
    for case in cases:
        text = json.dumps(dc.asdict(case), indent=2) + "\n"
        (truth / f"{case.name}.json").write_text(text, encoding="utf-8")
    listed = {**_listed_by(options), "cases": [dc.asdict(case) for case in cases]}
    (output / CASES).write_text(json.dumps(listed) + "\n", encoding="utf-8")
    file.write_text(json.dumps(facts) + "\n", encoding="utf-8")
    return cases


def _listed_by(options: StudyOptions) -> dict[str, Any]:
    """What the list of runs follows from, beside the seed."""
    effects = None if options.effects is None else list(options.effects)
    return {
        "kinds": list(options.kinds),
        "protocols": list(options.protocols),
        "effects": effects,
    }


def _begun(output: Path, options: StudyOptions) -> list[Case] | None:
    """The runs of a study that goes on; None where there is none, or one of other runs."""
    known = read_facts(output / CASES)
    if known is None or any(not (output / n).exists() for n in (NEAR, CLASSES)):
        return None
    cases = [Case.of(facts) for facts in known.pop("cases")]
    return cases if known == _listed_by(options) else None


def _made(output: Path, options: StudyOptions, progress: Progress) -> list[Case]:
    """The runs of a study that begins; sizes and angles are computed."""
    cache = output / "cache"
    calls = [0]

    def size(protocol: str, effect: str, delta: float) -> float | None:
        calls[0] += 1
        progress("sizes", calls[0], calls[0])
        return size_for(protocol, effect, delta, cache)

    classes = _classes(output, options.protocols, progress)
    poor = classes["poor"].classes if "poor" in classes else {}
    ambiguous = [e for e, cause in CAUSE_OF.items() if len(poor.get(cause, [])) > 1]
    cases = make_cases(
        size,
        ambiguous,
        options.seed,
        options.kinds,
        protocols=options.protocols,
        effects=options.effects,
    )
    _near(output, cases, progress)
    return cases


def _classes(
    output: Path, protocols: Sequence[str], progress: Progress
) -> dict[str, ProtocolClasses]:
    found = {}
    for k, name in enumerate(protocols):
        found[name] = protocol_classes(name, output / "cache")
        progress("classes", k + 1, len(protocols))
    text = json.dumps({name: dc.asdict(c) for name, c in found.items()}) + "\n"
    (output / CLASSES).write_text(text, encoding="utf-8")
    return found


def _near(output: Path, cases: Sequence[Case], progress: Progress) -> None:
    """Writes which causes each hidden effect is how near to."""
    wanted = sorted(
        {(c.protocol, h.effect) for c in cases for h in c.hidden if h.effect in CAUSE_OF}
    )
    file = output / NEAR
    near: dict[str, dict[str, dict[str, float]]] = read_facts(file) or {}
    for k, (protocol, effect) in enumerate(wanted):
        near.setdefault(protocol, {})[effect] = angles_for(protocol, effect, output / "cache")
        progress("classes of effects", k + 1, len(wanted))
    file.write_text(json.dumps(near, indent=1) + "\n", encoding="utf-8")


def read_facts(file: Path) -> dict[str, Any] | None:
    """What a JSON file of the study holds; None where it is not there."""
    if not file.exists():
        return None
    found: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return found


def load_cases(output: Path) -> list[Case]:
    """All runs that the study's folder knows of, done or not."""
    files = sorted((output / "truth").glob("*.json"))
    return [Case.of(json.loads(file.read_text(encoding="utf-8"))) for file in files]


def run_study(
    cases: Sequence[Case],
    output: Path,
    replicates: int,
    workers: int = 2,
    minutes: float | None = None,
    progress: Progress | None = None,
    client: "Client | None" = None,
) -> int:
    """Works off the runs that are not done.

    Args:
        cases: All runs, in their order.
        output: Of the study.
        replicates: Of each diagnosis's bootstrap.
        workers: Processes.
        minutes: After which no run is begun; None for no end.
        progress: See `Progress`.
        client: Of a Dask cluster that does the runs, in place of processes: as many at once as it
            has threads. What it makes is kept here.

    Returns:
        Number of runs that are done.
    """
    show = progress or (lambda *_: None)
    end = None if minutes is None else time.monotonic() + 60.0 * minutes
    left = [case for case in cases if not is_done(output, case.name)]
    done = len(cases) - len(left)
    show("runs", done, len(cases))
    running: set[Future[Any]] = set()
    queue = iter(left)
    with ExitStack() as stack:
        place: _Here | _There
        if client is None:
            pool = stack.enter_context(worker_processes(workers))
            place = _Here(output, replicates, workers, pool)
        else:
            place = _There(output, replicates, client)
            stack.callback(place.close)
        while True:
            while len(running) < place.width() and (end is None or time.monotonic() < end):
                case = next(queue, None)
                if case is None:
                    break
                running.add(place.submit(case))
            if not running:
                return done
            ended, running = wait(running, return_when=FIRST_COMPLETED)
            for future in ended:
                place.keep(future.result())
                done += 1
                show("runs", done, len(cases))


class _Here:
    """Processes of this machine, which write their runs themselves."""

    def __init__(self, output: Path, replicates: int, workers: int, pool: Executor) -> None:
        self._output, self._replicates, self._workers = output, replicates, workers
        self._pool = pool

    def width(self) -> int:
        return self._workers

    def submit(self, case: Case) -> "Future[Any]":
        return self._pool.submit(run_case, case, self._output, self._replicates)

    def keep(self, made: Any) -> None:
        pass


class _There:
    """The workers of a cluster, which need nothing of this machine's disk."""

    def __init__(self, output: Path, replicates: int, client: "Client") -> None:
        self._output, self._replicates, self._client = output, replicates, client
        self._pool = client.get_executor(pure=False)

    def width(self) -> int:
        # Workers come and go.
        return max(1, sum(self._client.nthreads().values()))

    def submit(self, case: Case) -> "Future[Any]":
        food = food_file(self._output, case.protocol).read_text(encoding="utf-8")
        future: Future[Any] = self._pool.submit(run_case_there, case, food, self._replicates)
        return future

    def keep(self, made: Made) -> None:
        keep_case(*made, self._output)

    def close(self) -> None:
        self._pool.shutdown(wait=False)
