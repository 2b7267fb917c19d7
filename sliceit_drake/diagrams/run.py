"""A run of a scenario, and what a user wants of it: record, summary, figure, replay."""

import dataclasses as dc
import gc
import json
import math
import time as clock
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator, SimulatorStatus

from sliceit_drake.configuration import ConfigurationError, dump_yaml, validate
from sliceit_drake.cutting.foods.calibrated_food import load_calibrated_food
from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.cutting.kernels.precision import kernels
from sliceit_drake.cutting.motion import Motion, MotionPlan
from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.cutting.warp_start import start_loading, start_warp
from sliceit_drake.diagrams.live_view import LiveControls, make_meshcat
from sliceit_drake.diagrams.outputs.animation import (
    NEEDED,
    Film,
    Frame,
    add_force,
    can_draw,
    write_gif,
)
from sliceit_drake.diagrams.outputs.figures import plot_force
from sliceit_drake.diagrams.outputs.measurement_comparison import (
    Comparison,
    can_compare,
    compare_with_measurement,
)
from sliceit_drake.diagrams.outputs.run_log import Record
from sliceit_drake.diagrams.outputs.run_summary import (
    add_discretization_error,
    run_summary,
    slice_areas,
)
from sliceit_drake.diagrams.outputs.sequence_report import plot_sequence
from sliceit_drake.diagrams.prepared_food import OwnCutting
from sliceit_drake.diagrams.scenario import Scenario, load_scenario
from sliceit_drake.diagrams.scenario_diagram import OwnPolicy, ScenarioDiagram
from sliceit_drake.diagrams.stability import ContactMargin, check_contact_margin
from sliceit_drake.diagrams.station import MakeStation
from sliceit_drake.diagrams.station_interface import OwnController, Station
from sliceit_drake.output_folder import remove_results
from sliceit_drake.overrides import Overrides
from sliceit_drake.records.force_profile import ForceProfile, load_force_profile
from sliceit_drake.resources import file_or_resource
from sliceit_drake.systems.agent import AgentConfig
from sliceit_drake.systems.compliance_kernel import update_arm
from sliceit_drake.systems.policy import PolicyConfig, PressByForce

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Run", "measured_profile", "prepare_run", "simulate"]

CHUNK = 0.02


