"""Slices a second against batch size, on the CPU and on a CUDA device where there is one.

One kernel source for both: on the CPU a slice runs in one thread, on a GPU all cuts of a batch
advance side by side. The forces of the devices are compared, and on request the gradient of one
slice. Without a CUDA device the reason is printed, and the CPU is measured alone.
"""

import argparse
import dataclasses as dc
import time

import numpy as np
import warp as wp
from tqdm import tqdm

from sliceit_drake.cutting.batch import BatchSlice, cut_together
from sliceit_drake.cutting.driver import Driver, DriverPool
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.gradient import SliceAdjoint
from sliceit_drake.cutting.knife_path import KnifePath
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan
from sliceit_drake.cutting.parameters import with_parameters
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.resources import resource_path
from studies.marked_page import Place
from studies.results import describe_machine

__all__ = ["add_arguments", "run"]

PLACE = Place("batch_speed")
PERIOD = 2e-3
CPU_BATCHES, GPU_BATCHES = (1, 2, 4, 8, 16), (1, 16, 256, 4096)


def devices() -> list[str]:
    """The CPU, and the first CUDA device if there is one; if not, says why."""
    if wp.is_cuda_available():
        return ["cpu", "cuda:0"]
    print("The GPU is skipped: there is no CUDA device (Warp finds no NVIDIA driver, or no GPU).")
    return ["cpu"]


def variants(
    device: str, count: int, refinement: float, precision: str | None = None
) -> tuple[list[CuttingModel], Motion]:
    """Cuts of one cucumber with toughnesses of their own, and a press to the board at 20 mm/s.

    Args:
        device, refinement: Of the numerics and of the mesh.
        count: Of the cuts.
        precision: Of the numerics; None for the scenario's.
    """
    scenario = load_scenario(resource_path("scenarios/cucumber_measured.yaml"))
    numerics = dc.replace(
        scenario.numerics, device=device, precision=precision or scenario.numerics.precision
    )
    assert isinstance(scenario.food, Food)
    base = make_food_model(scenario.food, scenario.knife, numerics, refinement)
    plan = MotionPlan([ConstantSpeed(distance=base.top + 6e-4, speed=0.02)])
    motion = Motion(plan, start_pose(base, 6e-4))
    toughness = 300.0 + 100.0 * np.arange(count) / max(count, 1)
    return [with_parameters(base, {"material.toughness": float(r)}) for r in toughness], motion


def rates(
    device: str, count: int, refinement: float, repeats: int
) -> tuple[float, float, np.ndarray, int]:
    """Slices a second of new cuts and of those cut before, forces of the first slice [n, 3], N,
    and number of tetrahedra."""
    models, motion = variants(device, count, refinement)
    pool = DriverPool(PERIOD)
    # As `simulate_batch`, which makes arrays, graphs and mass matrices anew in each call; here the
    # first makes them, and the others find them.
    groups = [[model] for model in models] if device == "cpu" else [models]

    def cut(driver: Driver, some: list[CuttingModel]) -> list[BatchSlice]:
        return cut_together(driver, some, [motion] * len(some))

    times, forces = [], np.empty(0)
    for _ in range(1 + repeats):
        begin = time.perf_counter()
        forces = list(pool.map(cut, groups))[0][0].food_wrench[:, 3:]
        times.append(time.perf_counter() - begin)
    return count / times[0], count / min(times[1:]), forces, models[0].element_count


def gradient(device: str, refinement: float) -> tuple[float, float, np.ndarray]:
    """Times of a slice and of its gradient, both in double precision, s, and the gradient by the
    knife's positions, N/m."""
    (model,), motion = variants(device, 1, refinement, precision="float64")
    adjoint = SliceAdjoint(model, PERIOD)
    path = KnifePath(model, motion, PERIOD)
    weights = np.ones((path.coupling_steps, 6))
    times, by_position = [], np.empty(0)
    for _ in range(2):
        begin = time.perf_counter()
        run = adjoint.run(path.R_CK, path.p_CK)
        middle = time.perf_counter()
        by_position = adjoint.gradient(run, weights).position
        times.append((middle - begin, time.perf_counter() - begin))
    return *times[1], by_position


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    PLACE.add_argument(parser)
    parser.add_argument("--batches", type=int, nargs="+", help="cuts in one call")
    parser.add_argument("--refinement", type=float, default=1.0, help="of the mesh (default 1)")
    parser.add_argument("--repeats", type=int, default=3, help="of each time (default 3)")
    parser.add_argument("--gradient", action="store_true", help="time one in double precision too")


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    PLACE.check(options.output)
    machine = describe_machine()
    rows, gradients, first, of_cpu, elements = [], [], None, None, 0
    found = devices()
    for device in found:
        batches = options.batches or (CPU_BATCHES if device == "cpu" else GPU_BATCHES)
        rates(device, 1, options.refinement, 1)  # Loads the kernels.
        for count in tqdm(batches, desc=device):
            new, again, forces, elements = rates(device, count, options.refinement, options.repeats)
            first = forces if first is None else first
            difference = np.sqrt(((forces - first) ** 2).mean() / (first**2).mean())
            rows.append((device, count, f"{new:.2f}", f"{again:.2f}", f"{100 * difference:.4f} %"))
            tqdm.write(f"{device}: {count} cuts, {new:.2f} slices a second, {again:.2f} once more")
        if options.gradient:
            slice_time, whole, found_gradient = gradient(device, options.refinement)
            of_cpu = found_gradient if of_cpu is None else of_cpu
            size = np.abs(of_cpu).max()
            difference = np.abs(found_gradient - of_cpu).max() / size
            gradients.append((device, f"{slice_time:.2f}", f"{whole:.2f}", f"{difference:.1e}"))
    PLACE.publish(
        options.output,
        rows=rows,
        gradients=gradients,
        elements=elements,
        repeats=options.repeats,
        command=options.command,
        machine=machine,
        gpu=wp.get_device("cuda:0").name if "cuda:0" in found else "",
    )
    return 0
