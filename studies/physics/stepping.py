"""How far the force on the knife depends on the sub-step, with scaled and with true masses."""

import dataclasses as dc
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed

import numpy as np

from sliceit_drake.cutting.driver import Launch
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.knife_path import KnifePath
from sliceit_drake.cutting.model import CuttingModel, Numerics, TimeStepError
from sliceit_drake.cutting.motion import Hold, Motion, MotionPlan, PressAndDraw, Retract, Segment
from sliceit_drake.cutting.simulate import ENERGY_RATIO_LIMIT, energy_ratio
from sliceit_drake.cutting.solver import NOT_FINITE, CuttingError, CuttingSolver
from studies.pages import table

__all__ = [
    "STEPS",
    "StepCost",
    "StepResult",
    "SteppingCase",
    "cost_table",
    "error_table",
    "hold_table",
    "inertia_table",
    "largest_table",
    "mass_table",
    "step_costs",
    "stepping_cases",
    "stepping_study",
    "true_step",
]

STEPS = (1e-5, 2e-5, 5e-5, 1e-4, 2.5e-4, 5e-4, 1e-3)
"""Sub-steps, s. They divide the coupling period."""

EXCHANGE = 2e-3
CLEARANCE = 5e-4
RAMP = 1.0  # Acceleration of the sequences' knife, m/s^2.
RETRACT = 0.01  # m.
CHECK_TRAVEL = 2e-4  # Of the knife between two looks at the energies, m.
SETTLED = 0.02  # After a stop, s: the force drop ends here and creep begins.


@dc.dataclass
class SteppingCase:
    """A cut of which the step's error is asked.

    Attributes:
        food, knife, numerics: The cut; `numerics` without its step and mass scaling.
        press_speed: m/s.
        draw_ratio: Draw over press speed.
        depth: Fraction of the section's height that the edge goes down.
        hold: Rest after a stop there, s; 0 for none.
        retract: Way back from there at the same speed, metres; 0 for none.
        acceleration: Of the ramps, m/s^2; None if the velocity steps.
        true_masses: Compare with true masses at a stable step, and try them at every step; else
            compare with scaled masses at the smallest step.
    """

    food: Food
    knife: Knife
    numerics: Numerics
    press_speed: float
    draw_ratio: float = 0.0
    depth: float = 1.0
    hold: float = 0.0
    retract: float = 0.0
    acceleration: float | None = None
    true_masses: bool = False

    @property
    def motion_name(self) -> str:
        """What the knife does."""
        if self.hold:
            return "hold after a ramp" if self.acceleration else "hold after a sudden stop"
        if self.retract:
            return "press and retract"
        return "draw" if self.draw_ratio else "press"

    @property
    def label(self) -> str:
        """Food, motion and speed."""
        return f"{self.food.name}, {self.motion_name}, {1e3 * self.press_speed:g} mm/s"

    def model(self, step: float, scaled: bool) -> CuttingModel:
        """The cut at a step.

        Raises:
            TimeStepError: Beyond the stability limit with true masses.
        """
        numerics = dc.replace(self.numerics, time_step=step, mass_scaling=scaled)
        return make_food_model(self.food, self.knife, numerics)

    def motion(self, model: CuttingModel) -> Motion:
        """The knife's motion from just above the food."""
        distance = CLEARANCE + self.depth * (model.top - model.bottom)
        press = PressAndDraw(
            press_speed=self.press_speed,
            distance=distance,
            draw_ratio=self.draw_ratio,
            acceleration=self.acceleration,
        )
        segments: list[Segment] = [press]
        if self.hold:
            segments.append(Hold(self.hold))
        if self.retract:
            segments.append(Retract(self.retract, self.press_speed, self.acceleration))
        offset = -0.5 * self.draw_ratio * distance
        return Motion(MotionPlan(segments), start_pose(model, CLEARANCE, offset))


