"""Cost of a cut without a robot: slice, sub-step, gradient, against mesh and batch size.

Prints a table and writes a figure; each cost stands beside the error of the same mesh. Times are
processor times, the least of several repeats, taken in turns, since a shared machine only ever adds
to them. Those of a batch on several threads, all together, are beside its time by the clock.
"""

import argparse
import dataclasses as dc
import functools
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import warp as wp
from tqdm import tqdm

from sliceit_drake.cutting.batch import simulate_batch
from sliceit_drake.cutting.driver import Launch
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.gradient import SliceAdjoint
from sliceit_drake.cutting.knife_path import KnifePath
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan
from sliceit_drake.cutting.parameters import with_parameters
from sliceit_drake.cutting.simulate import SliceResult, simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.resources import resource_path
from studies.figures import new_figure, save_figure
from studies.pages import table
from studies.results import add_json_argument, write_results

__all__ = ["CLEARANCE", "PERIOD", "add_arguments", "min_times", "run", "sub_step_time", "through"]

PERIOD = 2e-3
CLEARANCE = 6e-4
REFINEMENTS = (0.5, 0.75, 1.0, 1.5, 2.0)
LARGER_STEPS = ((1.0, 5e-4), (1.0, 1e-3))
BATCHES = (1, 2, 4, 8, 16)


def through(model: CuttingModel, depth: float) -> Motion:
    """A press cut at 20 mm/s to the board, from above the top of the finest mesh."""
    plan = MotionPlan([ConstantSpeed(distance=depth + CLEARANCE, speed=0.02)])
    return Motion(plan, start_pose(model, CLEARANCE))


def min_times(
    calls: dict[str, Callable[[], object]], repeats: int
) -> tuple[dict[str, float], dict[str, float]]:
    """Least times of each call, in turns, after one that compiles, s.

    Returns:
        Those of the processor, of all threads, and those by the clock.
    """
    for call in calls.values():
        call()
    clocks = time.process_time, time.perf_counter
    best = [dict.fromkeys(calls, np.inf) for _ in clocks]
    for _ in tqdm(range(repeats), desc="repeats"):
        for name, call in calls.items():
            starts = [clock() for clock in clocks]
            call()
            for least, clock, start in zip(best, clocks, starts, strict=True):
                least[name] = min(least[name], clock() - start)
    return best[0], best[1]


def difference(a: SliceResult, b: SliceResult) -> float:
    """RMS difference of the forces over the RMS of b's."""
    fa, fb = a.food_wrench[:, 3:], b.food_wrench[:, 3:]
    return float(np.sqrt(((fa - fb) ** 2).sum(1).mean() / (fb**2).sum(1).mean()))


