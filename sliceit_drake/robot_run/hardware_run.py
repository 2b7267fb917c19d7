"""Runs a scenario on a robot: the diagram follows the controller's clock."""

import dataclasses as dc
import gc
import sys
import time as clock
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator, SimulatorStatus

from sliceit_drake.cutting.motion import Motion
from sliceit_drake.diagrams.hardware_station import (
    PERIOD,
    HardwareStation,
    RobotConnection,
    make_edge_kinematics,
)
from sliceit_drake.diagrams.run import Run, measured_profile
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.diagrams.scenario_diagram import ScenarioDiagram
from sliceit_drake.diagrams.simulated_station import FRAMES_PER_SECOND, SimulatedStation
from sliceit_drake.diagrams.stability import check_contact_margin
from sliceit_drake.diagrams.station import MakeStation
from sliceit_drake.hardware.checks import (
    Check,
    check_facts,
    check_kinematics,
    check_payload,
    check_sensor,
    check_start,
    check_unzeroed,
)
from sliceit_drake.hardware.client import RobotClient, RobotState
from sliceit_drake.hardware.hardware_config import HardwareConfig
from sliceit_drake.hardware.rtde_link import RobotLink
from sliceit_drake.hardware.safety import Stop
from sliceit_drake.interruption import raise_if_interrupted
from sliceit_drake.output_folder import set_aside
from sliceit_drake.robot_run.plan_check import JointPlan, check_plan, plan_joints
from sliceit_drake.systems.agent import AgentSystem
from sliceit_drake.systems.motion_sources import placed_motion
from sliceit_drake.systems.policy import PolicySystem

__all__ = [
    "INTERRUPTED",
    "NO_DATA",
    "HardwareRun",
    "prepare_hardware_run",
    "steady_python",
    "write_hardware_outputs",
]

INTERRUPTED = "interrupted by the user"
"""Why a run stopped that Ctrl-C or another signal ended."""
SENSOR_SAMPLES = 50
WARM_UP = 0.05
"""Simulated in another context before the run, s."""
NO_DATA = 1.0
"""Controller time without data after which a run ends, s."""


