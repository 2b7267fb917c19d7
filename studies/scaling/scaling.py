"""What more workers bring.

Runs a calibration's search on a journal file and on PostgreSQL, and records of the stand-in on
Dask, with 1 and 2 workers of this machine; measures what storage and scheduler carry when nothing
is simulated; and extrapolates to 1,000 workers by the model that the page states. What a part
lacks (a PostgreSQL server, Dask) is printed, and the rest is measured.
"""

import argparse
import copy
import dataclasses as dc
import multiprocessing
import pickle
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import warp

from sliceit_drake.calibration.prediction import Predictor
from sliceit_drake.calibration.search import open_study, search
from sliceit_drake.calibration.setup import load_setup
from sliceit_drake.records.validation import load_record
from sliceit_drake.resources import resource_path
from sliceit_drake.stand_in.protocol import Protocol, load_protocol
from sliceit_drake.stand_in.session import keep_record, record_session
from studies.marked_page import Place
from studies.results import describe_machine
from studies.scaling.local_database import NoServerError, local_database

__all__ = ["PLACE", "DaskRun", "SearchRun", "StorageLimits", "add_arguments", "run"]

optuna.logging.set_verbosity(optuna.logging.WARNING)
PLACE = Place("scaling")
FOOD = "cucumber"
WORKERS = (1, 2)
MODELLED = (1, 2, 10, 30, 100, 300, 1000)


@dc.dataclass
class SearchRun:
    """A search by some workers.

    Attributes:
        workers: Processes.
        trials: Finished.
        wall: From when all were ready to when the last had ended, s.
        simulation, storage, proposal: Of all workers, a trial, s: slices; writing and reading
            trials; the rest, which is Optuna's sampler.
    """

    workers: int
    trials: int
    wall: float
    simulation: float
    storage: float
    proposal: float


@dc.dataclass
class StorageLimits:
    """What a storage carries when nothing is simulated.

    Attributes:
        writes: Trials written a second, by the number of processes that write.
        read: Time in which a worker reads one trial of another's, s.
        reads: Trials that two processes read a second.
    """

    writes: dict[int, float]
    read: float
    reads: float


@dc.dataclass
class DaskRun:
    """Records made on a cluster.

    Attributes:
        walls: Wall time by workers, s.
        slices: Each time.
        tasks: Empty tasks a second.
        write: Time to write one record's files here, s.
        size: Of these, which travel, bytes.
    """

    walls: dict[int, float]
    slices: int
    tasks: float
    write: float
    size: int


def search_rate(workers: int, run: SearchRun, limits: StorageLimits, shared: bool) -> float:
    """Trials a second of many workers.

    Between two trials of its own a worker reads one of each other worker; a server writes and
    reads all of them.

    Args:
        workers: How many.
        run: Measured with one.
        limits: Of the storage.
        shared: Whether one server reads for all; a journal file is read by each worker alone.
    """
    alone = run.simulation + run.storage + run.proposal
    rate = workers / (alone + (workers - 1) * limits.read)
    written = max(limits.writes.values())
    server = 1.0 / written + (workers - 1) / limits.reads if shared else 1.0 / written
    return min(rate, 1.0 / server)


def dask_rate(workers: int, run: DaskRun) -> float:
    """Slices a second of many workers: theirs, the scheduler's or the writer's."""
    return min(workers * run.slices / run.walls[1], run.tasks, 1.0 / run.write)


