"""Real-time factor of the station, and where the time of a coupling step goes.

All numbers come from one process on one core, so their ratios hold on any machine. They are
processor times of its only thread, since other work on the machine comes and goes. The parts are
those of a run of its own, whose watched methods take a little longer. What Drake computes for the
inputs of a system, such as the plant's reactions for the sensor, is in the system that asked first.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.cutting.workspace import Workspace
from sliceit_drake.diagrams.plant.robot_plant import add_plant, add_robot, connect_arm_controller
from sliceit_drake.diagrams.scenario import Scenario, load_scenario
from sliceit_drake.diagrams.scenario_diagram import ScenarioDiagram
from sliceit_drake.resources import resource_path
from sliceit_drake.systems.compliance_controller import ComplianceController
from sliceit_drake.systems.contact_monitor import ContactMonitor
from sliceit_drake.systems.cutting_system import CuttingSystem
from sliceit_drake.systems.knife_force import AppliedForce, KnifeForceSystem
from sliceit_drake.systems.knife_kinematics import BoardContact
from sliceit_drake.systems.motion_sources import MotionSource
from sliceit_drake.systems.wrench_sensor import WrenchSensor
from studies.marked_page import Place
from studies.results import add_json_argument, describe_machine, write_results
from studies.watch import Watch

__all__ = ["add_arguments", "run"]

PLACE = Place("station_speed")
WARM_UP = 0.7
DURATION = 1.2

SOLVER = "solver around the kernels"
REST = "Drake: plant, servo, events, record"
PARTS = (
    (Workspace, "advance", "kernels of the food"),
    (Workspace, "stored_energies", "kernels of the food"),
    (CuttingSolver, "plan", SOLVER),
    (CuttingSolver, "move", SOLVER),
    (CuttingSolver, "energies", SOLVER),
    (KnifeForceSystem, "_update", "cutting system"),
    (WrenchSensor, "_update", "wrench sensor, reactions of the plant"),
    (ComplianceController, "_update", "compliance control"),
    (MotionSource, "_target_pose", "motion"),
    (AppliedForce, "_forces", "applied force"),
    (BoardContact, "_wrench", "board contact, pose of the knife"),
    (ContactMonitor, "_update", "contact monitor"),
)


def station_time(scenario: Scenario) -> tuple[float, int]:
    """Processor time of a cut of `DURATION`, s, and the number of the food's elements."""
    diagram = ScenarioDiagram(scenario)
    simulator = Simulator(diagram)
    diagram.SetStart(simulator.get_mutable_context())
    simulator.AdvanceTo(WARM_UP)
    begin = time.thread_time()
    simulator.AdvanceTo(WARM_UP + DURATION)
    total = time.thread_time() - begin
    cutting = diagram.station.cutting
    elements = 0
    if isinstance(cutting, CuttingSystem):
        solver = cutting.solver(cutting.GetMyContextFromRoot(simulator.get_context()))
        elements = solver.model.element_count
    return total, elements


def station_parts(scenario: Scenario) -> dict[str, float]:
    """Processor time of each part of a coupling step, us."""
    watch = Watch(time.thread_time)
    for owner, name, part in PARTS:
        watch.method(owner, name, part)
    diagram = ScenarioDiagram(scenario)
    simulator = Simulator(diagram)
    diagram.SetStart(simulator.get_mutable_context())
    simulator.AdvanceTo(WARM_UP)
    watch.spent = dict.fromkeys(watch.spent, 0.0)
    begin = time.thread_time()
    simulator.AdvanceTo(WARM_UP + DURATION)
    whole = time.thread_time() - begin
    watch.stop()
    watch.spent[REST] = whole - sum(watch.spent.values())
    steps = DURATION / scenario.exchange_period
    return {part: 1e6 * spent / steps for part, spent in watch.spent.items()}


def plant_time(scenario: Scenario) -> float:
    """Processor time of the arm with its joint controller alone, all of it Drake's C++."""
    builder = DiagramBuilder()
    plant, _ = add_plant(builder, scenario.robot)
    robot = add_robot(plant, scenario.robot, scenario.knife, scenario.board)
    plant.Finalize()
    controller = connect_arm_controller(builder, plant, robot, scenario.robot)
    command = builder.AddSystem(ConstantVectorSource(np.array(scenario.robot.joint_positions)))
    builder.Connect(command.get_output_port(), controller.GetInputPort("joint_positions_command"))
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(0.1)
    begin = time.thread_time()
    simulator.AdvanceTo(0.1 + DURATION)
    return time.thread_time() - begin


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("--repeat", type=int, default=3, help="runs, of which the fastest counts")
    parser.add_argument(
        "--before",
        metavar="FILE",
        type=Path,
        help="data/station_speed.json of an older checkout, to be shown beside",
    )
    PLACE.add_argument(parser)
    add_json_argument(parser)


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    PLACE.check(options.output)
    machine = describe_machine()
    scenario = load_scenario(resource_path("scenarios/cucumber_measured.yaml"))
    baseline = load_scenario(resource_path("scenarios/cucumber_spring.yaml"))
    # In turns, so that other work on the machine slows all alike.
    turns = [
        (
            station_time(scenario),
            station_parts(scenario),
            plant_time(scenario),
            station_time(baseline),
        )
        for _ in range(options.repeat)
    ]
    total, elements = min(turn[0] for turn in turns)
    spring = min(turn[3] for turn in turns)[0]
    parts = min((turn[1] for turn in turns), key=lambda each: sum(each.values()))
    before = None
    if options.before is not None:
        before = json.loads(options.before.read_text(encoding="utf-8"))["values"]["parts"]
    steps = DURATION / scenario.exchange_period
    PLACE.publish(
        options.output,
        elements=elements,
        sub_step=1e3 * scenario.numerics.time_step,
        coupling_step=1e3 * scenario.exchange_period,
        plant_step=1e3 * scenario.robot.plant_time_step,
        factor=DURATION / total,
        spring_factor=DURATION / spring,
        time=1e6 * total / steps,
        arm=1e6 * min(turn[2] for turn in turns) / steps,
        parts=parts,
        before=before,
        repeats=options.repeat,
        command=options.command,
        machine=machine,
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
