"""A run of a scenario, and what a user wants of it: record, summary, figure, replay."""

import dataclasses as dc
import gc
import importlib.metadata
import json
import platform
import time as clock
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator, SimulatorStatus

from sliceit_drake.configuration import ConfigurationError, dump_yaml, validate
from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.cutting.mesh.tetrahedra import MeshError
from sliceit_drake.cutting.motion import Motion, MotionPlan
from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.diagrams.live_view import LiveControls, make_meshcat
from sliceit_drake.diagrams.outputs.animation import (
    NEEDED,
    Film,
    Frame,
    add_force,
    can_draw,
    write_gif,
)
from sliceit_drake.diagrams.outputs.figures import CONTACT_THRESHOLD, plot_force
from sliceit_drake.diagrams.outputs.measurement_comparison import (
    Comparison,
    can_compare,
    compare_with_measurement,
)
from sliceit_drake.diagrams.outputs.run_log import Record
from sliceit_drake.diagrams.outputs.sequence_report import plot_sequence, slice_reports
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
from sliceit_drake.systems.contact_monitor import UNSTABLE_GAINS
from sliceit_drake.systems.policy import PolicyConfig, PressByForce

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Run", "measured_profile", "prepare_run", "simulate"]

CHUNK = 0.02
CUT_THROUGH = 0.99
"""Share of a section from which it counts as cut."""
BOARD_REACHED = 5e-4
"""Height of the edge over the board below which a longer way down would not help, m."""


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
        """
        end = self.motion.duration if duration is None else duration
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
        return _figure(self, record, _comparison(self, record), self._picture())

    def summary(self) -> dict:
        """Forces, work, times, margins and versions, as summary.json has them.

        It simulates the cut again on other meshes, for the discretisation error.
        """
        record = self.record()
        summary = _summary(self, record, _comparison(self, record))
        _add_discretization_error(self, summary)
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
        summary = _summary(self, record, comparison) | (extra or {})
        picture = None
        try:
            if replay and self.meshcat is not None:
                if self.station.food_visualizer is not None:
                    self.station.food_visualizer.PublishRecording()
                self.meshcat.StopRecording()
                self.meshcat.PublishRecording()
                text = self.meshcat.StaticHtml()
                (folder / "replay.html").write_text(text, encoding="utf-8")
            _add_discretization_error(self, summary)
            picture = self._picture()
            if self.animation and self.film is not None and can_draw():
                pictures = self.film.draw(self.film.frames, drawing)
                add_force(pictures, self.film.times, record)
                write_gif(folder / "slice.gif", pictures, self.film.period)
                summary["animation"] = "slice.gif"
            elif self.animation:
                summary["animation"] = f"none: {NEEDED}"
        finally:
            text = json.dumps(summary, indent=2) + "\n"
            (folder / "summary.json").write_text(text, encoding="utf-8")
            _figure(self, record, comparison, picture).savefig(folder / "force.png", dpi=150)
        return summary

    def _picture(self) -> np.ndarray | None:
        """The end of a sequence, or else the middle of the cut, where this machine can draw."""
        if self.film is None or not can_draw():
            return None
        frame = None if self.scenario.sequence is not None else self.half_cut
        return self.film.draw([frame or self.film.frame(self.simulator.get_context())])[0]


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
    if areas := _slice_areas(run):
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
    name = scenario.food.name if isinstance(scenario.food, Food) else scenario.name
    if scenario.sequence is not None:
        count, thickness = scenario.sequence.count, 1e3 * scenario.sequence.thickness
        return f"A UR5e cuts {count} slices of {thickness:.3g} mm of {name}{at}"
    return f"A UR5e slices {run.own.get('cutting', name.replace('_', ' '))}{at}"


def _caption(run: Run, comparison: Comparison | None) -> str:
    lines = []
    if described := run.station.cutting.describe():
        named = run.scenario.calibration
        source = "Parameters set by hand" if named is None else f"Calibrated food {named}"
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


def _phase_times(mask: np.ndarray, time: np.ndarray) -> list[float] | None:
    touching = np.flatnonzero(mask)
    return [float(time[touching[0]]), float(time[touching[-1]])] if len(touching) else None


def _summary(run: Run, record: Record, comparison: Comparison | None) -> dict:
    scenario, station = run.scenario, run.station
    time = record["time"]
    food, board = record.vector("food_wrench_f"), record.vector("board_wrench_f")
    norm = np.linalg.norm(food + board, axis=1)
    on_food = np.linalg.norm(food, axis=1) > CONTACT_THRESHOLD
    on_board = np.linalg.norm(board, axis=1) > CONTACT_THRESHOLD
    contact = norm[on_food | on_board]
    summary: dict = {
        "scenario": scenario.name,
        "stopped": run.stopped,
        "contact_margin": run.contact_margin and dc.asdict(run.contact_margin),
        "simulated_time_s": float(time[-1]),
        "wall_time_s": run.wall_time,
        "real_time_factor": float(time[-1] / run.wall_time) if run.wall_time else None,
        "peak_force_N": float(norm.max()),
        "mean_contact_force_N": float(contact.mean()) if len(contact) else 0.0,
        "board_peak_N": float(np.linalg.norm(board, axis=1).max()),
        "board_peak_loss_of_an_impact": station.board_peak_loss,
        "cut_progress": float(record["cut_progress"][-1]),
        "phase_times_s": {
            "food": _phase_times(on_food, time),
            "board": _phase_times(on_board, time),
            "motion": _motion_times(run.motion),
        },
        "settings": {
            "exchange_period_s": scenario.exchange_period,
            "plant_time_step_s": scenario.robot.plant_time_step,
            "seed": scenario.seed,
        },
        "versions": {
            name: importlib.metadata.version(name)
            for name in ("sliceit_drake", "drake", "warp-lang", "numpy")
        }
        | {"python": platform.python_version()},
    }
    if run.own:
        summary["own"] = run.own
    summary |= station.cutting.summary(record)
    if areas := _slice_areas(run):
        summary["slices"] = [dc.asdict(report) for report in slice_reports(record, areas)]
    warnings = [*summary.get("warnings", ()), *run.warnings]
    warnings += [each for each in (_not_cut_through(run, record), _clamped(run)) if each]
    if warnings:
        summary["warnings"] = warnings
    if station.estimate_error is not None:
        summary["discretization_error"] = None
    measurement = scenario.measurement
    if comparison is not None and measurement is not None:
        used = np.isfinite(comparison.simulated)
        summary["measurement"] = {
            "file": measurement.file,
            "rms_N": comparison.rms,
            "measured_peak_N": comparison.measured_peak,
            "simulated_peak_N": comparison.simulated_peak,
            "fitted_contact_time_s": comparison.contact_time,
            "height_offset_mm": 1e3 * comparison.contact_time * measurement.speed,
            "compared_to_depth_mm": 1e3 * float(comparison.depth[used].max()),
        }
    return summary


def _motion_times(motion: Motion) -> dict[str, list]:
    """Begin and end of each phase, s; of a phase that occurs again, a list of them."""
    times: dict[str, list] = {}
    for label, begin, end in motion.phases:
        times.setdefault(label, []).append([begin, end])
    return {label: spans[0] if len(spans) == 1 else spans for label, spans in times.items()}


def _slice_areas(run: Run) -> list[float]:
    """Sections of a sequence's slices, m^2; empty without a sequence."""
    return run.station.cutting.section_areas() if run.scenario.sequence is not None else []


