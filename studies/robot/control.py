"""How stiff a contact compliance control bears.

Computes the linear loop's limit over error scale x gain and servo lag, simulates the station on
both sides of it, and runs the station over the SliceIt! agent's whole box of gains on food and
board. Takes a few minutes. docs/explanation/control.md explains what comes out.
"""

import argparse
import copy
import dataclasses as dc
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator, SimulatorStatus
from pydrake.systems.framework import Context, DiagramBuilder, State
from pydrake.systems.primitives import LogVectorOutput
from tqdm import tqdm

from sliceit_drake.cutting.board import Board
from sliceit_drake.diagrams.agent_gains import AgentGains
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.diagrams.simulated_station import SimulatedStation
from sliceit_drake.diagrams.stability import ContactLoop, board_stiffness
from sliceit_drake.diagrams.station import MakeStation
from sliceit_drake.systems.analytic_cutter import AnalyticFood
from sliceit_drake.systems.compliance_controller import ComplianceControllerConfig
from sliceit_drake.systems.knife_force import KnifeForceSystem
from sliceit_drake.systems.servo import ServoConfig
from studies.figures import BLUE, GREEN, ORANGE, PURPLE, RED, new_figure, save_figure
from studies.pages import publish, table
from studies.robot.stiffness_limit import directional_stiffness, stiffness_limit

__all__ = [
    "BoxRun",
    "Check",
    "FactorRow",
    "add_arguments",
    "agent_box",
    "box_table",
    "check_on_station",
    "check_table",
    "factor_row",
    "factor_table",
    "plot_stability_map",
    "run",
    "run_in_contact",
    "stability_limits",
    "station_growth",
    "study_scenario",
    "with_lag",
]

AGENT_LOW = AgentGains(1000.0, 40.0, 0.02, 0.2, 1.5)
AGENT_HIGH = AgentGains(10000.0, 200.0, 0.1, 3.0, 2.5)
VERTICAL = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
FOOD_STIFFNESS = (4e3, 5e3)
BOARD_STIFFNESS = (1e5, 1e6)
# The step of the target that sets a vibration off, and how often its speed the vibration may reach
# before torque limits shape it.
KICK = 1e-6
LINEAR = 30.0
LAGS = (0.0, 0.005, 0.02, 0.03, 0.05)
# Mode, servo lag [s] and error scale x gain of the station's runs.
CHECKS = (
    *(("compliance", 0.005, gain) for gain in (0.003, 0.025)),
    *(("compliance", 0.02, gain) for gain in (0.025, 0.1)),
    *(("compliance", 0.03, gain) for gain in (0.003, 0.1)),
    ("compliance", 0.05, 0.1),
    *(("parallel", 0.005, gain) for gain in (0.003, 0.02)),
    *(("parallel", 0.02, gain) for gain in (0.03, 0.06)),
    *(("parallel", 0.03, gain) for gain in (0.01, 0.1)),
    ("motion", 0.03, 200.0),
)
FACTORS = (0.01, 0.03, 0.1, 0.3, 1.0)
TRACKING = ((0.03, "ideal"), (0.005, "arm"), (0.03, "arm"), (0.03, "servo"))
BOX_FACTORS, INTERIOR = (0.1, 1.0), 8


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument(
        "--output", metavar="FOLDER", type=Path, help="also write control.png and control.md there"
    )


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    gains = np.geomspace(1e-4, 1.0, 33)
    cases = [(mode, lag) for mode in ("compliance", "parallel") for lag in LAGS]
    limits = {(mode, lag): stability_limits(mode, gains, lag) for mode, lag in tqdm(cases, "map")}
    checks = list(tqdm(check_on_station(CHECKS), "station", total=2 * len(CHECKS)))
    rows = [
        factor_row(factor, lag, tracking)
        for factor, (lag, tracking) in tqdm(list(itertools.product(FACTORS, TRACKING)), "factors")
    ]
    box = list(itertools.product(BOX_FACTORS, ("food", "board"), agent_box(INTERIOR)))
    runs = [
        run_in_contact(point, factor, contact)
        for factor, contact, point in tqdm(box, "agent's box")
    ]
    text = "\n\n".join([check_table(checks), factor_table(rows), box_table(runs)])
    folder = options.output
    results = {"checks": checks, "factors": rows, "runs": runs}
    publish(text, folder and folder / "control.md", results)
    if folder is not None:
        plot_stability_map(gains, limits, checks, folder / "control.png")
    return 0


