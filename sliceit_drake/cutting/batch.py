"""Many slices at once: side by side on a GPU, one a thread on a CPU."""

import dataclasses as dc
from collections.abc import Callable, Sequence

import numpy as np

from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.driver import Driver, DriverPool
from sliceit_drake.cutting.knife_path import KnifePath, PosedMotion, sample_poses
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.simulate import SliceForces
from sliceit_drake.cutting.solver import NOT_FINITE

__all__ = ["BatchSlice", "cut_together", "simulate_batch"]


@dc.dataclass
class BatchSlice(SliceForces):
    """One slice of a batch; the food's wrench is not finite from where it failed.

    Attributes:
        failure: Why it failed, or None.
    """

    failure: str | None


def simulate_batch(
    models: Sequence[CuttingModel],
    motions: Sequence[PosedMotion],
    exchange_period: float,
    board: Board | None = None,
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[BatchSlice]:
    """Simulates slices with parameters and motions of their own.

    Energies are not balanced and the knife's start is not checked, as in `simulate_slice`; a slice
    that breaks down is reported and does not disturb the others. Results do not depend on the
    number of workers.

    Args:
        models: The cuts [C]. Those derived from one model share their device arrays.
        motions: Poses X_FK of the knife [C], or one for all.
        exchange_period: s.
        board: Board under the knife, its height in F; None for none.
        workers: Threads on a CPU; the number of processors by default.
        progress: Called with the number of slices done.

    Raises:
        ValueError: The numbers of models and motions differ.
    """
    if len(motions) == 1:
        motions = [motions[0]] * len(models)
    if len(motions) != len(models):
        raise ValueError(f"{len(models)} models and {len(motions)} motions")
    groups: dict[object, list[int]] = {}
    for c, model in enumerate(models):
        key: object = c
        if model.numerics.device != "cpu":
            key = (id(model.split), len(model.relaxing), *dc.astuple(model.numerics))
        groups.setdefault(key, []).append(c)

    def run(driver: Driver, members: list[int]) -> list[BatchSlice]:
        some = [models[c] for c in members]
        return cut_together(driver, some, [motions[c] for c in members], board)

    # A GPU is busy with one group.
    threads = workers if all(model.numerics.device == "cpu" for model in models) else 1
    jobs = list(groups.values())
    results: dict[int, BatchSlice] = {}
    pool = DriverPool(exchange_period, threads)
    for members, slices in zip(jobs, pool.map(run, jobs), strict=True):
        results |= zip(members, slices, strict=True)
        if progress is not None:
            progress(len(results))
    return [results[c] for c in range(len(models))]


def cut_together(
    driver: Driver,
    models: Sequence[CuttingModel],
    motions: Sequence[PosedMotion],
    board: Board | None = None,
) -> list[BatchSlice]:
    """Simulates slices that advance side by side; their cuts are all derived from one model."""
    T = driver.exchange_period
    # A motion of many cuts is sampled once.
    poses = {id(motion): sample_poses(motion, T) for motion in {id(x): x for x in motions}.values()}
    paths = [KnifePath(m, x, T, poses[id(x)]) for m, x in zip(models, motions, strict=True)]
    count = max(path.coupling_steps for path in paths)
    wrenches = np.full((len(models), count, 3, 6), np.nan)
    cut = np.full((len(models), count), np.nan)
    for launch, steps in driver.run(paths, board=board):
        at = slice(launch.first, launch.first + launch.coupling_steps)
        for c, step in enumerate(steps):
            wrenches[c, at] = step.wrenches if step.finite else np.nan
            cut[c, at] = step.cut
    slices = []
    for c, path in enumerate(paths):
        n = path.coupling_steps
        food = path.in_food(wrenches[c, :n]).sum(1)
        finite = np.isfinite(food).all(1)
        failure = None
        if not finite.all():
            failure = f"at {(int(finite.argmin()) + 1) * T:.4g} s {NOT_FINITE}"
        time = np.arange(1, n + 1) * T
        on_board = path.board_wrenches(board)
        slices.append(BatchSlice(time, path.p_FK[1:], food, on_board, cut[c, :n], failure))
    return slices