@dc.dataclass
class Run:
    """A simulated slice, from its start to what came of it; plots and saves itself.

    Attributes:
        scenario: What is simulated.
        diagram: Station, motion and record.
        simulator: Initialized.
        profile: The measured force to compare with, or None.
        contact_margin: How far the contact is from instability; None with a controller of the
            user's own, of which that is not known.
        meshcat: The viewer that records the replay, or None.
        own: Class of each system of the user's own, by what it is put in for.
        wall_time: Seconds spent in the simulator.
        stopped: Why the run ended early, or None.
        film: Draws knife and food, and holds the frames of an animation; None on a robot.
        animation: Whether frames of it are kept.
        half_cut: When half of the section was cut, or None.
        controls: Speed and stop in a live viewer, or None.
        warnings: What the summary shall warn of, beside what the food does.
    """

    scenario: Scenario
    diagram: ScenarioDiagram
    simulator: Simulator
    profile: ForceProfile | None
    contact_margin: ContactMargin | None
    meshcat: Meshcat | None = None
    film: Film | None = None
    animation: bool = False
    own: dict[str, str] = dc.field(default_factory=dict)
    wall_time: float = 0.0
    stopped: str | None = None
    half_cut: Frame | None = None
    controls: LiveControls | None = None
    warnings: list[str] = dc.field(default_factory=list)

    def advance(
        self,
        duration: float | None = None,
        progress: Callable[[float, float], None] | None = None,
    ) -> None:
        """Simulates to the end; an error or Ctrl-C ends it early and is noted in `stopped`.

        Args:
            duration: Simulated time at the end, s; None for the motion's.
            progress: Called with simulated time and wall time, s, after each part.

        Raises:
            ConfigurationError: The duration is no time.
        """
        end = self.motion.duration if duration is None else duration
        if not 0.0 < end < math.inf:
            raise ConfigurationError(f"is {end}", field="duration", fix="Give a time above 0 s.")
        # The run makes no cycles worth collecting, but walking through all imported modules costs.
        gc.collect()
        gc.freeze()
        begin = clock.perf_counter()
        context, station = self.simulator.get_context(), self.station
        own = station.GetMyContextFromRoot(context)
        cut_progress = station.GetOutputPort("cut_progress")
        try:
            while (now := context.get_time()) < end - 1e-9:
                if self.controls is not None and not self.controls.apply(self.simulator):
                    self.stopped = "stopped in the viewer"
                    break
                status = self.simulator.AdvanceTo(min(now + CHUNK, end))
                if self.film is not None:
                    if self.half_cut is None and cut_progress.Eval(own)[0] > 0.5:
                        self.half_cut = self.film.frame(context)
                    if self.animation:
                        self.film.look(context)
                self.wall_time = clock.perf_counter() - begin
                if progress is not None:
                    progress(context.get_time(), self.wall_time)
                if status.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition:
                    self.stopped = status.message()
                    break
        except CuttingError as error:
            self.stopped = str(error)
        except KeyboardInterrupt:
            self.stopped = "interrupted by the user"
        finally:
            gc.unfreeze()

    def record(self) -> Record:
        """The table of the run so far: joints, poses, wrenches, energies at every coupling step."""
        return self.diagram.record(self.simulator.get_context())

    @property
    def station(self) -> Station:
        """The station in the diagram."""
        return self.diagram.station

    @property
    def motion(self) -> Motion:
        """The prescribed targets of the knife."""
        return self.diagram.motion

    def plot(self) -> "Figure":
        """Knife and food, and the force over time and depth; of a sequence slice by slice."""
        record = self.record()
        return _figure(self, record, _comparison(self, record), next(self._pictures(), None))

    def summary(self) -> dict:
        """Forces, work, times, margins and versions, as summary.json has them.

        It simulates the cut again on other meshes, for the discretisation error.
        """
        record = self.record()
        summary = run_summary(self, record, _comparison(self, record))
        add_discretization_error(self, summary)
        return summary

    def save(
        self,
        folder: str | Path,
        *,
        replay: bool = True,
        extra: dict | None = None,
        drawing: Callable[[int, int], None] | None = None,
    ) -> dict:
        """Writes record.csv, replay.html, force.png, summary.json and scenario.yaml.

        And slice.gif where there is a film; the summary's `animation` names it, or says what this
        machine lacks for it. What an earlier run left in the folder is removed. Ctrl-C leaves all
        but what takes long: the discretisation error and slice.gif.

        Args:
            folder: Made if absent.
            replay: False leaves replay.html out, as a run without a viewer does.
            extra: What else the summary shall say.
            drawing: Called with the number of pictures of the animation, drawn and all.

        Returns:
            The summary.
        """
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        remove_results(folder)
        record = self.record()
        record.write_csv(folder / "record.csv")
        dump_yaml(_written(self.scenario), folder / "scenario.yaml")
        comparison = _comparison(self, record)
        summary = run_summary(self, record, comparison) | (extra or {})
        picture = None
        try:
            if replay and self.meshcat is not None:
                if self.station.food_visualizer is not None:
                    self.station.food_visualizer.PublishRecording()
                self.meshcat.StopRecording()
                self.meshcat.PublishRecording()
                text = self.meshcat.StaticHtml()
                (folder / "replay.html").write_text(text, encoding="utf-8")
            add_discretization_error(self, summary)
            film = self.film
            frames = film.frames if film is not None and self.animation else []
            drawn = self._pictures(frames)
            picture = next(drawn, None)
            if film is not None and self.animation and picture is not None:
                pictures = []
                for each in drawn:
                    pictures.append(each)
                    if drawing is not None:
                        drawing(len(pictures), len(frames))
                add_force(pictures, film.times, record)
                write_gif(folder / "slice.gif", pictures, film.period)
                summary["animation"] = "slice.gif"
            elif self.animation:
                summary["animation"] = f"none: {NEEDED}"
        finally:
            text = json.dumps(summary, indent=2) + "\n"
            (folder / "summary.json").write_text(text, encoding="utf-8")
            _figure(self, record, comparison, picture).savefig(folder / "force.png", dpi=150)
        return summary

    def _pictures(self, frames: Sequence[Frame] = ()) -> Iterator[np.ndarray]:
        """Draws the end of a sequence, or else the middle of the cut, and then these frames.

        Gives nothing where there is no film, or where this machine cannot draw.
        """
        if self.film is not None and can_draw():
            first = None if self.scenario.sequence is not None else self.half_cut
            first = first or self.film.frame(self.simulator.get_context())
            yield from self.film.draw([first, *frames])


