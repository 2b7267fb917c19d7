"""Robotic slicing simulated in Drake: robot, compliance control and finite-element cutting.

`import sliceit_drake as sliceit` gives the names that are listed here. Each is loaded when it is
first used, so that importing the package stays light.

    run = sliceit.simulate("cucumber", {"food.material.toughness": 300.0})
    run.save("output/softer")

Six of the names are modules: `motions` (of the knife), `shapes` (of foods), `parameters` (of a
prepared cut), `ports` (of a station), `preprocessing` (of records), `viewer` (Meshcat).
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sliceit_drake.calibration.calibrate import CalibrationOptions, calibrate
    from sliceit_drake.calibration.setup import CalibrationSetup, ParameterRange
    from sliceit_drake.configuration import ConfigurationError, dump_yaml
    from sliceit_drake.cutting import motion as motions
    from sliceit_drake.cutting import parameters as parameters
    from sliceit_drake.cutting.batch import simulate_batch
    from sliceit_drake.cutting.foods import shapes as shapes
    from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood, load_calibrated_food
    from sliceit_drake.cutting.foods.effects import Effects
    from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
    from sliceit_drake.cutting.foods.material import Material
    from sliceit_drake.cutting.gradient import SliceAdjoint
    from sliceit_drake.cutting.knife import Knife
    from sliceit_drake.cutting.knife_path import KnifePath
    from sliceit_drake.cutting.model import Numerics
    from sliceit_drake.cutting.motion_optimization import optimize_motion
    from sliceit_drake.cutting.named_knife import load_knife
    from sliceit_drake.diagnosis.cause import Cause, CauseParameter, Scan
    from sliceit_drake.diagnosis.diagnose import diagnose, setup_of_food
    from sliceit_drake.diagnosis.one_slice.diagnose_slice import diagnose_slice
    from sliceit_drake.diagnosis.registry import load_cause
    from sliceit_drake.diagrams import live_view as viewer
    from sliceit_drake.diagrams import ports as ports
    from sliceit_drake.diagrams.outputs.run_log import add_recorder
    from sliceit_drake.diagrams.randomize import randomize
    from sliceit_drake.diagrams.run import Run, simulate
    from sliceit_drake.diagrams.scenario import Scenario, load_scenario
    from sliceit_drake.diagrams.station import MakeStation
    from sliceit_drake.diagrams.sweep import Sweep, sweep
    from sliceit_drake.emulator.process import EmulatorProcess
    from sliceit_drake.hardware.hardware_config import load_hardware_config
    from sliceit_drake.hardware.ur_client import UrClient
    from sliceit_drake.learning.environment import SlicingEnv
    from sliceit_drake.learning.evaluation import cut_slice
    from sliceit_drake.learning.task import TaskConfig, station_scenario
    from sliceit_drake.learning.training import train
    from sliceit_drake.learning.training_config import TrainingConfig
    from sliceit_drake.records import preprocessing as preprocessing
    from sliceit_drake.records.slice_record import SliceRecord, write_record
    from sliceit_drake.records.validation import check_record, load_record, load_records
    from sliceit_drake.resources import resource_path
    from sliceit_drake.robot_run.hardware_run import prepare_hardware_run
    from sliceit_drake.stand_in.effect import Effect
    from sliceit_drake.stand_in.finite_element_world import FiniteElementSettings
    from sliceit_drake.stand_in.protocol import Condition, Protocol
    from sliceit_drake.stand_in.session import record_session
    from sliceit_drake.systems.agent import AgentConfig
    from sliceit_drake.systems.cutting_system import CuttingSystem
    from sliceit_drake.systems.exported_network import load_network
    from sliceit_drake.systems.knife_force import KnifeForceSystem
    from sliceit_drake.systems.motion_sources import MotionSource
    from sliceit_drake.systems.policy import PolicyAction, PolicyConfig, PolicySystem

__all__ = [
    "AgentConfig",
    "CalibratedFood",
    "CalibrationOptions",
    "CalibrationSetup",
    "Cause",
    "CauseParameter",
    "Condition",
    "ConfigurationError",
    "CuttingSystem",
    "Effect",
    "Effects",
    "EmulatorProcess",
    "FiniteElementSettings",
    "Food",
    "Knife",
    "KnifeForceSystem",
    "KnifePath",
    "MakeStation",
    "Material",
    "MotionSource",
    "Numerics",
    "ParameterRange",
    "PolicyAction",
    "PolicyConfig",
    "PolicySystem",
    "Protocol",
    "Run",
    "Scan",
    "Scenario",
    "SliceAdjoint",
    "SliceRecord",
    "SlicingEnv",
    "Sweep",
    "TaskConfig",
    "TrainingConfig",
    "UrClient",
    "add_recorder",
    "calibrate",
    "check_record",
    "cut_slice",
    "diagnose",
    "diagnose_slice",
    "dump_yaml",
    "load_calibrated_food",
    "load_cause",
    "load_hardware_config",
    "load_knife",
    "load_network",
    "load_record",
    "load_records",
    "load_scenario",
    "make_food_model",
    "motions",
    "optimize_motion",
    "parameters",
    "ports",
    "prepare_hardware_run",
    "preprocessing",
    "randomize",
    "record_session",
    "resource_path",
    "setup_of_food",
    "shapes",
    "simulate",
    "simulate_batch",
    "start_pose",
    "station_scenario",
    "sweep",
    "train",
    "viewer",
    "write_record",
]

_HOME = {
    "calibration.calibrate": ("CalibrationOptions", "calibrate"),
    "calibration.setup": ("CalibrationSetup", "ParameterRange"),
    "configuration": ("ConfigurationError", "dump_yaml"),
    "cutting.batch": ("simulate_batch",),
    "cutting.foods.calibrated_food": ("CalibratedFood", "load_calibrated_food"),
    "cutting.foods.effects": ("Effects",),
    "cutting.foods.food": ("Food", "make_food_model", "start_pose"),
    "cutting.foods.material": ("Material",),
    "cutting.gradient": ("SliceAdjoint",),
    "cutting.knife": ("Knife",),
    "cutting.knife_path": ("KnifePath",),
    "cutting.model": ("Numerics",),
    "cutting.motion_optimization": ("optimize_motion",),
    "cutting.named_knife": ("load_knife",),
    "diagnosis.cause": ("Cause", "CauseParameter", "Scan"),
    "diagnosis.diagnose": ("diagnose", "setup_of_food"),
    "diagnosis.one_slice.diagnose_slice": ("diagnose_slice",),
    "diagnosis.registry": ("load_cause",),
    "diagrams.outputs.run_log": ("add_recorder",),
    "diagrams.randomize": ("randomize",),
    "diagrams.run": ("Run", "simulate"),
    "diagrams.scenario": ("Scenario", "load_scenario"),
    "diagrams.station": ("MakeStation",),
    "diagrams.sweep": ("Sweep", "sweep"),
    "emulator.process": ("EmulatorProcess",),
    "hardware.hardware_config": ("load_hardware_config",),
    "hardware.ur_client": ("UrClient",),
    "learning.environment": ("SlicingEnv",),
    "learning.evaluation": ("cut_slice",),
    "learning.task": ("TaskConfig", "station_scenario"),
    "learning.training": ("train",),
    "learning.training_config": ("TrainingConfig",),
    "records.slice_record": ("SliceRecord", "write_record"),
    "records.validation": ("check_record", "load_record", "load_records"),
    "resources": ("resource_path",),
    "robot_run.hardware_run": ("prepare_hardware_run",),
    "stand_in.effect": ("Effect",),
    "stand_in.finite_element_world": ("FiniteElementSettings",),
    "stand_in.protocol": ("Condition", "Protocol"),
    "stand_in.session": ("record_session",),
    "systems.agent": ("AgentConfig",),
    "systems.cutting_system": ("CuttingSystem",),
    "systems.exported_network": ("load_network",),
    "systems.knife_force": ("KnifeForceSystem",),
    "systems.motion_sources": ("MotionSource",),
    "systems.policy": ("PolicyAction", "PolicyConfig", "PolicySystem"),
}
"""The names of each module."""
_MODULES = {
    "motions": "cutting.motion",
    "parameters": "cutting.parameters",
    "ports": "diagrams.ports",
    "preprocessing": "records.preprocessing",
    "shapes": "cutting.foods.shapes",
    "viewer": "diagrams.live_view",
}
"""Modules under the names that they have here."""


def __getattr__(name: str) -> Any:
    """Loads a name when it is first used."""
    module = _MODULES.get(name) or next((m for m, names in _HOME.items() if name in names), None)
    if module is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found: Any = importlib.import_module(f"{__name__}.{module}")
    globals()[name] = found = found if name in _MODULES else getattr(found, name)
    return found


def __dir__() -> list[str]:
    return [*__all__, "__all__", "__doc__", "__file__", "__name__", "__path__"]
