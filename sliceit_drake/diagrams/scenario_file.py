"""Finds the file of a scenario, and says what a user gave where it is none."""

from pathlib import Path

import yaml

from sliceit_drake.configuration import ConfigurationError, closest
from sliceit_drake.resources import file_or_resource, here_or_shipped, named_yaml, shipped_names

__all__ = ["other_kind", "scenario_file", "top_fields"]

MESHES = (".inp", ".mesh", ".msh", ".obj", ".ply", ".stl", ".vtk", ".vtu")
OTHERS = (".csv", ".gif", ".html", ".jpg", ".json", ".md", ".npz", ".onnx", ".pdf", ".png", ".py")
"""Files that are no YAML, which scenarios are."""
KINDS = (
    (
        {"distribution", "spring", "rms_error"},
        "is a calibrated food, and not a scenario",
        "Use it in one: sliceit simulate --set calibration={}",
    ),
    (
        {"sources"},
        "is a knife, and not a scenario",
        "Use it in one: sliceit simulate --set knife_name={}",
    ),
    (
        {"conditions"},
        "is a protocol of several slices, and not a scenario",
        "Cut them: sliceit record {}",
    ),
    (
        {"provenance", "wrench"},
        "is what is known of a recorded slice, and not a scenario",
        "Check the record: sliceit records check {}",
    ),
    (
        {"parameters"},
        "says what a calibration searches, and is not a scenario",
        "Calibrate with it: sliceit calibrate RECORDS --food {}",
    ),
    (
        {"serial", "payload", "limits"},
        "describes a robot, and not a scenario",
        "Give it beside one: sliceit hardware SCENARIO --robot {}",
    ),
)
"""Other files of the project, by fields that only they have: what each is, and what it is for."""
EXAMPLE = "scenarios/cucumber_measured.yaml"


def scenario_file(name: str | Path) -> Path:
    """The file of a scenario that a user names.

    Args:
        name: A YAML file, or the name of one that ships.

    Raises:
        ConfigurationError: There is none, or it is something else.
    """
    place = here_or_shipped(name)
    if place.is_dir():
        raise _no_scenario("is a folder, not a scenario", place, place)
    file = file_or_resource(str(name)) or named_yaml(name, "scenarios")
    if file is None or not file.is_file():
        raise ConfigurationError(
            "there is no such scenario, neither here nor in the package",
            source=str(name),
            fix=_meant(Path(name).stem),
        )
    kind = file.suffix.lower()
    if kind in MESHES:
        raise ConfigurationError(
            "is a mesh, not a scenario",
            source=str(file),
            fix=f"Write one that cuts it, as `food: {{shape: !MeshFile {{path: {file}}}}}`.",
        )
    if kind in OTHERS:
        raise _no_scenario(f"is a {kind} file; a scenario is a YAML file", file, file.parent)
    return file


def other_kind(file: Path, known: set[str]) -> tuple[str, str] | None:
    """What a YAML file is that is no scenario, and what to do with it; or None.

    Args:
        file: Whose fields are not those of a scenario.
        known: Names of all fields that a scenario has at any depth.
    """
    fields = top_fields(file)
    for own, problem, fix in KINDS:
        if own & fields:
            return problem, fix.format(file)
    if len(fields) > 1 and not fields & known:
        return "has none of a scenario's fields", f"Give a scenario, such as {EXAMPLE}."
    return None


def top_fields(file: Path) -> set[str]:
    """Names of the fields at the top of a YAML file; none where it cannot be read."""
    try:
        root = yaml.compose(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        return set()
    pairs = root.value if isinstance(root, yaml.MappingNode) else []
    return {str(key.value) for key, _ in pairs}


def _no_scenario(problem: str, place: Path, folder: Path) -> ConfigurationError:
    """The scenario of a run's folder is suggested, or else those that ship."""
    inside = folder / "scenario.yaml"
    fix = f"Give {inside}." if inside.is_file() else _meant("")
    return ConfigurationError(problem, source=str(place), fix=fix)


def _meant(name: str) -> str:
    """What to give in the place of a name that no scenario has."""
    shipped = shipped_names("scenarios")
    give = f"Give a YAML file, or one of {', '.join(shipped)}."
    food = closest(name, shipped_names("calibration/foods"))
    cutting = [each for each in shipped if each.split("_")[0] == food]
    if scenario := closest(name, shipped):
        return f'Did you mean "{scenario}"? {give}'
    if food and cutting:
        return f'Did you mean "{cutting[0]}", which cuts a {food}? {give}'
    if food:
        return f"It is a food: sliceit simulate --set calibration={food} cuts one. {give}"
    if knife := closest(name, shipped_names("calibration/knives")):
        return f"It is a knife: sliceit simulate --set knife_name={knife} cuts with it. {give}"
    return give
