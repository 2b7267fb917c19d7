"""The causes that come with the package, by family."""

from sliceit_drake.diagnosis.cause import Cause
from sliceit_drake.diagnosis.causes import contact, material, mounting, robot, sensor

__all__ = ["BUILT_IN"]

BUILT_IN: tuple[type[Cause], ...] = (
    material.Viscoelasticity,
    material.ToughnessBySpeed,
    contact.StaticFriction,
    contact.FlankAdhesion,
    material.SkinToughness,
    contact.BluntEdge,
    contact.Dulling,
    material.SlicePushLaw,
    mounting.SectionShape,
    material.CoreRatio,
    mounting.BoardHeight,
    mounting.BoardLaw,
    mounting.ArmCompliance,
    mounting.HolderCompliance,
    mounting.FoodSlip,
    sensor.SensorZero,
    sensor.SensorGain,
    sensor.SensorTilt,
    sensor.SensorDelay,
    robot.ToolWeight,
    robot.Vibration,
    robot.StickSlip,
)
"""In the order of docs/reference/causes.md. Modulus, toughness and friction are base parameters."""
