"""What a diagnosis would have to say of an effect: the names of both worlds side by side."""

from sliceit_drake.stand_in.effect_registry import EFFECTS

__all__ = ["BASE_OF", "CAUSE_OF", "UNKNOWN"]

CAUSE_OF: dict[str, str] = {
    "bulk_relaxation": "viscoelasticity",
    "rate_toughness": "toughness_rate",
    "flank_adhesion": "adhesion",
    "skin": "skin",
    "blunt_edge": "bluntness",
    "dulling_edge": "dulling",
    "slice_push_law": "slice_push_law",
    "section_shape": "section_shape",
    "core": "core",
    "board_height": "board_height",
    "board_law": "board_stiffness",
    "arm_compliance": "arm_compliance",
    "holder_compliance": "holder_compliance",
    "food_slip": "slip",
    "sensor_drift": "sensor_zero",
    "sensor_gain": "sensor_gain",
    "sensor_tilt": "sensor_tilt",
    "sensor_delay": "sensor_delay",
    "tool_weight": "tool_weight",
    "drive_vibration": "vibration",
    "stick_slip": "stick_slip",
}
"""Effects that have a cause in the list, and its name there."""

BASE_OF: dict[str, str] = {
    "toughness": "material.toughness",
    "stiffness": "material.youngs_modulus",
    "flank_friction": "material.friction",
}
"""Effects that are a shift of a base parameter, and its name."""

UNKNOWN = tuple(name for name, kind in EFFECTS.items() if not kind.cause)
"""Effects that stand in no list."""