def saturation(rate: Callable[[int], float]) -> int:
    """The fewest workers from which on another half as many bring less than a tenth more."""
    count = 1
    while count < 10**6 and rate(max(count + 1, count * 3 // 2)) >= 1.1 * rate(count):
        count = max(count + 1, int(count * 1.1))
    return count


class _Clock:
    """Time spent in methods of an object."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def around(self, thing: Any, *names: str) -> None:
        for name in names:
            call = getattr(thing, name)

            def timed(*args: Any, _call: Any = call, **kwargs: Any) -> Any:
                begin = time.perf_counter()
                try:
                    return _call(*args, **kwargs)
                finally:
                    self.seconds += time.perf_counter() - begin

            setattr(thing, name, timed)


def _search_worker(storage: str, seed: int, trials: int, ready: Any, results: Any) -> None:
    warp.config.log_level = warp.LOG_ERROR
    setup = load_setup(FOOD)
    record = load_record(resource_path(f"calibration/records/{FOOD}.csv"))
    predictor = Predictor(setup, [record], setup.search_time_step, workers=1)
    predictor.predict([predictor.start])
    study = open_study(storage, "scaling")
    simulation, stored = _Clock(), _Clock()
    simulation.around(predictor, "predict")
    stored.around(study, "add_trial", "get_trials")
    ready.wait()
    begin = time.perf_counter()
    search(predictor, study, trials, seed)
    results.put((time.perf_counter() - begin, simulation.seconds, stored.seconds))


def measure_search(storage: str, workers: int, trials: int) -> SearchRun:
    """Searches on an empty storage."""
    open_study(storage, "scaling")
    spawn = multiprocessing.get_context("spawn")
    ready, results = spawn.Barrier(workers), spawn.Queue()
    processes = [
        spawn.Process(target=_search_worker, args=(storage, 1 + k, trials, ready, results))
        for k in range(workers)
    ]
    for process in processes:
        process.start()
    times = np.array([results.get(timeout=3600) for _ in processes])
    for process in processes:
        process.join()
    finished = len(open_study(storage, "scaling").trials)
    wall, simulation, stored = times[:, 0], times[:, 1].sum(), times[:, 2].sum()
    rest = float(wall.sum() - simulation - stored)
    return SearchRun(
        workers,
        finished,
        float(wall.max()),
        float(simulation) / finished,
        float(stored) / finished,
        rest / finished,
    )


def _ready_trial() -> optuna.trial.FrozenTrial:
    names = [p.name for p in load_setup(FOOD).parameters]
    space: dict[str, optuna.distributions.BaseDistribution] = {
        name: optuna.distributions.FloatDistribution(0.0, 1.0) for name in names
    }
    attributes = {"broken": False, "seed": 0}
    return optuna.trial.create_trial(
        params=dict.fromkeys(names, 0.5), distributions=space, value=1.0, user_attrs=attributes
    )


def _writer(storage: str, seconds: float, ready: Any, results: Any) -> None:
    study, trial, count = open_study(storage, "hammer"), _ready_trial(), 0
    ready.wait()
    begin = time.perf_counter()
    while time.perf_counter() < begin + seconds:
        study.add_trial(trial)
        count += 1
    results.put(count / (time.perf_counter() - begin))


def _reader(storage: str, seconds: float, ready: Any, results: Any) -> None:
    """Reads all trials again and again, from a connection that knows none."""
    ready.wait()
    count, spent = 0, 0.0
    while spent < seconds:
        begin = time.perf_counter()
        open_study(storage, "nothing")
        opened = time.perf_counter()
        count += len(open_study(storage, "hammer").get_trials(deepcopy=False))
        # A journal file is parsed when it is opened: of both studies.
        both = time.perf_counter() - opened
        spent += both if "://" not in storage else both - (opened - begin)
    results.put(count / spent)


def _together(target: Any, storage: str, processes: int, seconds: float) -> float:
    spawn = multiprocessing.get_context("spawn")
    ready, results = spawn.Barrier(processes), spawn.Queue()
    started = [
        spawn.Process(target=target, args=(storage, seconds, ready, results))
        for _ in range(processes)
    ]
    for process in started:
        process.start()
    total = sum(results.get(timeout=600) for _ in started)
    for process in started:
        process.join()
    return float(total)


def measure_limits(storage: str, seconds: float) -> StorageLimits:
    """Writes and reads trials as fast as it goes."""
    open_study(storage, "nothing")
    writes = {n: _together(_writer, storage, n, seconds) for n in WORKERS}
    alone = _together(_reader, storage, 1, seconds)
    return StorageLimits(writes, 1.0 / alone, _together(_reader, storage, 2, seconds))


def small_protocol(slices: int) -> Protocol:
    """One condition of the poor protocol, cut so often."""
    protocol = copy.deepcopy(load_protocol(str(resource_path("calibration/protocols/poor.yaml"))))
    protocol.conditions = protocol.conditions[:1]
    protocol.conditions[0].replicates = slices
    return protocol


def _nothing(content: bytes, index: int) -> int:
    return index


def measure_dask(slices: int, tasks: int, folder: Path) -> DaskRun:
    """Records on a local cluster of one-thread workers, and empty tasks.

    Raises:
        ImportError: Dask is not installed.
    """
    from distributed import LocalCluster

    from sliceit_drake.cluster import connected

    protocol = small_protocol(slices)
    walls = {}
    rate = np.inf
    quiet = {"dashboard_address": "127.0.0.1:0", "worker_dashboard_address": "127.0.0.1:0"}
    for workers in WORKERS:
        with (
            LocalCluster(
                n_workers=workers, threads_per_worker=1, host="127.0.0.1", **quiet
            ) as cluster,
            connected(cluster.scheduler_address) as client,
        ):
            warm = folder / f"warm_{workers}"
            record_session(small_protocol(2 * workers), warm, seed=9, client=client)
            begin = time.perf_counter()
            record_session(protocol, folder / f"records_{workers}", seed=1, client=client)
            walls[workers] = time.perf_counter() - begin
            pool = client.get_executor(pure=False)
            content = pickle.dumps(protocol)
            begin = time.perf_counter()
            for future in [pool.submit(_nothing, content, k) for k in range(tasks)]:
                future.result()
            rate = tasks / (time.perf_counter() - begin)
    made = folder / "records_1"
    files = {file.name: file.read_bytes() for file in made.glob("slice_000.*")}
    begin = time.perf_counter()
    for _ in range(100):
        keep_record(files, folder / "warm_1")
    write = (time.perf_counter() - begin) / 100
    return DaskRun(walls, slices, rate, write, sum(map(len, files.values())))


def search_rows(runs: dict[str, list[SearchRun]]) -> list[tuple[object, ...]]:
    """What was measured of searches."""
    rows: list[tuple[object, ...]] = []
    for name, of_storage in runs.items():
        alone = of_storage[0].trials / of_storage[0].wall
        for run in of_storage:
            rate = run.trials / run.wall
            parts = (run.simulation, run.storage, run.proposal)
            rows.append(
                (name, run.workers, run.trials, f"{run.wall:.1f}", f"{rate:.2f}")
                + (f"{rate / alone:.2f}", *(f"{1e3 * part:.1f} ms" for part in parts))
            )
    return rows


def limit_rows(limits: dict[str, StorageLimits]) -> list[tuple[str, ...]]:
    """What was measured of storages."""
    return [
        (name, f"{each.writes[1]:.0f}", f"{each.writes[2]:.0f}", f"{1.0 / each.read:.0f}")
        + (f"{each.reads:.0f}",)
        for name, each in limits.items()
    ]


def dask_values(run: DaskRun) -> dict[str, object]:
    """What was measured of a cluster."""
    rows = [
        (workers, run.slices, f"{wall:.1f}", f"{run.slices / wall:.3f}")
        + (f"{run.walls[1] / wall:.2f}",)
        for workers, wall in run.walls.items()
    ]
    return {
        "rows": rows,
        "tasks": run.tasks,
        "task_ms": 1e3 / run.tasks,
        "record_kB": run.size / 1e3,
        "write_ms": 1e3 * run.write,
    }


def model_values(
    runs: dict[str, list[SearchRun]], limits: dict[str, StorageLimits], dask: DaskRun | None
) -> dict[str, object]:
    """The extrapolation: titles and rows of its table."""
    rates: dict[str, Callable[[int], float]] = {}
    for name, limit in limits.items():

        def rate(
            workers: int, run: SearchRun = runs[name][0], limit: Any = limit, name: str = name
        ) -> float:
            return search_rate(workers, run, limit, name == "PostgreSQL")

        rates[f"{name}, trials a second"] = rate
    if dask is not None:
        rates["Dask, slices a second"] = lambda workers: dask_rate(workers, dask)
    rows = [
        (
            str(n),
            *(f"{rate(n):.3g} ({100 * rate(n) / n / rate(1):.0f} %)" for rate in rates.values()),
        )
        for n in MODELLED
    ]
    full = (str(saturation(rate)) for rate in rates.values())
    rows.append(("**more bring little from**", *full))
    return {"titles": ["workers", *rates], "rows": rows}


@contextmanager
def storages(folder: Path) -> Iterator[dict[str, Callable[[str], str]]]:
    """Storages by name: each a function from the name of a purpose to a storage of its own."""
    with ExitStack() as stack:
        found: dict[str, Callable[[str], str]] = {
            "journal file": lambda purpose: str(folder / f"{purpose}.log")
        }
        try:
            import psycopg  # noqa: F401

            # Whether one starts here is known once one has; each purpose has its own.
            spare = [stack.enter_context(local_database())]
            found["PostgreSQL"] = lambda purpose: (
                spare.pop() if spare else stack.enter_context(local_database())
            )
        except (ImportError, NoServerError) as reason:
            print(f"PostgreSQL is left out: {reason}")
        yield found


def measure(options: argparse.Namespace) -> dict[str, object]:
    """What all tables show."""
    runs: dict[str, list[SearchRun]] = {}
    limits: dict[str, StorageLimits] = {}
    dask = None
    with tempfile.TemporaryDirectory() as folder, storages(Path(folder)) as places:
        for name, place in places.items():
            limits[name] = measure_limits(place("limits"), options.seconds)
            runs[name] = []
            for workers in WORKERS:
                storage = place(f"search_{workers}")
                runs[name].append(measure_search(storage, workers, options.trials))
                print(name, runs[name][-1], flush=True)
        try:
            dask = measure_dask(options.slices, options.tasks, Path(folder))
            print(dask, flush=True)
        except ImportError as reason:
            print(f"Dask is left out: {reason}")
    return {
        "searches": search_rows(runs),
        "limits": limit_rows(limits),
        "dask": None if dask is None else dask_values(dask),
        "model": model_values(runs, limits, dask),
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    PLACE.add_argument(parser)
    parser.add_argument("--trials", type=int, default=100, help="of each search (default 100)")
    parser.add_argument("--slices", type=int, default=12, help="of each session (default 12)")
    parser.add_argument("--tasks", type=int, default=2000, help="empty ones (default 2000)")
    parser.add_argument("--seconds", type=float, default=5.0, help="of each limit (default 5)")


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    PLACE.check(options.output)
    machine = describe_machine()
    PLACE.publish(options.output, **measure(options), command=options.command, machine=machine)
    return 0
