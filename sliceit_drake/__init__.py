"""Robotic slicing simulated in Drake: robot, compliance control and finite-element cutting.

`import sliceit_drake as sliceit` gives the names below. Each is loaded when it is first used, so
that importing the package stays light.

    run = sliceit.simulate("cucumber", {"food.material.toughness": 300.0})
    run.save("output/softer")

Ten of them are modules with further names: `motions` (of the knife), `shapes` (of foods), and
packages, from `calibration` to `stand_in`.
"""

from typing import TYPE_CHECKING

from sliceit_drake.lazy_names import lazy_names

if TYPE_CHECKING:
    import sliceit_drake.cutting.foods.shapes
    import sliceit_drake.cutting.motion
    from sliceit_drake import calibration as calibration
    from sliceit_drake import cutting as cutting
    from sliceit_drake import diagnosis as diagnosis
    from sliceit_drake import diagrams as diagrams
    from sliceit_drake import hardware as hardware
    from sliceit_drake import learning as learning
    from sliceit_drake import records as records
    from sliceit_drake import stand_in as stand_in
    from sliceit_drake.calibration.calibrate import calibrate as calibrate
    from sliceit_drake.configuration import ConfigurationError as ConfigurationError
    from sliceit_drake.configuration import dump_yaml as dump_yaml
    from sliceit_drake.cutting.foods.calibrated_food import (
        load_calibrated_food as load_calibrated_food,
    )
    from sliceit_drake.cutting.foods.food import Food as Food
    from sliceit_drake.cutting.foods.material import Material as Material
    from sliceit_drake.cutting.knife import Knife as Knife
    from sliceit_drake.diagnosis.cause import Cause as Cause
    from sliceit_drake.diagnosis.diagnose import diagnose as diagnose
    from sliceit_drake.diagrams.controller_system import ControllerSystem as ControllerSystem
    from sliceit_drake.diagrams.run import Run as Run
    from sliceit_drake.diagrams.run import simulate as simulate
    from sliceit_drake.diagrams.scenario import Scenario as Scenario
    from sliceit_drake.diagrams.scenario import load_scenario as load_scenario
    from sliceit_drake.diagrams.station import MakeStation as MakeStation
    from sliceit_drake.diagrams.sweep import sweep as sweep
    from sliceit_drake.emulator.process import EmulatorProcess as EmulatorProcess
    from sliceit_drake.learning.environment import SlicingEnv as SlicingEnv
    from sliceit_drake.learning.training import train as train
    from sliceit_drake.records.slice_record import SliceRecord as SliceRecord
    from sliceit_drake.records.validation import load_records as load_records
    from sliceit_drake.resources import resource_path as resource_path
    from sliceit_drake.robot_run.hardware_run import prepare_hardware_run as prepare_hardware_run
    from sliceit_drake.systems.agent import AgentConfig as AgentConfig
    from sliceit_drake.systems.cutting_system import CuttingSystem as CuttingSystem
    from sliceit_drake.systems.knife_force import KnifeForceSystem as KnifeForceSystem
    from sliceit_drake.systems.motion_sources import MotionSource as MotionSource
    from sliceit_drake.systems.policy import PolicyAction as PolicyAction
    from sliceit_drake.systems.policy import PolicyConfig as PolicyConfig
    from sliceit_drake.systems.policy import PolicySystem as PolicySystem

    shapes = sliceit_drake.cutting.foods.shapes
    motions = sliceit_drake.cutting.motion
else:
    __getattr__, __dir__ = lazy_names(__name__)
