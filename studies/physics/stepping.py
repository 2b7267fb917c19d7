"""How far the force on the knife depends on the sub-step: constant, by need, with true masses."""

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
from sliceit_drake.cutting.model import CuttingModel, Numerics
from sliceit_drake.cutting.motion import Hold, Motion, MotionPlan, PressAndDraw, Retract, Segment
from sliceit_drake.cutting.simulate import ENERGY_RATIO_LIMIT, energy_ratio
from sliceit_drake.cutting.solver import NOT_FINITE, CuttingError, CuttingSolver
from sliceit_drake.cutting.stepping import STEPPING, Stepping
from studies.pages import table

__all__ = [
    "LONGEST",
    "STEPS",
    "StepCost",
    "StepResult",
    "SteppingCase",
    "aims_table",
    "cost_table",
    "error_table",
    "hold_table",
    "inertia_by_step_table",
    "inertia_table",
    "largest_table",
    "need_table",
    "planned_substeps",
    "slice_inertia",
    "step_costs",
    "stepping_cases",
    "stepping_study",
    "true_step",
    "turned_table",
]

STEPS = (2.5e-5, 1.25e-4, 2.5e-4, 5e-4, 1e-3, 2e-3)
"""Constant sub-steps, s. They divide the coupling period."""
LONGEST = Numerics().time_step
"""Longest sub-step by need, s."""