@dc.dataclass
class StepResult:
    """A case at one step, compared with its reference at the same coupling steps.

    Attributes:
        case: The cut.
        time_step: s.
        scaled: Whether masses are scaled.
        reference: Whether this is what the others are compared with.
        refusal: Why it was not computed or broke down, or None.
        rms_error: RMS of the force's difference over RMS of the reference's force.
        largest_difference: N.
        peak: Of the reference's force, N.
        energy_ratio: Largest kinetic over internal energy, looked at every 0.2 mm of travel.
        mass_ratio: Stepped over true mass.
        force_drop: Force before the stop less force 20 ms after it, N; not a number without hold.
        creep: Change of the force from then to the end of the hold, N; likewise.
        elements: Elements that are computed, and all of the split mesh.
    """

    case: SteppingCase
    time_step: float
    scaled: bool
    reference: bool = False
    refusal: str | None = None
    rms_error: float = np.nan
    largest_difference: float = np.nan
    peak: float = np.nan
    energy_ratio: float = np.nan
    mass_ratio: float = np.nan
    force_drop: float = np.nan
    creep: float = np.nan
    elements: tuple[int, int] = (0, 0)

    @property
    def too_much_inertia(self) -> bool:
        """Whether a simulation would refuse the kinetic energy."""
        return self.energy_ratio > ENERGY_RATIO_LIMIT


@dc.dataclass
class StepCost:
    """What a step costs on this machine; comparable only within one call of `step_costs`.

    Attributes:
        food: Name.
        time_step: s.
        elements: Elements that are computed.
        seconds: Wall time of a simulated second, s.
        substep: Wall time of a sub-step, s.
        spread: Standard deviation over the mean of the repeats.
    """

    food: str
    time_step: float
    elements: int
    seconds: float
    substep: float
    spread: float


def stepping_cases(
    foods: Sequence[tuple[Food, Knife, Numerics]], speeds: Sequence[float] = (0.02, 0.1)
) -> list[SteppingCase]:
    """For each food and speed: press, that and 10 mm back, draw to 40 %, hold at 30 % of the depth.

    At the fastest the hold is also reached by a ramp. Only that speed is compared with true masses:
    it is short, and inertia is largest.
    """
    cases = []
    for food, knife, numerics in foods:
        for speed in speeds:
            fastest = speed == max(speeds)
            press = SteppingCase(food, knife, numerics, speed, true_masses=fastest)
            hold = dc.replace(press, depth=0.3, hold=0.15)
            back = dc.replace(press, retract=RETRACT)
            cases += [press, back, dc.replace(press, draw_ratio=1.0, depth=0.4), hold]
            if fastest:
                cases.append(dc.replace(hold, acceleration=RAMP))
    return cases


def true_step(case: SteppingCase, most: float) -> float:
    """Largest step up to `most` that divides the coupling step and is stable with true masses,
    s."""
    limit = min(most, 0.99 * case.model(most, True).critical_time_step)
    return EXCHANGE / int(np.ceil(EXCHANGE / limit - 1e-9))


