"""The causes that come with the package, one module a family."""

from sliceit_drake.diagnosis.cause import Cause
from sliceit_drake.diagnosis.causes import material, sensor

__all__ = ["BUILT_IN"]

BUILT_IN: tuple[type[Cause], ...] = (
    material.Viscoelasticity,
    material.ToughnessBySpeed,
    material.SkinToughness,
    material.CoreRatio,
    material.SlicePushLaw,
    sensor.SensorZero,
    sensor.SensorGain,
    sensor.SensorTilt,
    sensor.SensorDelay,
)
