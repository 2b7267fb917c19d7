"""Real-time factor of the station and where the time goes.

All numbers come from one process on one core, so their ratios hold on any machine.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.diagrams.plant.robot_plant import add_plant, add_robot, connect_arm_controller
from sliceit_drake.diagrams.scenario import Scenario, load_scenario
from sliceit_drake.diagrams.scenario_diagram import ScenarioDiagram
from sliceit_drake.resources import resource_path
from sliceit_drake.systems.cutting_system import CuttingSystem
from studies.results import add_json_argument, write_results

__all__ = ["add_arguments", "run"]

WARM_UP = 0.7
DURATION = 1.2


def station_times(scenario: Scenario) -> tuple[float, float, int]:
    """Wall time of a cut of `DURATION`, the part spent in the food's kernels, and its elements."""
    in_food = 0.0
    calls = {name: getattr(CuttingSolver, name) for name in ("coupling_step", "energies")}

    def timed(name: str) -> Callable[..., Any]:
        def call(self: CuttingSolver, *arguments: Any) -> Any:
            nonlocal in_food
            begin = time.perf_counter()
            result = calls[name](self, *arguments)
            in_food += time.perf_counter() - begin
            return result

        return call

    for name in calls:
        setattr(CuttingSolver, name, timed(name))
    diagram = ScenarioDiagram(scenario)
    simulator = Simulator(diagram)
    diagram.SetStart(simulator.get_mutable_context())
    simulator.AdvanceTo(WARM_UP)
    in_food = 0.0
    begin = time.perf_counter()
    simulator.AdvanceTo(WARM_UP + DURATION)
    total = time.perf_counter() - begin
    for name, call in calls.items():
        setattr(CuttingSolver, name, call)
    cutting = diagram.station.cutting
    elements = 0
    if isinstance(cutting, CuttingSystem):
        solver = cutting.solver(cutting.GetMyContextFromRoot(simulator.get_context()))
        elements = solver.model.element_count
    return total, in_food, elements


def plant_time(scenario: Scenario) -> float:
    """Wall time of the arm with its joint controller alone, all of it Drake's C++."""
    builder = DiagramBuilder()
    plant, _ = add_plant(builder, scenario.robot)
    robot = add_robot(plant, scenario.robot, scenario.knife, scenario.board)
    plant.Finalize()
    controller = connect_arm_controller(builder, plant, robot, scenario.robot)
    command = builder.AddSystem(ConstantVectorSource(np.array(scenario.robot.joint_positions)))
    builder.Connect(command.get_output_port(), controller.GetInputPort("joint_positions_command"))
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(0.1)
    begin = time.perf_counter()
    simulator.AdvanceTo(0.1 + DURATION)
    return time.perf_counter() - begin


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("--repeat", type=int, default=3, help="runs, of which the fastest counts")
    add_json_argument(parser)


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    scenario = load_scenario(resource_path("scenarios/cucumber_measured.yaml"))
    baseline = load_scenario(resource_path("scenarios/cucumber_spring.yaml"))
    # In turns, so that other work on the machine slows all alike.
    turns = [
        (station_times(scenario), plant_time(scenario), station_times(baseline))
        for _ in range(options.repeat)
    ]
    (total, food, elements), plant = min(turn[0] for turn in turns), min(turn[1] for turn in turns)
    spring = min(turn[2] for turn in turns)[0]
    print(
        f"{elements} tetrahedra, sub-step {1e3 * scenario.numerics.time_step:g} ms, coupling step "
        f"{1e3 * scenario.exchange_period:g} ms, plant step "
        f"{1e3 * scenario.robot.plant_time_step:g} ms"
    )
    print(
        f"real-time factor while cutting: {DURATION / total:.2f}, of the spring-only baseline: "
        f"{DURATION / spring:.2f} ({total / spring:.2f} times as fast)"
    )
    for name, part in (
        ("food (Warp and its coupling step)", food),
        ("arm and joint control (Drake)", plant),
        ("other systems, record (Python)", total - food - plant),
    ):
        print(
            f"  {name:32s} {100 * part / total:5.1f} %  {1e6 * part / DURATION * 2e-3:7.0f} us/2 ms"
        )
    write_results(
        options,
        {
            "tetrahedra": elements,
            "real_time_factor": DURATION / total,
            "spring_real_time_factor": DURATION / spring,
        },
    )
    return 0