EXCHANGE = 2e-3
CLEARANCE = 5e-4
RAMP = 1.0  # Acceleration of the sequences' knife, m/s^2.
RAMPS = (0.5, 2.0)  # At turns, m/s^2.
RETRACT = 6e-3  # m.
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
        true_masses: Compare with true masses at a stable step; else with scaled ones at the
            smallest step.
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
        """Food, motion, speed and ramp."""
        ramp = f", {self.acceleration:g} m/s2" if self.acceleration else ""
        return f"{self.food.name}, {self.motion_name}, {1e3 * self.press_speed:g} mm/s{ramp}"

    def model(self, step: float, scaled: bool = True, by_need: bool = False) -> CuttingModel:
        """The cut at a step, constant or the longest by need.

        Raises:
            TimeStepError: Beyond the stability limit with true masses.
        """
        numerics = dc.replace(
            self.numerics, time_step=step, mass_scaling=scaled, step_by_need=by_need
        )
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
        time_step: The constant one or the longest, s.
        scaled: Whether masses are scaled.
        by_need: Whether sub-steps are shorter by need.
        reference: Whether this is what the others are compared with.
        refusal: Why it broke down, or None.
        rms_error: RMS of the force's difference over RMS of the reference's force.
        largest_difference: N.
        turned_error: What the rows from the turn on give of `rms_error`, the root of their part of
            its square; not a number without a turn.
        peak: Of the reference's force, N.
        energy_ratio: Largest kinetic over internal energy, looked at every 0.2 mm of travel.
        substeps: Mean number of sub-steps of a coupling step.
        finer: Fraction of coupling steps with more than the fewest.
        by_event: Fraction with more than the knife's motion asks for.
        stop: Coupling step in which the first segment of the motion ends.
        force_drop: Force before the stop less force 20 ms after it, N; not a number without hold.
        creep: Change of the force from then to the end of the hold, N; likewise.
        elements: Elements that are computed, and all of the split mesh.
    """

    case: SteppingCase
    time_step: float
    scaled: bool
    by_need: bool = False
    reference: bool = False
    refusal: str | None = None
    rms_error: float = np.nan
    largest_difference: float = np.nan
    turned_error: float = np.nan
    peak: float = np.nan
    energy_ratio: float = np.nan
    substeps: float = np.nan
    finer: float = 0.0
    by_event: float = 0.0
    stop: int = 0
    force_drop: float = np.nan
    creep: float = np.nan
    elements: tuple[int, int] = (0, 0)

    @property
    def column(self) -> tuple[bool, float]:
        """Place of its column in a table: constant steps first."""
        return self.by_need, self.time_step

    @property
    def too_much_inertia(self) -> bool:
        """Whether the kinetic energy is more than a simulation grants to added inertia."""
        return self.energy_ratio > ENERGY_RATIO_LIMIT


@dc.dataclass
class StepCost:
    """What a step costs on this machine; comparable only within one call of `step_costs`.

    Attributes:
        food: Name.
        time_step: The constant one or the longest, s.
        by_need: Whether sub-steps are shorter by need.
        elements: Elements that are computed.
        seconds: Wall time of a simulated second, s.
        spread: Standard deviation over the mean of the repeats.
    """

    food: str
    time_step: float
    by_need: bool
    elements: int
    seconds: float
    spread: float

    @property
    def column(self) -> tuple[bool, float]:
        """Place of its column in a table: constant steps first."""
        return self.by_need, self.time_step


def stepping_cases(
    foods: Sequence[tuple[Food, Knife, Numerics]], speeds: Sequence[float] = (0.02, 0.1)
) -> list[SteppingCase]:
    """For each food and speed: press, draw, turn round and hold after a sudden stop.

    The fastest also turn and stop on ramps, and but for those and draws they are compared with true
    masses: they are short, and inertia is largest. Where there are two speeds, the first food also
    turns at 5 and 50 mm/s.
    """
    cases = []
    for food, knife, numerics in foods:
        for speed in speeds:
            fastest = speed == max(speeds)
            press = SteppingCase(food, knife, numerics, speed, true_masses=fastest)
            turn = dc.replace(press, depth=0.6, retract=RETRACT)
            hold = dc.replace(press, depth=0.4, hold=0.15)
            draw = dc.replace(press, depth=0.5, draw_ratio=1.0, true_masses=False)
            cases += [press, draw, turn, hold]
            if fastest:
                ramped = [dc.replace(turn, acceleration=ramp) for ramp in RAMPS]
                ramped.append(dc.replace(hold, acceleration=RAMP))
                cases += [dc.replace(case, true_masses=False) for case in ramped]
    if len(speeds) > 1:
        press = SteppingCase(*foods[0], press_speed=0.05, depth=0.6, retract=RETRACT)
        cases += [press, dc.replace(press, press_speed=0.005, depth=0.15)]
    return cases


def true_step(case: SteppingCase, most: float) -> float:
    """Largest step up to `most` that divides the coupling step and is stable with true masses,
    s."""
    limit = min(most, 0.99 * case.model(most).critical_time_step)
    return EXCHANGE / int(np.ceil(EXCHANGE / limit - 1e-9))


def stepping_study(
    cases: Sequence[SteppingCase],
    steps: Sequence[float] = STEPS,
    workers: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> list[StepResult]:
    """Runs the cases at each step and by need, with scaled and where asked with true masses.

    Args:
        cases: The cuts.
        steps: s, each dividing 2 ms.
        workers: Threads; the number of processors by default.
        progress: Called after each run with the fraction of all sub-steps done.

    Returns:
        Results by case and step, the last by need. The reference is the first of its case.

    Raises:
        CuttingError: A reference broke down.
    """
    ordered = sorted(steps)
    runs: list[tuple[SteppingCase, float, bool, bool]] = []
    for case in cases:
        if case.true_masses:
            runs.append((case, true_step(case, ordered[0]), False, False))
        runs += [(case, step, True, False) for step in ordered]
        runs.append((case, LONGEST, True, True))

    def work(index: int) -> float:
        case, step, _, by_need = runs[index]
        duration = (case.depth * 0.03 + case.retract) / case.press_speed + case.hold
        return duration / (0.4 * step if by_need else step)

    total, done = sum(map(work, range(len(runs)))), 0.0
    outcomes: dict[int, tuple[StepResult, np.ndarray]] = {}
    # Kernels are made from their source at the first use, which threads must not do together.
    CuttingSolver(cases[0].model(ordered[-1]), EXCHANGE).compile()
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
    for index, (case, *_) in enumerate(runs):
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
            if case.retract:
                after = np.linalg.norm(difference[result.stop :])
                result.turned_error = float(after / np.linalg.norm(reference))
        results.append(result)
    return results


def _run(
    case: SteppingCase, step: float, scaled: bool, by_need: bool
) -> tuple[StepResult, np.ndarray]:
    """One run, and the force on the knife at each coupling step [n, 3], N."""
    result = StepResult(case, step, scaled, by_need)
    model = case.model(step, scaled, by_need)
    result.elements = model.element_count, len(model.split.tetrahedra)
    solver = CuttingSolver(model, EXCHANGE)
    motion = case.motion(model)
    path = KnifePath(model, motion, EXCHANGE)
    planned = planned_substeps(model, *path.poses(0, path.coupling_steps, commanded=True))
    taken = np.empty(path.coupling_steps, int)
    spent = ratio = 0.0
    force = np.zeros((path.coupling_steps, 3))
    block = max(1, round(CHECK_TRAVEL / (case.press_speed * EXCHANGE))) if path.rigid else 1
    starts = range(0, path.coupling_steps, block)
    launches = [Launch(k, min(block, path.coupling_steps - k)) for k in starts]
    for (k, count, _), (part,) in solver.driver.run([path], launches):
        end = k + count
        if not part.finite:
            result.refusal = f"until {end * EXCHANGE:.4g} s {NOT_FINITE}"
            return result, np.empty((0, 3))
        taken[k:end] = part.substeps
        force[k:end] = part.wrenches.sum(1)[:, 3:]
        spent += part.balance.edge + part.balance.opening + part.balance.friction
        ratio = max(ratio, energy_ratio(solver.energies(part.state, path.pose(end)), spent, model))
    result.energy_ratio = ratio
    result.substeps = float(taken.mean())
    result.finer = float((taken > round(EXCHANGE / step)).mean())
    result.by_event = float((taken > planned).mean())
    # Row k is the mean over the coupling step that ends at (k + 1) EXCHANGE.
    stop = result.stop = int(motion.phases[0][2] / EXCHANGE + 1e-6)
    if case.hold:
        norm = np.linalg.norm(force, axis=1)
        settled = stop + round(SETTLED / EXCHANGE)
        result.force_drop = float(norm[stop - 1] - norm[settled])
        result.creep = float(norm[-1] - norm[settled])
    return result, force


def planned_substeps(model: CuttingModel, R: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Numbers of sub-steps of the coupling steps that the knife's motion asks for [E].

    Args:
        model: The cut.
        R, p: Poses X_CK at the ends of coupling steps of 2 ms [E + 1, 3, 3] and [E + 1, 3], metres.
    """
    fewest = round(EXCHANGE / model.numerics.time_step)
    rule = Stepping.of(model, fewest)
    return np.array(rule.plan(np.zeros(STEPPING), R, p, EXCHANGE)[0])


