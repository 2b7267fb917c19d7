"""Effects by name, and effects that a user wrote."""

from pathlib import Path

from sliceit_drake.configuration import ConfigurationError, did_you_mean
from sliceit_drake.resources import load_subclasses
from sliceit_drake.stand_in import knife_effects, mounting_effects, sensor_effects, tissue_effects
from sliceit_drake.stand_in.effect import Effect

__all__ = ["EFFECTS", "effects_as_markdown", "make_effect"]

EFFECTS: dict[str, type[Effect]] = {
    "bulk_relaxation": tissue_effects.BulkRelaxation,
    "rate_toughness": tissue_effects.RateToughness,
    "flank_friction": knife_effects.FlankFriction,
    "flank_adhesion": knife_effects.FlankAdhesion,
    "toughness": tissue_effects.Toughness,
    "stiffness": tissue_effects.Stiffness,
    "skin": tissue_effects.SkinToughness,
    "blunt_edge": knife_effects.BluntEdge,
    "dulling_edge": knife_effects.DullingEdge,
    "slice_push_law": tissue_effects.SlicePushLaw,
    "section_shape": tissue_effects.SectionShape,
    "core": tissue_effects.CoreToughness,
    "board_height": mounting_effects.BoardHeight,
    "board_law": mounting_effects.BoardLaw,
    "arm_compliance": mounting_effects.ArmCompliance,
    "holder_compliance": mounting_effects.HolderCompliance,
    "food_slip": mounting_effects.FoodSlip,
    "sensor_drift": sensor_effects.SensorDrift,
    "sensor_gain": sensor_effects.SensorGain,
    "sensor_tilt": sensor_effects.SensorTilt,
    "sensor_delay": sensor_effects.SensorDelay,
    "tool_weight": sensor_effects.ToolWeight,
    "drive_vibration": sensor_effects.DriveVibration,
    "stick_slip": sensor_effects.StickSlip,
    "magnetic_board": mounting_effects.MagneticBoard,
    "juice_film": knife_effects.JuiceFilm,
    "serrated_edge": knife_effects.SerratedEdge,
    "warm_wrist": mounting_effects.WarmWrist,
}
"""All effects by name."""


def effects_as_markdown() -> str:
    """A table of all effects: cause, typical size, what it does."""
    lines = ["| name | cause | typical size | what it does |", "|---|---|---|---|"]
    for name, kind in EFFECTS.items():
        words = " ".join((kind.__doc__ or "").split("\n\n")[0].split())
        cause = kind.cause or "unlisted"
        size = f"{kind.typical:g} {kind.unit}".strip()
        lines.append(f"| `{name}` | {cause} | {size} | {words} |")
    return "\n".join(lines)


def make_effect(text: str) -> Effect:
    """The effect that a text names.

    Args:
        text: NAME, NAME:SIZE, FILE.py or FILE.py:SIZE; without a size its typical one.

    Raises:
        ConfigurationError: There is no such effect, or the size is no number.
    """
    name, size = text, None
    head, colon, tail = text.rpartition(":")
    if colon and not tail.endswith(".py"):
        name = head
        try:
            size = float(tail)
        except ValueError:
            raise ConfigurationError(
                f"has the size {tail!r}, which is no number",
                field=f"--effect {text}",
                fix="Write NAME:SIZE, as skin:0.3.",
            ) from None
    kind = _from_file(Path(name)) if name.endswith(".py") else EFFECTS.get(name)
    if kind is None:
        raise ConfigurationError(
            f"{name!r} is no effect",
            field="--effect",
            fix=did_you_mean(name, EFFECTS, f"Give a file.py, or one of {', '.join(EFFECTS)}."),
        )
    return kind(size)


def _from_file(file: Path) -> type[Effect]:
    kinds = load_subclasses(f"stand_in_effect_{file.stem}", file, Effect)
    if kinds is None:
        raise ConfigurationError(
            "there is no such file", source=str(file), field="--effect", fix="Check the path."
        )
    if len(kinds) != 1:
        raise ConfigurationError(
            f"holds {len(kinds)} effects",
            source=str(file),
            fix="Write one subclass of sliceit_drake.stand_in.effect.Effect in it; the docstring "
            "of that module has an example.",
        )
    return kinds[0]