def with_lag(scenario: Scenario, lag: float) -> Scenario:
    """A copy with a critically damped servo of the given lag, s; the scenario's own at its lag."""
    scenario = copy.deepcopy(scenario)
    if lag != scenario.robot.servo.lag:
        scenario.robot.servo = ServoConfig(lookahead_time=lag, gain=4.0 / lag**2)
    return scenario


def study_scenario(mode: str, scaled_gain: float) -> Scenario:
    """A station without food, its controller scaled by the error scale.

    Args:
        mode: "compliance" with the gains of the README of cartesian_controllers, "parallel" with
            the middle of the agent's box, or "motion" as the scenarios track.
        scaled_gain: Error scale times P gain along z.
    """
    scenario = Scenario(controller=ComplianceControllerConfig(), food=AnalyticFood())
    scenario.monitor.enabled = False
    if mode == "parallel":
        scenario.controller = AgentGains(error_scale=1.0).controller(1.0)
    elif mode == "motion":
        scenario.controller = ComplianceControllerConfig(mode="motion", p_gains=[200.0] * 6)
    # A dead zone of 1 um would hide the first of a vibration.
    scenario.controller.dead_zones = False
    scenario.controller.error_scale = scaled_gain / scenario.controller.p_gains[2]
    return scenario


def stability_limits(
    mode: str, gains: Sequence[float] | np.ndarray, lag: float, *, on_board: bool = False
) -> np.ndarray:
    """Greatest stable vertical contact stiffness [n], N/m.

    Args:
        mode: As `study_scenario`.
        gains: Error scale times P gain along z [n].
        lag: Of the servo, s; 0 for an arm that follows each command at once and never yields.
        on_board: Whether the contact is in the plant, as the board, instead of beyond the coupling
            step.
    """
    limits = []
    station: SimulatedStation | None = None
    for gain in gains:
        scenario = study_scenario(mode, gain)
        if lag > 0.0:
            scenario = with_lag(scenario, lag)
        if station is None:
            station = MakeStation(scenario)
        # Only what the loop reads of the scenario differs, not the station's systems.
        station.scenario = scenario
        loop = ContactLoop(station, tracking="arm" if lag > 0.0 else "ideal")
        limits.append(stiffness_limit(loop, VERTICAL, on_board=on_board))
    return np.array(limits)


class _SpringContact(KnifeForceSystem):
    """A linear spring along Wz, slack where the knife starts: the contact of the linear loop.

    Args:
        stiffness: N/m.
        exchange_period: s.
        height: World height of Ko where it is slack, m.
    """

    def __init__(self, stiffness: float, exchange_period: float, height: float) -> None:
        super().__init__(exchange_period)
        self._stiffness = stiffness
        self._height = height

    def advance(
        self, context: Context, state: State, X_WK: RigidTransform
    ) -> tuple[np.ndarray, float]:
        force = -self._stiffness * (X_WK.translation()[2] - self._height)
        return np.array([0.0, 0.0, 0.0, 0.0, 0.0, force]), 0.0