def _add_discretization_error(run: Run, summary: dict) -> None:
    """What the estimate says; None stays where the run ended early or a policy led."""
    estimate = run.station.estimate_error
    # A policy would decide otherwise on another mesh.
    if estimate is None or run.stopped is not None or run.diagram.policy is not None:
        return
    try:
        summary["discretization_error"] = dc.asdict(estimate())
    except (CuttingError, MeshError) as problem:
        summary["discretization_error"] = {"relative_rms": None, "problem": str(problem)}


def _clamped(run: Run) -> str | None:
    """Says that a blade shook in a food which clamps it, and what to change; else None."""
    food = run.scenario.food
    if not (run.stopped or "").startswith(UNSTABLE_GAINS) or not isinstance(food, Food):
        return None
    if food.held_sides != "both":
        return None
    return (
        "the food is held on both sides of the cut and clamps the blade: with "
        "food.held_sides=plus one half can give way"
    )


def _not_cut_through(run: Run, record: Record) -> str | None:
    """Says that a motion's end left the food uncut, and what to change; None where it did not."""
    scenario, station = run.scenario, run.station
    # Without an estimate the food has no finite elements, or a robot cuts a real one.
    if run.stopped or station.estimate_error is None:
        return None
    if record["time"][-1] < run.motion.duration - CHUNK:
        return None
    if scenario.sequence is not None:
        shares = [report.cut_share for report in slice_reports(record, _slice_areas(run))]
    else:
        shares = [float(record["cut_progress"].max())]
    uncut = [k for k, share in enumerate(shares) if share < CUT_THROUGH]
    if not uncut:
        return None
    which = f"slice {uncut[0] + 1} is" if len(shares) > 1 else "the food is"
    edge = record["knife_pose_p_z"].min() - scenario.board.height
    if scenario.policy is not None or run.diagram.policy is not None:
        fix = "give the policy more time (policy.duration) or depth (policy.press)"
    elif edge > BOARD_REACHED:
        fix = (
            f"lengthen the way down by {1e3 * edge:.1f} mm (motion.segments.0.distance), or leave "
            "motion out, which cuts through"
        )
    else:
        fix = "draw the knife along its edge as it presses (!PressAndDraw), or refine food.shape"
    return (
        f"{which} not cut through: {100 * shares[uncut[0]]:.0f} % of the section is cut, and the "
        f"edge came to {1e3 * max(edge, 0.0):.1f} mm above the board. To cut through, {fix}."
    )
