"""Fitting of the simulation's parameters to records of slices."""

from typing import TYPE_CHECKING

from sliceit_drake.lazy_names import lazy_names

if TYPE_CHECKING:
    from sliceit_drake.calibration.calibrate import CalibrationOptions as CalibrationOptions
    from sliceit_drake.calibration.setup import CalibrationSetup as CalibrationSetup
    from sliceit_drake.calibration.setup import ParameterRange as ParameterRange
else:
    __getattr__, __dir__ = lazy_names(__name__)