@dc.dataclass
class HardwareRun:
    """A scenario on a robot.

    Attributes:
        scenario: What is run, with the board's measured height.
        config: The robot's file.
        client: Connected.
        twin: The simulated station of the same scenario, for model, start and replay.
        plan: The motion in joint space.
        pace: Controller seconds in a second.
        run: Diagram and results, once it ran.
        link: Link to the robot, once it ran.
        stop: Why the robot stopped, once it ran.
        abandoned: Called from the link's thread if the diagram does not come back after a stop; see
            `RobotLink`.
        error: What the run ended by, if that was an error; for who wrote a policy or a system.
    """

    scenario: Scenario
    config: HardwareConfig
    client: RobotClient
    twin: SimulatedStation
    plan: JointPlan
    pace: float = 1.0
    run: Run | None = None
    link: RobotLink | None = None
    stop: Stop | None = None
    abandoned: Callable[[Stop], None] | None = None
    error: Exception | None = None

    @property
    def motion(self) -> Motion:
        """The motion of the knife."""
        return placed_motion(self.twin.motion_plan, self.twin.start_pose)

    def check_facts(self) -> list[Check]:
        """Checks of the robot itself."""
        checks = check_facts(self.client.facts(), self.config)
        return [*checks, check_kinematics(self.client.read(), self.config)]

    def check_before(self) -> list[Check]:
        """Checks that need nothing to be done to the robot."""
        return [
            *self.check_facts(),
            *check_plan(self.plan, self.twin, self.config, self.client),
        ]

    def check_at_start(self) -> list[Check]:
        """Checks the start pose, zeroes the force sensor there, and checks what it shows."""
        start = self.twin.start_joints.tolist()
        checks = check_start(self.client.read(), start, self.config)
        if all(check.passed for check in checks):
            states, kinematics = self._some_states(), make_edge_kinematics(self.twin)
            checks.append(check_unzeroed(states, kinematics, self.config, SENSOR_SAMPLES))
        if all(check.passed for check in checks):
            self.client.zero_sensor()
            checks += check_sensor(self._some_states(), self.config, SENSOR_SAMPLES)
        return checks

    def not_ready(self, link: RobotLink) -> str | None:
        """What has changed while the operator read the plan: the arm, its payload, a contact.

        Returns:
            The first check that does not pass, in words; None if all do.
        """
        start = self.twin.start_joints.tolist()
        states: list[RobotState] = []
        status = link.latest()
        while len(states) < SENSOR_SAMPLES:
            newer = link.wait(status, NO_DATA / self.pace)
            if newer is None:
                break
            states.append(newer.state)
            status = newer
        state = status.state
        checks = [
            *check_start(state, start, self.config),
            *check_payload(state.payload, self.config),
            check_kinematics(state, self.config),
            *check_sensor(states, self.config, SENSOR_SAMPLES),
            check_unzeroed(states, make_edge_kinematics(self.twin), self.config, SENSOR_SAMPLES),
        ]
        return next((str(check) for check in checks if not check.passed), None)

    def execute(
        self,
        duration: float | None = None,
        progress: Callable[[float, float], None] | None = None,
        *,
        moves: bool = True,
    ) -> Run:
        """Runs the scenario to its end, or to the first fault; always stops the robot's program.

        An error in the diagram, such as a policy's, is a fault like any other: it ends the run, and
        what was measured up to there is kept.

        Args:
            duration: Duration, s; None for the motion's.
            progress: Called with run time and wall time, s, now and then.
            moves: False to let the diagram follow the robot's data without sending anything.

        Returns:
            The run; `stopped` says why it ended early, or None.
        """
        robot = RobotConnection(self.client, self.config, self.pace, self.twin)
        station = MakeStation(self.scenario, hardware=robot)
        link = self.link = station.link
        link.abandoned = self.abandoned
        link.start()
        reason = "the program ended by an error"
        try:
            run = self.run = self._prepare(station)
            with steady_python():
                self._follow(run, station, duration or run.motion.duration, progress, moves)
            reason = run.stopped or "the motion is complete"
        except KeyboardInterrupt:
            reason = INTERRUPTED
            if self.run is None:
                raise
            self.run.stopped = reason
        except Exception as error:
            if self.run is None:
                raise
            self.error = error
            reason = self.run.stopped = f"{type(error).__name__}: {error}"
        finally:
            stop = self.stop = link.finish(reason)
        if stop.limit != "end":
            self.run.stopped = str(stop)
        elif link.stop_error is not None:
            self.run.stopped = f"{reason}, but the robot has not confirmed that it is stopped"
        return self.run

    def _prepare(self, station: HardwareStation) -> Run:
        diagram = ScenarioDiagram(self.scenario, station)
        simulator = Simulator(diagram)
        diagram.SetStart(simulator.get_mutable_context())
        margin = check_contact_margin(self.twin)
        # What runs for the first time is slow: it runs in another context before it counts.
        rehearsal = Simulator(diagram, simulator.get_context().Clone())
        rehearsal.Initialize()
        rehearsal.AdvanceTo(WARM_UP)
        profile, meshcat = measured_profile(self.scenario), self.twin.meshcat
        return Run(self.scenario, diagram, simulator, profile, margin, meshcat)

    def _follow(
        self,
        run: Run,
        station: HardwareStation,
        duration: float,
        progress: Callable[[float, float], None] | None,
        moves: bool,
    ) -> None:
        link, simulator, policy = station.link, run.simulator, run.diagram.policy
        if policy is not None:
            assert self.scenario.policy is not None
            assert isinstance(policy, PolicySystem | AgentSystem)
            period = self.scenario.policy.period
            policy.watch = lambda: link.deadline("policy", period)
        context = simulator.get_mutable_context()
        rtde = station.rtde
        own = rtde.GetMyMutableContextFromRoot(context)
        if moves:
            stop = self.not_ready(link) or link.arm()
            if stop is not None:
                run.stopped = str(stop)
                rtde.receive(own)
                simulator.Initialize()
                return
        status = link.latest()
        rtde.receive(own, status)
        simulator.Initialize()
        zero, begin = status.state.time, clock.perf_counter()
        shown = 0.0
        while True:
            raise_if_interrupted()
            newer = link.wait(status, NO_DATA / self.pace)
            if newer is None:
                run.stopped = "no data from the robot"
                return
            is_new, status = newer.state is not status.state, newer
            # A time that goes back is a fault; the diagram cannot follow it.
            now = round((status.state.time - zero) / PERIOD) * PERIOD
            if rtde.receive(own, status) is not None:
                run.stopped = str(status.stop)
                return
            if not is_new:
                continue
            # While it sends, the link's thread looks itself.
            fault = None if moves else link.look(status.state)
            if fault is not None:
                run.stopped = str(fault)
                return
            simulator.AdvanceTo(now)
            outcome = simulator.AdvancePendingEvents()
            if moves:
                rtde.send(own)
            run.wall_time = clock.perf_counter() - begin
            if outcome.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition:
                run.stopped = outcome.message()
                return
            if now >= duration - 1e-9:
                return
            if progress is not None and now > shown + 0.1:
                shown = now
                progress(now, run.wall_time)

    def _some_states(self) -> list[RobotState]:
        """States of as many cycles from now on; fewer if the data do not go on."""
        states: list[RobotState] = []
        before, deadline = self.client.timestamp(), clock.perf_counter() + NO_DATA / self.pace
        while len(states) < SENSOR_SAMPLES and clock.perf_counter() < deadline:
            if self.client.timestamp() != before:
                states.append(self.client.read())
                before = states[-1].time
            clock.sleep(1e-3)
        return states


