"""Lets a policy cut a slice, and measures it.

What counts was fixed before any policy was trained. The contact force is that of food and board on
the knife, without the tool's weight and inertia.
"""

import dataclasses as dc

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput

from sliceit_drake.cutting.simulate import COMPLETE
from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.diagrams.agent_station import add_agent
from sliceit_drake.diagrams.prepared_food import OwnCutting
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.diagrams.station import MakeStation
from sliceit_drake.learning.task import Limits
from sliceit_drake.systems.agent import AgentConfig, Decide

__all__ = ["LIMITS", "SliceMetrics", "SliceTrace", "cut_slice", "slice_metrics"]

LONGEST = 25.0
"""Longest slice, s: as many decisions as in training."""
LIMITS = Limits(force=150.0, torque=30.0, workspace=(0.05, 0.1, 0.1745))
"""Greater than in training: what a policy does over its sensor's limit is measured too."""
CONTACT = 0.5
"""Force from which a sample counts as contact, N."""


@dc.dataclass(frozen=True)
class SliceMetrics:
    """One slice.

    Attributes:
        median_force: Median of |F| over contact samples, N.
        peak_force: Greatest |F|, N.
        board_peak: Greatest force of the board, N.
        duration: From the start to the end of the slice, s.
        completed: Whether the section was cut through and the policy brought the slice to its end.
        cut: Fraction of the section that was cut.
        end: Why the slice ended: goal, force, torque, shaking, workspace, guard or time.
    """

    median_force: float
    peak_force: float
    board_peak: float
    duration: float
    completed: bool
    cut: float
    end: str


def slice_metrics(
    time: np.ndarray, food: np.ndarray, board: np.ndarray, cut: np.ndarray, end: str
) -> SliceMetrics:
    """Metrics of a slice that has ended.

    Args:
        time: [n], s.
        food, board: Forces on the knife [n, 3], N.
        cut: Fraction of the section that is cut [n].
        end: Why it ended.
    """
    force = np.linalg.norm(food + board, axis=1)
    contact = force[force >= CONTACT]
    share = float(cut[-1]) if len(cut) else 0.0
    return SliceMetrics(
        median_force=float(np.median(contact)) if len(contact) else 0.0,
        peak_force=float(force.max(initial=0.0)),
        board_peak=float(np.linalg.norm(board, axis=1).max(initial=0.0)),
        duration=float(time[-1] - time[0]) if len(time) else 0.0,
        completed=end == "goal" and share >= COMPLETE,
        cut=share,
        end=end,
    )


@dc.dataclass
class SliceTrace:
    """A slice as it went.

    Attributes:
        time: [n], s.
        food, board: Forces on the knife in W [n, 3], N.
        cut: Fraction of the section [n].
        height: Height of the edge over the board at the decisions [m], metres.
        actions: Actions decided [m, 6].
        metrics: Metrics of the slice.
    """

    time: np.ndarray
    food: np.ndarray
    board: np.ndarray
    cut: np.ndarray
    height: np.ndarray
    actions: np.ndarray
    metrics: SliceMetrics


def cut_slice(
    scenario: Scenario,
    agent: AgentConfig,
    decide: Decide,
    cutting: OwnCutting | None = None,
    limits: Limits = LIMITS,
    longest: float = LONGEST,
) -> SliceTrace:
    """Cuts one slice.

    Args:
        scenario: World, with the controller in parallel mode.
        agent: What the policy may do; `descent` is taken from the scenario.
        decide: The policy.
        cutting: A cutting system in place of the scenario's food.
        limits: What ends the slice before its goal.
        longest: Time after which it ends, s.

    Raises:
        ConfigurationError: The scenario cannot be built, or is not for an agent.
    """
    station = MakeStation(scenario, cutting=cutting)
    agent, builder = dc.replace(agent, descent=station.descent()), DiagramBuilder()
    actions: list[np.ndarray] = []

    def noted(observation: np.ndarray) -> np.ndarray:
        actions.append(np.asarray(decide(observation), float))
        return actions[-1]

    builder.AddNamedSystem("station", station)
    system = add_agent(builder, station, agent, noted)
    logs = [
        LogVectorOutput(station.GetOutputPort(name), builder, scenario.exchange_period)
        for name in ("food_wrench_vector", "board_wrench_vector", "cut_progress")
    ]
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    station.SetStart(context)
    simulator.Initialize()
    own = system.GetMyContextFromRoot(context)
    station_context = station.GetMyContextFromRoot(context)
    heights, end = [], ""
    while not end:
        heights.append(float(system.GetOutputPort("error").Eval(own)[1]))
        until = len(heights) * agent.period
        try:
            simulator.AdvanceTo(until)
        except CuttingError:
            end = "guard"
            break
        error = system.GetOutputPort("error").Eval(own)
        wrench = station.GetOutputPort("sensor_wrench").Eval(station_context).get_coeffs()
        at_goal = system.GetOutputPort("at_goal").Eval(own)[0] > agent.goal_decisions
        end = limits.end(at_goal, context.get_time(), until, wrench, error)
        if not end and context.get_time() >= longest:
            end = "time"
    found = [log.FindLog(context) for log in logs]
    time = np.array(found[0].sample_times())
    food, board, cut = (np.array(log.data()) for log in found)
    food, board, cut = food[3:].T, board[3:].T, cut[0]
    metrics = slice_metrics(time, food, board, cut, end)
    return SliceTrace(time, food, board, cut, np.array(heights), np.array(actions), metrics)
