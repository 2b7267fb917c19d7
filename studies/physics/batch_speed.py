"""Slices a second against batch size, on the CPU and on a CUDA device where there is one.

One kernel source for both: on the CPU a slice runs in one thread, on a GPU all cuts of a batch
advance side by side. The forces of the devices are compared. Without a CUDA device the reason is
printed, and the CPU is measured alone.
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
CPU_BATCHES, GPU_BATCHES = (1, 2, 4, 8, 16), (1, 4, 16, 64, 256, 1024)


def devices() -> list[str]:
    """The CPU, and the first CUDA device if there is one; if not, says why."""
    if wp.is_cuda_available():
        return ["cpu", "cuda:0"]
    print("The GPU is skipped: there is no CUDA device (Warp finds no NVIDIA driver, or no GPU).")
    return ["cpu"]


def variants(device: str, count: int, refinement: float) -> tuple[list[CuttingModel], Motion]:
    """Cuts of one cucumber with toughnesses of their own, and a press to the board at 20 mm/s."""
    scenario = load_scenario(resource_path("scenarios/cucumber_measured.yaml"))
    numerics = dc.replace(scenario.numerics, device=device)
    assert isinstance(scenario.food, Food)
    base = make_food_model(scenario.food, scenario.knife, numerics, refinement)
    plan = MotionPlan([ConstantSpeed(distance=base.top + 6e-4, speed=0.02)])
    motion = Motion(plan, start_pose(base, 6e-4))
    toughness = 300.0 + 100.0 * np.arange(count) / max(count, 1)
    return [with_parameters(base, {"material.toughness": float(r)}) for r in toughness], motion


def rate(device: str, count: int, refinement: float, repeats: int) -> tuple[float, np.ndarray, int]:
    """Slices a second, forces of the first slice [n, 3], N, and number of tetrahedra."""
    models, motion = variants(device, count, refinement)
    pool = DriverPool(PERIOD)
    # As `simulate_batch`, with the arrays and graphs kept from one call to the next.
    groups = [[model] for model in models] if device == "cpu" else [models]

    def cut(driver: Driver, some: list[CuttingModel]) -> list[BatchSlice]:
        return cut_together(driver, some, [motion] * len(some))

    forces = list(pool.map(cut, groups))[0][0].food_wrench[:, 3:]
    best = np.inf
    for _ in range(repeats):
        begin = time.perf_counter()
        list(pool.map(cut, groups))
        best = min(best, time.perf_counter() - begin)
    return count / best, forces, models[0].element_count


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    PLACE.add_argument(parser)
    parser.add_argument("--batches", type=int, nargs="+", help="cuts in one call")
    parser.add_argument("--refinement", type=float, default=1.0, help="of the mesh (default 1)")
    parser.add_argument("--repeats", type=int, default=3, help="of each time (default 3)")


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    PLACE.check(options.output)
    machine = describe_machine()
    rows, first, elements = [], None, 0
    found = devices()
    for device in found:
        batches = options.batches or (CPU_BATCHES if device == "cpu" else GPU_BATCHES)
        for count in tqdm(batches, desc=device):
            slices, forces, elements = rate(device, count, options.refinement, options.repeats)
            first = forces if first is None else first
            difference = np.sqrt(((forces - first) ** 2).mean() / (first**2).mean())
            rows.append((device, count, f"{slices:.2f}", f"{100 * difference:.4f} %"))
            tqdm.write(f"{device}: {count} cuts in one call, {slices:.2f} slices a second")
    PLACE.publish(
        options.output,
        rows=rows,
        elements=elements,
        repeats=options.repeats,
        command=options.command,
        machine=machine,
        gpu=wp.get_device("cuda:0").name if "cuda:0" in found else "",
    )
    return 0