def simulate(
    scenario: str | Path | Scenario,
    overrides: Overrides = None,
    *,
    policy: PolicyConfig | AgentConfig | OwnPolicy | None = None,
    cutting: OwnCutting | None = None,
    controller: OwnController | None = None,
    duration: float | None = None,
    meshcat: Meshcat | None = None,
    replay: bool = True,
    animation: bool = False,
    progress: Callable[[float, float], None] | None = None,
) -> Run:
    """A scenario simulated in the station, with systems of your own where you give them.

    Args:
        scenario: Name of one that ships, such as "cucumber"; a YAML file; or a `Scenario`.
        overrides: Fields that replace those of the scenario, see `load_scenario`.
        policy: What moves the knife in place of the scenario's motion or policy, see `prepare_run`.
        cutting: What gives the food's force in place of the scenario's food, see `MakeStation`.
        controller: What commands the joints in place of the compliance controller, likewise.
        duration: Simulated time, s; None for the motion's.
        meshcat: Viewer to draw in; None for one that only records the replay.
        replay: False draws nothing where no viewer is given; `Run.save` then leaves the replay out.
        animation: Keeps frames, which `Run.save` draws as slice.gif.
        progress: Called with simulated time and wall time, s, after each part.

    Returns:
        The run, at its end or where it stopped: see `Run.stopped`.

    Raises:
        ConfigurationError, MeshError, TimeStepError, CuttingError: The scenario cannot start.
    """
    if meshcat is None and replay:
        meshcat = make_meshcat()
    run = prepare_run(
        load_scenario(scenario, overrides),
        meshcat,
        policy=policy,
        cutting=cutting,
        controller=controller,
        animation=animation,
    )
    run.advance(duration, progress)
    return run


def prepare_run(
    scenario: Scenario,
    meshcat: Meshcat | None = None,
    *,
    policy: PolicyConfig | AgentConfig | OwnPolicy | None = None,
    cutting: OwnCutting | None = None,
    controller: OwnController | None = None,
    animation: bool = False,
) -> Run:
    """A run at its start.

    Args:
        scenario: What to simulate.
        meshcat: Viewer to draw and to record in, or None.
        policy: A configuration, which takes the place of the scenario's motion; or a policy of your
            own, see `ScenarioDiagram`.
        cutting, controller: See `MakeStation`.
        animation: See `simulate`.

    Raises:
        ConfigurationError, MeshError, TimeStepError, CuttingError: The scenario cannot start.
    """
    own = {}
    if isinstance(policy, PolicyConfig | AgentConfig):
        if isinstance(policy, PolicyConfig) and type(policy.decide) is not PressByForce:
            own["policy"] = type(policy.decide).__name__
        scenario = dc.replace(scenario, policy=policy, motion=MotionPlan(), sequence=None)
        validate(scenario, "scenario")
        policy = None
    profile = measured_profile(scenario)
    if cutting is None and isinstance(scenario.food, Food) and scenario.numerics.device == "cpu":
        _start_kernels(wp.float32 if scenario.numerics.precision == "float32" else wp.float64)
    station = MakeStation(scenario, meshcat, cutting=cutting, controller=controller)
    diagram = ScenarioDiagram(scenario, station=station, policy=policy)
    margin = check_contact_margin(station) if controller is None else None
    simulator = Simulator(diagram)
    diagram.SetStart(simulator.get_mutable_context())
    if meshcat is not None:
        meshcat.StartRecording(set_visualizations_while_recording=True)
        if station.food_visualizer is not None:
            station.food_visualizer.StartRecording()
    simulator.Initialize()
    if policy is not None:
        own["policy"] = type(diagram.policy if callable(policy) else policy).__name__
    if cutting is not None:
        own["cutting"] = type(station.cutting).__name__
    if controller is not None:
        own["controller"] = type(station.controller).__name__
    film = Film(station, diagram.motion.duration)
    if animation:
        film.look(simulator.get_context())
    return Run(scenario, diagram, simulator, profile, margin, meshcat, film, animation, own)


