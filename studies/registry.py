"""All studies by topic: name, one line, how long it takes, and the module that runs it.

A study's module has `add_arguments(parser)` and `run(options)`, which returns the exit status; its
docstring is the text of `--help`. Beside its arguments a study finds the command line that was
typed in `options.command`. This list imports none of the modules.
"""

import argparse
import dataclasses as dc
import importlib

from sliceit_drake.cli.extras import needs_extra

__all__ = ["TOPICS", "Study", "find_study", "study_parser"]


@dc.dataclass(frozen=True)
class Study:
    """A study, not imported yet.

    Attributes:
        name: As it is typed.
        module: Within `studies`.
        line: What it measures, for the list.
        duration: Rough wall time on two cores, for the list.
        extra: Extra of pyproject.toml that it needs.
    """

    name: str
    module: str
    line: str
    duration: str
    extra: str = "studies"


TOPICS: dict[str, tuple[Study, ...]] = {
    "cutting physics": (
        Study(
            "verification",
            "physics.verification_page",
            "the physics against exact solutions and measured cuts",
            "5 min",
        ),
        Study("disect", "disect.page", "side by side with DiSECt", "5 min"),
        Study(
            "random",
            "physics.random_slices",
            "random foods, planes, knives and motions",
            "15 min",
        ),
        Study(
            "stepping",
            "physics.stepping_report",
            "error of the force against sub-step and cost",
            "10 min",
        ),
        Study(
            "contact",
            "physics.contact_convergence",
            "force against the stiffness of the flanks' contact and the mesh",
            "2 min",
        ),
        Study(
            "soft_foods",
            "physics.soft_foods",
            "foods that are soft for their mesh, and what helps",
            "4 min",
        ),
        Study(
            "split_step_limit",
            "physics.split_step_limit",
            "stable step of cuts by random planes",
            "2 min",
        ),
        Study("effects_figure", "physics.effects_figure", "what each effect adds", "1 min"),
        Study("foods_page", "physics.foods_page", "tables of foods and knives", "1 s"),
        Study("cutting_speed", "physics.cutting_speed", "cost of a cut without a robot", "5 min"),
        Study("batch_speed", "physics.batch_speed", "cuts a second, on CPU and GPU", "2 min"),
    ),
    "robot and station": (
        Study(
            "coupling",
            "robot.coupling",
            "error against coupling period and plant step",
            "2 min",
        ),
        Study("servo", "robot.servo", "how the arm follows, by servoj's parameters", "20 s"),
        Study(
            "control",
            "robot.control",
            "stability of compliance control against contact stiffness",
            "5 min",
        ),
        Study("station_speed", "robot.station_speed", "real-time factor of the station", "30 s"),
        Study(
            "safety_layer", "robot.safety_layer", "time of a decision of the safety layer", "5 s"
        ),
        Study(
            "faults",
            "robot.faults",
            "what stops the emulated robot when something fails",
            "40 min",
            "hardware",
        ),
        Study(
            "hardware_pace",
            "robot.hardware_pace",
            "how a run keeps up with the controller's clock",
            "5 min",
        ),
        Study(
            "emulator_figure",
            "robot.emulator_figure",
            "a slice on the emulator beside the simulated one",
            "1 min",
            "hardware",
        ),
        Study("soak", "project.soak", "an hour of everything side by side, killed", "1 h", "learn"),
        Study("endurance", "robot.endurance", "memory over an hour of slices", "1 h"),
    ),
    "calibration": (
        Study(
            "calibration",
            "calibration.comparison",
            "the paper's measured curves, calibrated and compared",
            "1 h",
        ),
        Study(
            "half_depth",
            "calibration.half_depth",
            "measured curves: is the lower half in the band of a fit to the upper",
            "5 min",
        ),
        Study(
            "bands",
            "calibration.bands_by_law",
            "how often bands of predicted force hold, on benches of other laws",
            "1 h",
        ),
        Study(
            "calibration_times",
            "calibration.times",
            "how long the foods that ship take to calibrate",
            "15 min",
        ),
        Study(
            "adversarial",
            "calibration.adversarial",
            "curves with something wrong, and what the commands say of them",
            "3 min",
        ),
        Study(
            "coverage",
            "calibration.coverage",
            "how often intervals of calibrations hold the truth",
            "5 min",
        ),
    ),
    "diagnosis": (
        Study(
            "identifiability",
            "diagnosis.identifiability",
            "which causes a protocol can tell apart",
            "5 min",
        ),
        Study(
            "real",
            "diagnosis.real_slices",
            "what the simulation gets wrong in the paper's slices",
            "10 min",
        ),
        Study(
            "hidden",
            "hidden_effects.hide",
            "hides effects in records and has them diagnosed",
            "hours",
        ),
        Study("score", "hidden_effects.report", "judges the diagnoses of `hidden`", "5 s"),
        Study(
            "sizes",
            "hidden_effects.sizes",
            "sizes of effects by their strength against the noise",
            "1 h",
        ),
        Study(
            "benches",
            "benches.runs",
            "hides effects on benches of other laws and has them diagnosed",
            "hours",
        ),
        Study("bench_score", "benches.score", "judges the diagnoses of `benches`", "5 s"),
        Study("bench_figures", "benches.figure", "draws a record of each law", "30 s"),
        Study(
            "bench_misfit",
            "benches.calibrated",
            "how wrong the simulation is by itself on benches of other laws",
            "1 min a draw",
        ),
        Study("diagnosis_speed", "diagnosis.diagnosis_speed", "time of a diagnosis", "3 min"),
        Study(
            "stand_in_figure",
            "diagnosis.stand_in_figure",
            "what each effect of the stand-in changes",
            "1 min",
        ),
    ),
    "learning": (
        Study(
            "slicing", "learning.comparison", "policies of both simulators in unseen worlds", "5 s"
        ),
        Study(
            "foreign_law",
            "learning.foreign_law",
            "policies in a law of the benches",
            "10 min",
        ),
        Study(
            "fronts",
            "learning.fronts",
            "force against time of policies, rules and chance",
            "30 min",
        ),
        Study("tune_rule", "learning.tune_rule", "tunes the rule of `fronts`", "10 min"),
        Study("faster_draws", "learning.faster_draws", "what faster draws bring", "5 s"),
        Study(
            "unfinished_slices",
            "learning.unfinished_slices",
            "why slices stay unfinished",
            "5 min",
            "learn",
        ),
        Study(
            "policy_and_motion",
            "learning.policy_and_motion",
            "a trained policy beside an optimised motion",
            "20 min",
            "learn",
        ),
        Study(
            "slicing_ablations",
            "learning.slicing_ablations",
            "which parts of the agent matter",
            "hours",
            "learn",
        ),
        Study(
            "learning_speed",
            "learning.learning_speed",
            "cost of a training and of a decision",
            "15 min",
            "learn",
        ),
    ),
    "many machines": (Study("scaling", "scaling.scaling", "what more workers bring", "10 min"),),
    "the project": (
        Study("architecture", "project.architecture", "draws the folders and their imports", "5 s"),
        Study("guide_figures", "project.guide_figures", "draws pictures of the guides", "30 s"),
        Study("guide_diagrams", "project.guide_diagrams", "draws words, files and states", "1 min"),
        Study(
            "result_figures", "project.result_figures", "draws pictures of stored results", "5 s"
        ),
        Study("pages", "project.stored_pages", "renders all pages from stored results", "10 s"),
        Study("aims", "project.aims", "writes results/benchmarks.md from stored results", "1 s"),
        Study("stale", "project.stale", "results that are older than today's numbers", "2 s"),
        Study("first_run", "project.first_run", "a newcomer's first run with the wheel", "2 min"),
        Study(
            "notebooks",
            "project.notebooks",
            "runs the notebooks and stores their outputs",
            "3 min",
            "notebooks",
        ),
    ),
}


def find_study(name: str) -> Study | None:
    """The study of a name; None where there is none."""
    for studies in TOPICS.values():
        for study in studies:
            if study.name == name:
                return study
    return None


def study_parser(study: Study) -> argparse.ArgumentParser:
    """The parser of a study's arguments; imports its module.

    Raises:
        ConfigurationError: A package that it needs is not installed.
    """
    with needs_extra("studies"):
        importlib.import_module("studies.pages")
    with needs_extra(study.extra):
        module = importlib.import_module(f"studies.{study.module}")
    parser = argparse.ArgumentParser(
        prog=f"python -m studies {study.name}",
        description=module.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    module.add_arguments(parser)
    parser.set_defaults(run=module.run)
    return parser
