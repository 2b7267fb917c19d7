"""Spreads simulations over a cluster, through joblib's Dask back end.

    with on_cluster("tcp://192.168.0.5:8786") as cluster:
        result = diagnose(..., workers=cluster)

The workers need this package, in the same version. What is found in memory or on disk is not sent,
and what comes back is kept here, so that results are those of one process.
"""

import contextlib
import copy
import dataclasses as dc
import threading
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from sliceit_drake.cluster import CONNECT, connected
from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.driver import Driver
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.prediction.simulator import Executor, Job, JobResult, run_job

if TYPE_CHECKING:
    from distributed import Client

__all__ = ["on_cluster"]


@contextlib.contextmanager
def on_cluster(scheduler: str, patience: float = CONNECT) -> Iterator[Executor]:
    """Connects to a Dask scheduler, for simulations.

    Args:
        scheduler: Its address, as tcp://HOST:8786.
        patience: For it and for its first worker, s.

    Yields:
        What runs jobs on the scheduler's workers.

    Raises:
        ConfigurationError: See `cluster.connected`.
    """
    with connected(scheduler, patience) as client:
        yield lambda jobs, period, board: _run_jobs(client, jobs, period, board)


def _run_jobs(
    client: "Client", jobs: Sequence[Job], period: float, board: Board
) -> Iterator[tuple[int, JobResult]]:
    import joblib

    work: list[Any] = []
    meshes: list[CuttingModel] = []
    for number, job in enumerate(jobs):
        model = job.model
        if not meshes or meshes[-1].split is not model.split:
            meshes.append(model)
        shared = meshes[-1]
        own = {
            f.name: getattr(model, f.name)
            for f in dc.fields(model)
            if getattr(model, f.name) is not getattr(shared, f.name)
        }
        rest = {name: value for name, value in vars(job).items() if name != "model"}
        work.append(joblib.delayed(_run_there)(number, shared, own, rest, period, board))
    # What is scattered travels to a worker once, however many calls name it.
    with joblib.parallel_config(backend="dask", client=client, scatter=meshes):
        # One slice takes longer than to send it; larger batches would leave workers idle.
        parallel = joblib.Parallel(n_jobs=-1, batch_size=1, return_as="generator_unordered")
        yield from parallel(work)


_THREAD = threading.local()


def _run_there(
    number: int,
    shared: CuttingModel,
    own: dict[str, Any],
    rest: dict[str, Any],
    period: float,
    board: Board,
) -> tuple[int, JobResult]:
    """Runs a job on a worker, which keeps its driver from one to the next.

    The job's cut is `shared` but for what is its `own`.
    """
    model = copy.copy(shared)
    vars(model).update(own)
    drivers: dict[float, Driver] = _THREAD.__dict__.setdefault("drivers", {})
    driver = drivers.setdefault(period, Driver(period))
    return number, run_job(driver, Job(model, **rest), board)