def prepare_hardware_run(
    scenario: Scenario,
    config: HardwareConfig,
    client: RobotClient,
    pace: float = 1.0,
    meshcat: Meshcat | None = None,
) -> HardwareRun:
    """Makes a scenario ready for a robot.

    Args:
        scenario: What to run; its board's height is replaced by the measured one.
        config: The robot's file.
        client: Connected.
        pace: Controller seconds in a second; 1 for all robots.
        meshcat: Viewer to draw the replay in, or None.

    Raises:
        ConfigurationError, MeshError, TimeStepError, CuttingError: The scenario cannot start.
    """
    if config.board_height is not None:
        scenario.board.height = config.board_height
    twin = MakeStation(scenario, meshcat)
    return HardwareRun(scenario, config, client, twin, plan_joints(twin), pace)


def write_hardware_outputs(hardware: HardwareRun, directory: Path) -> dict:
    """Writes the files of `Run.save` from what the robot measured; what is there is set aside.

    And robot.csv: what came and what went out in every cycle, braking included; `robot` in the
    summary has the timing. The replay shows the measured motion; the food in it is not cut.

    Returns:
        The summary.
    """
    run, link = hardware.run, hardware.link
    assert run is not None and link is not None, "execute first"
    directory.mkdir(parents=True, exist_ok=True)
    set_aside(directory)
    link.write_log(directory / "robot.csv")  # First: what comes later needs more time and room.
    meshcat = hardware.twin.meshcat
    if meshcat is not None:
        _draw(hardware, meshcat)
    timing = {**link.timing(), "lateness_histogram": link.lateness_histogram()}
    return run.save(directory, extra={"robot": timing})


def _draw(hardware: HardwareRun, meshcat: Meshcat) -> None:
    """Publishes the measured motion to the viewer, frame by frame."""
    assert hardware.run is not None
    record, twin = hardware.run.record(), hardware.twin
    context = twin.CreateDefaultContext()
    model = twin.plant.GetMyMutableContextFromRoot(context)
    joints, time = record.vector("q", "123456"), record["time"]
    meshcat.StartRecording(frames_per_second=FRAMES_PER_SECOND)
    for at in np.arange(0.0, time[-1] + 1e-9, 1.0 / FRAMES_PER_SECOND):
        context.SetTime(at)
        twin.plant.SetPositions(model, joints[min(np.searchsorted(time, at), len(time) - 1)])
        twin.ForcedPublish(context)


@contextmanager
def steady_python() -> Iterator[None]:
    """Keeps the interpreter from making a cycle late: no garbage walks, quick thread switches."""
    interval = sys.getswitchinterval()
    gc.collect()
    gc.freeze()
    gc.disable()
    sys.setswitchinterval(1e-4)
    try:
        yield
    finally:
        sys.setswitchinterval(interval)
        gc.enable()
        gc.unfreeze()