def slice_inertia(model: CuttingModel) -> tuple[float, float]:
    """Stepped over true inertia of the half that comes off.

    In a translation, and turning about its centre of mass and the direction of the edge.
    """
    mine = model.split.node_side[model.computed[model.moving]] == model.free_side
    mass = np.where(mine, model.true_mass[model.moving], 0.0)
    nodes = model.nodes[model.moving]
    axis = np.eye(3)[0]
    turn = np.cross(axis, nodes - mass @ nodes / mass.sum())
    translation, rotation = (
        2.0 * model.inertia.kinetic_energy(v) / float(mass @ (v * v).sum(1))
        for v in (mine[:, None] * axis, mine[:, None] * turn)
    )
    return translation, rotation


def step_costs(
    foods: Sequence[tuple[Food, Knife, Numerics]],
    steps: Sequence[float] = STEPS,
    duration: float = 0.06,
    repeats: int = 3,
    progress: Callable[[float], None] | None = None,
) -> list[StepCost]:
    """Times a press at 20 mm/s on one thread, the steps and by need in turn and that several times.

    Args:
        foods: The cuts.
        steps: s.
        duration: Simulated, s.
        repeats: Over which the wall times are averaged.
        progress: Called after each run with the fraction of all sub-steps done.
    """
    costs, share = [], 0.0
    columns = [(False, step) for step in steps] + [(True, LONGEST)]
    work = len(foods) * repeats * sum(1.0 / step for _, step in columns)
    for food in foods:
        case = SteppingCase(*food, press_speed=0.02)
        solvers = [
            CuttingSolver(case.model(step, by_need=by_need), EXCHANGE) for by_need, step in columns
        ]
        motion = case.motion(solvers[0].model)
        paths = [KnifePath(solver.model, motion, EXCHANGE) for solver in solvers]
        # As many coupling steps a launch as a slice has between its checks.
        launches = [Launch(k, 10) for k in range(0, round(duration / EXCHANGE), 10)]
        for solver, path in zip(solvers, paths, strict=True):
            # Once before, for what is made for the first slice.
            list(solver.driver.run([path], launches))
        wall = np.zeros((repeats, len(columns)))
        for row in wall:
            for column, (solver, path) in enumerate(zip(solvers, paths, strict=True)):
                begin = time.perf_counter()
                for _ in solver.driver.run([path], launches):
                    pass
                row[column] = time.perf_counter() - begin
                share += 1.0 / columns[column][1] / work
                if progress is not None:
                    progress(share)
        seconds = wall / (10 * len(launches) * EXCHANGE)
        for (by_need, step), mean, deviation in zip(
            columns, seconds.mean(0), seconds.std(0), strict=True
        ):
            count = solvers[0].model.element_count
            costs.append(
                StepCost(food[0].name, step, by_need, count, float(mean), deviation / mean)
            )
    return costs