def _start_kernels(real: Any) -> None:
    """Compiles the kernels for the CPU while the station is made; what needs one waits for it."""
    start_warp()
    points, others = kernels(real).modules
    # The controller's is needed first, and the points take longest.
    names = [update_arm.module.name, points, others]
    start_loading(names, "cpu")


def _written(scenario: Scenario) -> Scenario:
    """A scenario as a file can say it: in place of a user's own policy stands ours."""
    policy = scenario.policy
    if isinstance(policy, PolicyConfig) and type(policy.decide) is not PressByForce:
        return dc.replace(scenario, policy=dc.replace(policy, decide=PressByForce()))
    return scenario


def _figure(
    run: Run,
    record: Record,
    comparison: Comparison | None,
    picture: np.ndarray | None,
) -> "Figure":
    title, caption = _title(run), _caption(run, comparison)
    if areas := slice_areas(run):
        board = run.scenario.board.height
        return plot_sequence(record, areas, title, board, caption, picture)
    return plot_force(record, title, run.station.food_top(), comparison, caption, picture)


def measured_profile(scenario: Scenario) -> ForceProfile | None:
    """The measured force that a scenario names, or None.

    Raises:
        ConfigurationError: There is no such file, or it cannot be read.
    """
    if scenario.measurement is None:
        return None
    file = file_or_resource(scenario.measurement.file)
    if file is None:
        raise ConfigurationError(
            f'there is no file "{scenario.measurement.file}", neither here nor in the package',
            field="scenario.measurement.file",
            fix="Give a force profile such as those in calibration/measured.",
        )
    return load_force_profile(file)


def _comparison(run: Run, record: Record) -> Comparison | None:
    """The measured force beside the simulated one until the deepest point."""
    measurement = run.scenario.measurement
    if measurement is None or run.profile is None:
        return None
    depth = run.station.food_top() - record["knife_pose_p_z"]
    force = record.vector("food_wrench_f") + record.vector("board_wrench_f")
    norm = np.linalg.norm(force, axis=1)
    deepest = int(np.argmax(depth)) + 1
    depth, norm = depth[:deepest], norm[:deepest]
    rising = np.concatenate([[True], depth[1:] > np.maximum.accumulate(depth)[:-1]])
    if not can_compare(depth[rising]):
        return None
    return compare_with_measurement(run.profile, measurement, depth[rising], norm[rising])


def _title(run: Run) -> str:
    scenario, segments = run.scenario, run.station.motion_plan.segments
    speeds = [getattr(s, "speed", None) for s in segments]
    speed = next((s for s in speeds if s), None)
    at = f" at {1e3 * speed:.3g} mm/s" if speed and run.diagram.policy is None else ""
    if scenario.calibration and not load_calibrated_food(scenario.calibration).is_measured:
        at += ", not calibrated"
    name = scenario.food.name if isinstance(scenario.food, Food) else scenario.name
    if scenario.sequence is not None:
        count, thickness = scenario.sequence.count, 1e3 * scenario.sequence.thickness
        return f"A UR5e cuts {count} slices of {thickness:.3g} mm of {name}{at}"
    return f"A UR5e slices {run.own.get('cutting', name.replace('_', ' '))}{at}"


def _caption(run: Run, comparison: Comparison | None) -> str:
    lines = []
    if described := run.station.cutting.describe():
        named = run.scenario.calibration
        source = "Parameters set by hand" if named is None else f"Parameters of the food {named}"
        lines.append(f"{source}: {described}")
    if run.own:
        put_in = ", ".join(f"{kind} {name}" for kind, name in run.own.items())
        lines.append(f"Put in by the user: {put_in}.")
    if comparison is not None:
        lines.append(
            "Measured curve digitised from the SliceIt! paper's project page; first contact fitted "
            f"at {comparison.contact_time:.3f} s of its record; RMS difference "
            f"{comparison.rms:.2f} N."
        )
    if run.stopped:
        lines.append(f"Stopped early: {run.stopped}")
    return "\n".join(lines)