def station_growth(scenario: Scenario, stiffness: float, duration: float = 2.0) -> float:
    """Growth of a vibration of the simulated station against a spring, in one coupling step.

    The knife starts where the spring is slack; a step of the target by 1 um sets it off.

    Args:
        scenario: Robot and controller, over an analytic food; the spring takes the food's place.
        stiffness: Of the spring, N/m.
        duration: Simulated time, s.

    Returns:
        Mean factor on the joints' speed, while it is small: below 1 if the vibration dies out.
    """
    assert isinstance(scenario.food, AnalyticFood)
    height = scenario.board.height + scenario.food.diameter + scenario.start.clearance
    builder = DiagramBuilder()
    station = builder.AddNamedSystem(
        "station",
        MakeStation(
            scenario,
            cutting=_SpringContact(stiffness, scenario.exchange_period, height),
        ),
    )
    builder.ExportInput(station.GetInputPort("target_pose"), "target_pose")
    log = LogVectorOutput(
        station.GetOutputPort("joint_velocities"), builder, publish_period=scenario.exchange_period
    )
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    station.SetStart(context)
    target = RigidTransform([0.0, 0.0, -KICK]) @ station.start_pose
    diagram.GetInputPort("target_pose").FixValue(context, target)
    simulator.AdvanceTo(duration)
    speed = np.linalg.norm(log.FindLog(context).data(), axis=0)
    first = speed[: round(0.05 / scenario.exchange_period)].max()
    n = int(np.argmax(speed > LINEAR * first)) or len(speed)
    early, late = speed[n // 4 : n // 2], speed[3 * n // 4 :]
    return float((np.mean(late**2) / np.mean(early**2)) ** (1.0 / n))


@dc.dataclass(frozen=True)
class Check:
    """A run of the station beside the linear loop's limit.

    Attributes:
        mode: Of the controller.
        lag: Of the servo, s.
        gain: Error scale times P gain along z.
        limit: Of the linear loop, N/m.
        stiffness: Of the spring, N/m.
        growth: `station_growth`.
    """

    mode: str
    lag: float
    gain: float
    limit: float
    stiffness: float
    growth: float

    @property
    def agrees(self) -> bool:
        """Whether the station is stable exactly where the loop is."""
        return (self.growth < 1.0) == (self.stiffness < self.limit)


def check_on_station(
    points: Sequence[tuple[str, float, float]], shares: Sequence[float] = (0.8, 1.25)
) -> Iterator[Check]:
    """Simulates the station on both sides of the loop's limit.

    Args:
        points: Mode, servo lag [s] and error scale times gain.
        shares: Stiffness over the limit.
    """
    for mode, lag, gain in points:
        (limit,) = stability_limits(mode, [gain], lag)
        scenario = with_lag(study_scenario(mode, gain), lag)
        for share in shares:
            growth = station_growth(scenario, share * limit)
            yield Check(mode, lag, gain, limit, share * limit, growth)


@dc.dataclass(frozen=True)
class BoxRun:
    """What came of a run with gains of the agent.

    Attributes:
        gains: Of the agent.
        factor: On the error scale.
        contact: "food" or "board".
        peak: Greatest force on the knife, N.
        stopped: Message of the monitor, or None.
        time: Simulated, s.
    """

    gains: AgentGains
    factor: float
    contact: str
    peak: float
    stopped: str | None
    time: float


def run_in_contact(
    gains: AgentGains, factor: float, contact: str, duration: float = 0.3, lag: float = 0.03
) -> BoxRun:
    """Presses the knife through the analytic food, or onto the board, with gains of the agent.

    The target is 10 mm below the start, which is the middle of the food, where it resists most, or
    just above the board, whose stiffness is 100 kN/m.

    Args:
        gains: Of the agent.
        factor: On its error scale.
        contact: "food" or "board".
        duration: Simulated time, s.
        lag: Of the servo, s.
    """
    scenario = with_lag(Scenario(food=AnalyticFood()), lag)
    assert isinstance(scenario.food, AnalyticFood)
    scenario.controller = gains.controller(factor)
    diameter = scenario.food.diameter
    height = 0.5 * diameter if contact == "food" else 2e-5
    scenario.start.clearance = height - diameter
    if contact == "board":
        scenario.food.toughness = 0.0
        # Steps of 1 ms would take more than is allowed from the peaks.
        scenario.board.stiffness, scenario.robot.plant_time_step = BOARD_STIFFNESS[0], 5e-4
    builder = DiagramBuilder()
    station = builder.AddNamedSystem("station", MakeStation(scenario))
    builder.ExportInput(station.GetInputPort("target_pose"), "target_pose")
    logs = [
        LogVectorOutput(station.GetOutputPort(name), builder, publish_period=2e-3)
        for name in ("food_wrench_vector", "board_wrench_vector")
    ]
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    station.SetStart(context)
    target = RigidTransform([0.0, 0.0, -0.01]) @ station.start_pose
    diagram.GetInputPort("target_pose").FixValue(context, target)
    status = simulator.AdvanceTo(duration)
    force = sum(log.FindLog(context).data()[3:] for log in logs)
    stopped = None
    if status.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition:
        stopped = status.message()
    peak = float(np.linalg.norm(force, axis=0).max())
    return BoxRun(gains, factor, contact, peak, stopped, context.get_time())


def agent_box(interior: int = 0, seed: int = 0) -> list[AgentGains]:
    """The 32 corners of the agent's box, lowest first and highest last, then points within.

    Args:
        interior: How many random points within.
        seed: Of those.
    """
    low, high = (np.array(dc.astuple(gains)) for gains in (AGENT_LOW, AGENT_HIGH))
    corners = itertools.product(*zip(low, high, strict=True))
    inside = np.random.default_rng(seed).uniform(low, high, (interior, len(low)))
    return [AgentGains(*map(float, point)) for point in [*corners, *inside]]


def _approach_time(loop: ContactLoop) -> float:
    """Time in which a vertical error falls to 1/e in free air, s; infinite if it grows."""
    if not loop.least_stable_mode().stable:
        return math.inf
    A, x = loop.cycle(), loop.displaced(VERTICAL)
    powers = [A]
    while len(powers) < 18:
        powers.append(powers[-1] @ powers[-1])
    cycles = 0
    # The greatest number of cycles after which the error is still above, bit by bit.
    for bit, power in reversed(list(enumerate(powers))):
        later = power @ x
        if loop.displacement(later)[2] > math.exp(-1.0):
            x, cycles = later, cycles + 2**bit
    return cycles * loop.period


@dc.dataclass(frozen=True)
class FactorRow:
    """The agent's box at one factor on its error scale and one way of tracking, linear.

    Attributes:
        factor: On the error scale.
        lag: Of the servo, s.
        tracking: As `ContactLoop`.
        unstable: How many of the 32 corners are unstable in free air, on food of 5 kN/m, and on
            a board of 100 kN/m.
        min_limit: Least stable vertical stiffness over the corners that are stable in air, N/m.
        approach: Time in which a vertical error falls to 1/e in free air, infinite if it grows, at
            the lowest corner, the middle and the highest corner, s.
    """

    factor: float
    lag: float
    tracking: str
    unstable: tuple[int, int, int]
    min_limit: float
    approach: tuple[float, float, float]


def factor_row(factor: float, lag: float, tracking: str = "arm") -> FactorRow:
    """Computes a row."""
    scenario = with_lag(Scenario(food=AnalyticFood()), lag)
    station = MakeStation(scenario)
    R_WK = station.start_pose.rotation().matrix()
    board = board_stiffness(Board(stiffness=BOARD_STIFFNESS[0]), scenario.knife, R_WK)
    food = directional_stiffness(VERTICAL, FOOD_STIFFNESS[1])

    def loop_of(gains: AgentGains) -> ContactLoop:
        scenario.controller = gains.controller(factor)
        return ContactLoop(station, tracking=tracking)

    box = agent_box()
    unstable, limit = np.zeros(3, int), np.inf
    for gains in box:
        loop = loop_of(gains)
        # Only an arm that yields has a contact in the plant.
        on_board = (None, board) if tracking == "arm" else (board,)
        stable = [loop.least_stable_mode(*c).stable for c in ((), (food,), on_board)]
        unstable += ~np.array(stable)
        if stable[0]:
            limit = min(limit, stiffness_limit(loop, VERTICAL))
    low, middle, high = (_approach_time(loop_of(g)) for g in (box[0], AgentGains(), box[-1]))
    counts = (int(unstable[0]), int(unstable[1]), int(unstable[2]))
    return FactorRow(factor, lag, tracking, counts, limit, (low, middle, high))


_TRACKING = {"arm": "arm", "servo": "rigid arm", "ideal": "rigid arm, no servo"}


def factor_table(rows: Sequence[FactorRow]) -> str:
    """The rows as a table for people."""
    cells = []
    for r in rows:
        lag = "-" if r.tracking == "ideal" else f"{1e3 * r.lag:g}"
        limit = f"{1e-3 * r.min_limit:.3g}" if np.isfinite(r.min_limit) else "-"
        times = ", ".join(f"{t:.2g}" if np.isfinite(t) else "never" for t in r.approach)
        cells.append((f"{r.factor:g}", lag, _TRACKING[r.tracking], *r.unstable, limit, times))
    return table(
        "factor | servo lag [ms] | tracking | unstable corners: air | food | board"
        " | least limit [kN/m] | approach [s]",
        cells,
    )


def check_table(checks: Sequence[Check]) -> str:
    """The station's runs beside the linear loop's limits."""
    return table(
        "mode | servo lag [ms] | error scale x p | limit [kN/m] | spring / limit"
        " | growth per s on the station | agrees",
        (
            (c.mode, f"{1e3 * c.lag:g}", f"{c.gain:g}", f"{1e-3 * c.limit:.3g}")
            + (f"{c.stiffness / c.limit:.3g}", f"{np.log(c.growth) / 2e-3:+.3g}")
            + ("yes" if c.agrees else "NO",)
            for c in checks
        ),
    )


def box_table(runs: Sequence[BoxRun]) -> str:
    """Runs over the agent's box, summed up by factor and contact."""
    rows = []
    groups: dict[tuple[float, str], list[BoxRun]] = {}
    for run in runs:
        groups.setdefault((run.factor, run.contact), []).append(run)
    for (factor, contact), group in groups.items():
        peaks = [
            max((f"{run.peak:.0f}" for run in group if bool(run.stopped) == ended), key=float)
            if any(bool(run.stopped) == ended for run in group)
            else "-"
            for ended in (False, True)
        ]
        ended = sum(run.stopped is not None for run in group)
        rows.append((f"{factor:g}", contact, len(group), ended, *peaks))
    return table(
        "factor | contact | runs | ended as unstable gains | greatest force, others [N]"
        " | greatest force, ended [N]",
        rows,
    )


def plot_stability_map(
    gains: np.ndarray,
    limits: Mapping[tuple[str, float], np.ndarray],
    checks: Sequence[Check],
    file: Path,
) -> None:
    """Draws the limit of the contact's stiffness over error scale times gain, and the checks.

    Args:
        gains: Error scale times P gain along z [n].
        limits: `stability_limits` [n] by mode and lag, N/m.
        checks: Of the station.
        file: PNG to write.
    """
    figure = new_figure(10.0, 4.6)
    modes = list(dict.fromkeys(mode for mode, _ in limits))
    lags = list(dict.fromkeys(lag for _, lag in limits))
    colours = ["#000000", BLUE, RED, GREEN, PURPLE]
    styles = [":", "-", "--", "-.", "-"]
    panels = figure.subplots(1, len(modes), sharey=True)
    for axes, mode in zip(np.atleast_1d(panels), modes, strict=True):
        axes.axhspan(*FOOD_STIFFNESS, color=GREEN, alpha=0.25, lw=0)
        axes.axhspan(*BOARD_STIFFNESS, color=ORANGE, alpha=0.18, lw=0)
        axes.text(gains[0], 4.5e3, " vegetables", va="center", fontsize=8)
        axes.text(gains[0], 3.2e5, " boards", va="center", fontsize=8)
        for lag, colour, style in zip(lags, colours, styles, strict=False):
            label = f"servo lag {1e3 * lag:g} ms" if lag else "ideal tracking"
            limit = limits[mode, lag]
            shown = np.where(limit > 0.0, limit, np.nan)
            axes.loglog(gains, shown, style, color=colour, label=label)
            for c in checks:
                if (c.mode, c.lag) == (mode, lag):
                    marker = "o" if c.growth < 1.0 else "x"
                    axes.plot(c.gain, c.stiffness, marker, mfc="white", color=colour, ms=6)
        if mode == "parallel":
            for k, factor in enumerate((0.01, 0.1, 1.0)):
                y = 180.0 * 1.9**k
                axes.plot([factor * 0.03, factor * 0.25], [y, y], color="0.35", lw=2)
                axes.text(factor * 0.26, y, f" factor {factor:g}", va="center", fontsize=7.5)
        axes.set_xlabel("error scale x P gain along z [1]")
        axes.set_xlim(gains[0], gains[-1])
        axes.set_ylim(1e2, 1e7)
        axes.grid(alpha=0.25, which="major")
        title = {"parallel": "parallel mode, middle of the agent's box"}.get(mode, f"{mode} mode")
        axes.set_title(title, loc="left", fontsize=10)
    first = np.atleast_1d(panels)[0]
    first.set_ylabel("largest stable vertical contact stiffness [N/m]")
    first.plot([], [], "o", mfc="white", color="0.3", label="station: dies out")
    first.plot([], [], "x", color="0.3", label="station: grows")
    first.legend(frameon=False, fontsize=7.5, labelspacing=0.25, loc="lower left")
    save_figure(figure, file, 150)