def _heads(columns: Sequence[tuple[bool, float]]) -> list[str]:
    return ["by need" if by_need else f"{step:g} s" for by_need, step in columns]


def _table(first: str, columns: Sequence[tuple[bool, float]], rows: Sequence[Sequence[str]]) -> str:
    return table(" | ".join([first, *_heads(columns)]), rows)


def _by_case(
    results: Sequence[StepResult], first: str, value: Callable[[StepResult], float], digits: int
) -> str:
    """A row for each case, a column for each step and one by need."""
    columns = sorted({r.column for r in results if r.scaled})
    rows: dict[str, dict[tuple[bool, float], str]] = {}
    for r in results:
        row = rows.setdefault(r.case.label, {})
        if r.scaled:
            star = "*" if r.too_much_inertia else ""
            row[r.column] = f"{value(r):.{digits}f}{star}" if r.refusal is None else "broke down"
    cells = [[label, *(row[column] for column in columns)] for label, row in rows.items()]
    return _table(first, columns, cells)


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


def turned_table(results: Sequence[StepResult]) -> str:
    """What the rows from a turn on give of the RMS error; squares of the two parts add up."""
    turns = [r for r in results if r.case.retract]
    return _by_case(
        turns, "of the RMS error, from the turn on [%]", lambda r: 100.0 * r.turned_error, 2
    )


def inertia_table(results: Sequence[StepResult]) -> str:
    """Largest kinetic over internal energy of any coupling step."""
    return _by_case(
        results, "largest kinetic/internal energy [%]", lambda r: 100.0 * r.energy_ratio, 3
    )


def hold_table(results: Sequence[StepResult]) -> str:
    """Drop of the force at a stop and its creep after that, of the reference and of each step."""
    held = [r for r in results if r.case.hold and (r.scaled or r.reference)]
    columns = sorted({r.column for r in held if r.scaled})
    rows = []
    for reference in (r for r in held if r.reference):
        of_case = [r for r in held if r.case is reference.case and r.scaled]
        cells = {r.column: f"{r.force_drop:.3f}, {r.creep:+.4f}" for r in of_case}
        name = f"{reference.case.label} ({reference.force_drop:.3f}, {reference.creep:+.4f})"
        rows.append([name, *(cells[column] for column in columns)])
    return _table("drop, creep [N] (reference)", columns, rows)