def stepping_study(
    cases: Sequence[SteppingCase],
    steps: Sequence[float] = STEPS,
    workers: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> list[StepResult]:
    """Runs the cases at each step, with scaled and where asked with true masses.

    Args:
        cases: The cuts.
        steps: s, each dividing 2 ms.
        workers: Threads; the number of processors by default.
        progress: Called after each run with the fraction of all sub-steps done.

    Returns:
        Results by case and step. The reference is the first of its case.

    Raises:
        CuttingError: A reference broke down.
    """
    ordered = sorted(steps)
    runs: list[tuple[SteppingCase, float, bool]] = []
    for case in cases:
        if case.true_masses:
            finest = true_step(case, ordered[0])
            runs.append((case, finest, False))
            runs += [(case, step, False) for step in ordered if step > finest]
        runs += [(case, step, True) for step in ordered]

    def work(index: int) -> float:
        case, step, _ = runs[index]
        return ((case.depth * 0.03 + case.retract) / case.press_speed + case.hold) / step

    total, done = sum(map(work, range(len(runs)))), 0.0
    outcomes: dict[int, tuple[StepResult, np.ndarray]] = {}
    # Kernels are made from their source at the first use, which threads must not do together.
    CuttingSolver(cases[0].model(ordered[-1], True), EXCHANGE).compile()
    with ThreadPoolExecutor(workers or os.cpu_count() or 1) as pool:
        # The longest first, so that no thread is left with one at the end.
        longest = sorted(range(len(runs)), key=work, reverse=True)
        pending = {pool.submit(_run, *runs[index]): index for index in longest}
        for future in as_completed(pending):
            outcomes[pending[future]] = future.result()
            done += work(pending[future])
            if progress is not None:
                progress(done / total)
    results: list[StepResult] = []
    reference = np.empty(0)
    for index, (case, _, _) in enumerate(runs):
        result, force = outcomes[index]
        if not results or results[-1].case is not case:
            if result.refusal is not None:
                raise CuttingError(f"{case.label}: the reference broke down: {result.refusal}")
            result.reference, reference = True, force
        result.peak = float(np.linalg.norm(reference, axis=1).max())
        if result.refusal is None:
            difference = np.linalg.norm(force - reference, axis=1)
            result.rms_error = float(np.linalg.norm(difference) / np.linalg.norm(reference))
            result.largest_difference = float(difference.max())
        results.append(result)
    return results


def _run(case: SteppingCase, step: float, scaled: bool) -> tuple[StepResult, np.ndarray]:
    """One run, and the force on the knife at each coupling step [n, 3], N."""
    result = StepResult(case, step, scaled)
    try:
        model = case.model(step, scaled)
    except TimeStepError:
        limit = case.model(step, True).critical_time_step
        result.refusal = f"beyond the stability limit {limit:.3g} s"
        return result, np.empty((0, 3))
    result.mass_ratio = model.mass_ratio
    result.elements = model.element_count, len(model.split.tetrahedra)
    solver = CuttingSolver(model, EXCHANGE)
    motion = case.motion(model)
    path = KnifePath(model, motion, EXCHANGE)
    spent = ratio = 0.0
    force = np.zeros((path.coupling_steps, 3))
    block = max(1, round(CHECK_TRAVEL / (case.press_speed * EXCHANGE)))
    starts = range(0, path.coupling_steps, block)
    launches = [Launch(k, min(block, path.coupling_steps - k)) for k in starts]
    for (k, count, _), (part,) in solver.driver.run([path], launches):
        end = k + count
        if not part.finite:
            result.refusal = f"until {end * EXCHANGE:.4g} s {NOT_FINITE}"
            return result, np.empty((0, 3))
        force[k:end] = part.wrenches.sum(1)[:, 3:]
        spent += part.balance.edge + part.balance.opening + part.balance.friction
        ratio = max(ratio, energy_ratio(solver.energies(part.state, path.pose(end)), spent, model))
    result.energy_ratio = ratio
    if case.hold:
        norm = np.linalg.norm(force, axis=1)
        # Row k is the mean over the coupling step that ends at (k + 1) EXCHANGE.
        stop = int(motion.phases[1][1] / EXCHANGE + 1e-6)
        settled = stop + round(SETTLED / EXCHANGE)
        result.force_drop = float(norm[stop - 1] - norm[settled])
        result.creep = float(norm[-1] - norm[settled])
    return result, force


def step_costs(
    foods: Sequence[tuple[Food, Knife, Numerics]],
    steps: Sequence[float] = STEPS,
    duration: float = 0.06,
    repeats: int = 3,
    progress: Callable[[float], None] | None = None,
) -> list[StepCost]:
    """Times a press at 20 mm/s on one thread, the steps in turn and that several times.

    Args:
        foods: The cuts.
        steps: s.
        duration: Simulated, s.
        repeats: Over which the wall times are averaged.
        progress: Called after each run with the fraction of all sub-steps done.
    """
    costs, share = [], 0.0
    work = len(foods) * repeats * sum(1.0 / step for step in steps)
    for food in foods:
        case = SteppingCase(*food, press_speed=0.02)
        solvers = [CuttingSolver(case.model(step, True), EXCHANGE) for step in steps]
        motion = case.motion(solvers[0].model)
        paths = [KnifePath(solver.model, motion, EXCHANGE) for solver in solvers]
        # As many coupling steps a launch as a slice has between its checks.
        launches = [Launch(k, 10) for k in range(0, round(duration / EXCHANGE), 10)]
        for solver, path in zip(solvers, paths, strict=True):
            next(solver.driver.run([path], launches))
        wall = np.zeros((repeats, len(steps)))
        for row in wall:
            for column, (solver, path) in enumerate(zip(solvers, paths, strict=True)):
                begin = time.perf_counter()
                for _ in solver.driver.run([path], launches):
                    pass
                row[column] = time.perf_counter() - begin
                share += 1.0 / steps[column] / work
                if progress is not None:
                    progress(share)
        seconds = wall / (10 * len(launches) * EXCHANGE)
        for step, mean, deviation in zip(steps, seconds.mean(0), seconds.std(0), strict=True):
            count = solvers[0].model.element_count
            costs.append(
                StepCost(
                    food[0].name, step, count, float(mean), float(mean * step), deviation / mean
                )
            )
    return costs


def _table(first: str, steps: Sequence[float], rows: Sequence[Sequence[str]]) -> str:
    return table(" | ".join([first, *(f"{step:g} s" for step in steps)]), rows)


def _by_case(
    results: Sequence[StepResult], first: str, value: Callable[[StepResult], float], digits: int
) -> str:
    """A row for each case and kind of masses, a column for each step."""
    steps = sorted({r.time_step for r in results if r.scaled})
    rows: dict[str, dict[float, StepResult]] = {}
    for r in results:
        label = r.case.label + ("" if r.scaled else ", true masses")
        rows.setdefault(label, {})[r.time_step] = r
    cells = []
    for label, row in rows.items():
        # A row of nothing but refusals, and a reference between the columns, tell nothing.
        if any(step in row and row[step].refusal is None for step in steps):
            cells.append([label, *(_cell(row.get(step), value, digits) for step in steps)])
    return _table(first, steps, cells)


def _cell(r: StepResult | None, value: Callable[[StepResult], float], digits: int) -> str:
    if r is None:
        return ""
    if r.refusal is not None:
        return "unstable" if r.refusal.startswith("beyond") else "broke down"
    star = "*" if r.too_much_inertia else ""
    return f"{value(r):.{digits}f}{star}"


def error_table(results: Sequence[StepResult]) -> str:
    """RMS error of the force; a star where the kinetic energy is refused."""
    return _by_case(results, "RMS error [%]", lambda r: 100.0 * r.rms_error, 2)


def largest_table(results: Sequence[StepResult]) -> str:
    """Largest difference of the force in one coupling step over the peak force."""
    return _by_case(
        results,
        "largest difference [% of peak]",
        lambda r: 100.0 * r.largest_difference / r.peak,
        1,
    )


def inertia_table(results: Sequence[StepResult]) -> str:
    """Largest kinetic over internal energy of any coupling step."""
    return _by_case(
        results, "largest kinetic/internal energy [%]", lambda r: 100.0 * r.energy_ratio, 3
    )


def hold_table(results: Sequence[StepResult]) -> str:
    """Drop of the force at a stop and its creep after that, of the reference and of each step."""
    held = [r for r in results if r.case.hold and (r.scaled or r.reference)]
    steps = sorted({r.time_step for r in held if r.scaled})
    rows = []
    for reference in (r for r in held if r.reference):
        of_case = [r for r in held if r.case is reference.case and r.scaled]
        cells = {r.time_step: f"{r.force_drop:.3f}, {r.creep:+.4f}" for r in of_case}
        name = f"{reference.case.label} ({reference.force_drop:.3f}, {reference.creep:+.4f})"
        rows.append([name, *(cells[step] for step in steps)])
    return _table("drop, creep [N] (reference)", steps, rows)


def mass_table(results: Sequence[StepResult]) -> str:
    """Elements, stability limit with true masses, and stepped over true mass, for each food."""
    scaled = [r for r in results if r.scaled and r.refusal is None]
    steps = sorted({r.time_step for r in scaled})
    rows: dict[str, list[str]] = {}
    for r in scaled:
        name = r.case.food.name
        if name in rows and len(rows[name]) == len(steps) + 1:
            continue
        limit = r.case.model(r.time_step, True).critical_time_step
        computed, whole = r.elements
        label = f"{name}: {computed:,} of {whole:,} elements, limit {limit:.2g} s"
        rows.setdefault(name, [label]).append(f"{r.mass_ratio:,.1f}")
    return _table("stepped over true mass", steps, list(rows.values()))


def cost_table(costs: Sequence[StepCost]) -> str:
    """Cost of a simulated second and of a sub-step."""
    steps = sorted({c.time_step for c in costs})
    rows: dict[str, list[str]] = {}
    for c in sorted(costs, key=lambda c: c.time_step):
        first = next(d for d in costs if d.food == c.food and d.time_step == steps[0])
        rows.setdefault(c.food, [f"{c.food}, {c.elements:,} elements"]).append(
            f"{c.seconds:.3g} s, {100.0 * c.seconds / first.seconds:.3g} %, "
            f"{1e6 * c.substep:.0f} ± {1e6 * c.substep * c.spread:.0f} us"
        )
    first_cell = f"wall per simulated second, relative to {steps[0]:g} s, per sub-step"
    return _table(first_cell, steps, list(rows.values()))