def sub_step_time(solver: CuttingSolver, motion: Motion, repeats: int = 20) -> float:
    """Time of a sub-step in mid-cut within a captured graph, s."""
    path = KnifePath(solver.model, motion, PERIOD)
    launches = [Launch(k, 10) for k in range(0, path.coupling_steps // 2 // 10 * 10, 10)]
    *_, (_, (middle,)) = solver.driver.run([path], launches)
    ws = solver._workspace
    steps = 50 * ws.steps
    with wp.ScopedCapture(device=ws.device) as capture:
        for k in range(steps):
            ws.launch_substep(k % ws.steps)
    best = np.inf
    for _ in range(repeats):
        ws.write(ws.states[0], middle.state[None])
        start = time.thread_time()
        wp.capture_launch(capture.graph)
        best = min(best, time.thread_time() - start)
    return best / steps


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("--output", metavar="FILE", type=Path, help="figure (.png)")
    add_json_argument(parser)
    parser.add_argument("--repeats", type=int, default=5, help="of each time (default 5)")


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    scenario = load_scenario(resource_path("scenarios/cucumber_measured.yaml"))
    food = scenario.food
    assert isinstance(food, Food) and isinstance(food.shape, Cylinder)
    diameter = food.shape.diameter
    models = {
        r: make_food_model(food, scenario.knife, scenario.numerics, r)
        for r in {*REFINEMENTS, *(r for r, _ in LARGER_STEPS)}
    }
    base = models[1.0]
    motion = through(base, diameter)
    solvers = {r: CuttingSolver(models[r], PERIOD) for r in REFINEMENTS}
    results = {r: simulate_slice(s, motion) for r, s in tqdm(solvers.items(), desc="meshes")}
    reference = results[REFINEMENTS[-1]]
    fine = base.derive(numerics=dc.replace(base.numerics, time_step=5e-5))
    exact = simulate_slice(CuttingSolver(fine, PERIOD), motion)
    steppers = {
        (r, step): CuttingSolver(
            models[r].derive(numerics=dc.replace(base.numerics, time_step=step)), PERIOD
        )
        for r, step in LARGER_STEPS
    }

    variants = [
        with_parameters(base, {"material.toughness": 350.0 + 5.0 * c}) for c in range(max(BATCHES))
    ]
    adjoint = SliceAdjoint(base, PERIOD)
    path = KnifePath(base, motion, PERIOD)
    weights = np.ones((path.coupling_steps, 6))
    cores = os.cpu_count() or 1
    calls: dict[str, Callable[[], object]] = {
        f"slice {r}": functools.partial(simulate_slice, solvers[r], motion) for r in REFINEMENTS
    }
    for key, solver in steppers.items():
        calls[f"stepped {key}"] = functools.partial(simulate_slice, solver, motion)
    calls["gradient"] = lambda: adjoint.gradient(adjoint.run(path.R_CK, path.p_CK), weights)
    for workers in {1, cores}:
        for n in BATCHES:
            calls[f"batch {n} {workers}"] = functools.partial(
                simulate_batch, variants[:n], [motion], PERIOD, workers=workers
            )
    times, by_clock = min_times(calls, options.repeats)
    rows = []
    for r in REFINEMENTS:
        m = models[r]
        rows.append(
            (
                m.element_count,
                1e6 * sub_step_time(solvers[r], motion),
                times[f"slice {r}"],
                difference(results[r], reference) if r < REFINEMENTS[-1] else np.nan,
            )
        )
    print(f"\nPress cut through {1e3 * diameter:g} mm of cucumber at 20 mm/s, one thread,")
    print(f"{base.numerics.precision}, coupling step {PERIOD:g} s, sub-step")
    print(f"{base.numerics.time_step:g} s")
    shown = (
        (n, f"{step:.1f}", f"{total:.3f}", "-" if np.isnan(error) else f"{100 * error:.2f} %")
        for n, step, total, error in rows
    )
    head = "tetrahedra | sub-step [us] | slice [s] | force error against the finest mesh"
    print(table(head, shown))
    step_error = difference(results[1.0], exact)
    print(f"\nforce error of the sub-step against 5e-5 s: {100 * step_error:.2f} % RMS")
    errors, larger = {}, []
    for (r, step), solver in steppers.items():
        small = dc.replace(base.numerics, time_step=5e-5)
        stepped = simulate_slice(CuttingSolver(models[r].derive(numerics=small), PERIOD), motion)
        error = errors[r, step] = difference(simulate_slice(solver, motion), stepped)
        total = times[f"stepped {(r, step)}"]
        larger.append(
            (models[r].element_count, f"{step:g}", f"{total:.3f}", f"{100 * error:.2f} %")
        )
    head = "tetrahedra | sub-step [s] | slice [s] | force error of the sub-step"
    print(f"\n{table(head, larger)}")
    ratio = times["gradient"] / times["slice 1.0"]
    print(f"gradient by all parameters and the path: {ratio:.2f} slices")
    threads = sorted({1, cores})
    batches = (
        (n, *(f"{some[f'batch {n} {w}'] / n:.3f}" for w in threads for some in (times, by_clock)))
        for n in BATCHES
    )
    columns = (f"{w} threads, {kind}" for w in threads for kind in ("processor", "clock"))
    print("\nseconds a cut")
    print(table(" | ".join(["cuts in one call", *columns]), batches))
    searched = (1.0, 1e-3)
    write_results(
        options,
        {
            "tetrahedra": base.element_count,
            "slice_s": times["slice 1.0"],
            "sub_step_us": rows[REFINEMENTS.index(1.0)][1],
            "mesh_error": difference(results[1.0], reference),
            "step_error": step_error,
            "search_slice_s": times[f"stepped {searched}"],
            "search_step_error": errors[searched],
            "gradient_slices": ratio,
            "batch_processor_s": times[f"batch {max(BATCHES)} {cores}"] / max(BATCHES) / cores,
        },
    )
    if options.output:
        plot(rows, times, threads, options.output)
    return 0


def plot(rows: list, times: dict[str, float], workers: list[int], file: Path) -> None:
    """Cost against mesh and against batch size."""
    figure = new_figure(8.0, 3.2)
    mesh, batch = figure.subplots(1, 2)
    counts = [row[0] for row in rows]
    mesh.loglog(counts, [row[2] for row in rows], "o-", color="#c2410c")
    mesh.set(xlabel="tetrahedra", ylabel="time of a slice [s]", title="one slice, one thread")
    error = mesh.twinx()
    error.loglog(counts[:-1], [100 * row[3] for row in rows[:-1]], "s--", color="#475569")
    error.set_ylabel("force error [%]", color="#475569")
    for w in workers:
        batch.plot(
            BATCHES, [times[f"batch {n} {w}"] / n for n in BATCHES], "o-", label=f"{w} threads"
        )
    batch.set(xlabel="cuts in one call", ylabel="processor time a cut [s]", title="many slices")
    batch.set_ylim(bottom=0.0)
    batch.legend(frameon=False)
    for axes in (mesh, batch):
        axes.grid(alpha=0.25)
    save_figure(figure, file, 150)