AIMS = (
    ("press and draw, 20 mm/s", 0.005),
    ("press and draw, 100 mm/s", 0.005),
    ("holds, 20 mm/s", 0.01),
    ("holds, 100 mm/s", 0.01),
    ("turning round, 5 to 100 mm/s", 0.015),
)
"""Kinds of cuts and the RMS error that was asked for; of turns at most a tenth of the peak, too."""


def aims_table(results: Sequence[StepResult], foods: Sequence[str]) -> str:
    """The largest RMS error by need of each kind of cut and food beside what was asked for; in
    brackets the largest difference over the peak."""
    worst: dict[tuple[str, str], tuple[float, float]] = {}
    for r in results:
        if r.by_need:
            speed = f", {1e3 * r.case.press_speed:g} mm/s"
            kind = "holds" + speed if r.case.hold else "press and draw" + speed
            kind = AIMS[-1][0] if r.case.retract else kind
            before = worst.get((kind, r.case.food.name), (0.0, 0.0))
            found = r.rms_error, r.largest_difference / r.peak
            worst[kind, r.case.food.name] = max(before[0], found[0]), max(before[1], found[1])
    rows = []
    for kind, limit in AIMS:
        turns = kind == AIMS[-1][0]
        cells = [kind, f"{limit:.1%}" + " (10 %)" * turns]
        for food in foods:
            rms, largest = worst[kind, food]
            text = f"{rms:.2%} ({largest:.1%})"
            cells.append(f"**{text}**" if rms > limit or turns and largest > 0.1 else text)
        rows.append([cell.replace("%", " %").replace("  ", " ") for cell in cells])
    return table(" | ".join(["motion", "asked for", *foods]), rows)


def need_table(results: Sequence[StepResult]) -> str:
    """Sub-steps of the coupling steps by need."""
    return table(
        f"by need, at most {LONGEST:g} s | mean number of sub-steps"
        " | coupling steps with more than the fewest [%]"
        " | with more than the knife's motion asks for [%]",
        (
            (r.case.label, f"{r.substeps:.1f}")
            + (f"{100.0 * r.finer:.0f}", f"{100.0 * r.by_event:.0f}")
            for r in results
            if r.by_need
        ),
    )


def inertia_by_step_table(
    foods: Sequence[tuple[Food, Knife, Numerics]], steps: Sequence[float] = STEPS
) -> str:
    """Stepped over true inertia of the slices that come off, see `slice_inertia`.

    With all stiffnesses, and with the elements' alone: what touches is hundreds of times softer.
    """
    rows = []
    for food, knife, numerics in foods:
        if food.held_sides not in ("minus", "plus"):
            continue
        alone = dc.replace(
            numerics,
            unloading_length=1e-2,
            bond_stiffness=0.01,
            flank_length=0.1,
            board_stiffness=0.01,
        )
        for name, settings in (("", numerics), (", elements alone", alone)):
            case = SteppingCase(food, knife, settings, press_speed=0.02)
            ratios = zip(*(slice_inertia(case.model(step)) for step in steps), strict=True)
            for motion, row in zip(("translation", "turning"), ratios, strict=True):
                label = f"slice of {food.name}, {motion}{name}"
                rows.append([label, *(f"{ratio:,.1f}" for ratio in row)])
    return _table("stepped over true inertia", [(False, step) for step in steps], rows)


def cost_table(costs: Sequence[StepCost]) -> str:
    """Cost of a simulated second."""
    columns = sorted({c.column for c in costs})
    rows: dict[str, list[str]] = {}
    for c in sorted(costs, key=lambda c: c.column):
        first = next(d for d in costs if d.food == c.food and d.column == columns[0])
        rows.setdefault(c.food, [f"{c.food}, {c.elements:,} elements"]).append(
            f"{c.seconds:.3g} ± {c.seconds * c.spread:.1g} s, "
            f"{100.0 * c.seconds / first.seconds:.3g} %"
        )
    first_cell = f"wall per simulated second, relative to {columns[0][1]:g} s"
    return _table(first_cell, columns, list(rows.values()))
