"""Lets a policy cut a slice, and measures it."""

import dataclasses as dc

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput, VectorLogSink

from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.diagrams.agent_station import add_agent
from sliceit_drake.diagrams.prepared_food import OwnCutting
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.diagrams.station import MakeStation
from sliceit_drake.learning.ending import Limits
from sliceit_drake.learning.metrics import SliceMetrics, slice_metrics
from sliceit_drake.systems.agent import AgentConfig, Decide

__all__ = ["LIMITS", "SliceTrace", "cut_slice"]


LONGEST = 25.0
"""Longest slice, s: as many decisions as in training."""
LIMITS = Limits(force=150.0, torque=30.0, workspace=(0.05, 0.1, 0.1745))
"""Greater than in training: what a policy does over its sensor's limit is measured too."""


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
    time, food, board, cut = _logged(logs, simulator)
    metrics = slice_metrics(time, food, board, cut, end)
    return SliceTrace(time, food, board, cut, np.array(heights), np.array(actions), metrics)


def _logged(
    logs: list[VectorLogSink], simulator: Simulator
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    found = [log.FindLog(simulator.get_context()) for log in logs]
    food, board, cut = (np.array(log.data()) for log in found)
    return np.array(found[0].sample_times()), food[3:].T, board[3:].T, cut[0]
