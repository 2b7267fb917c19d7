"""Physical parameters of a cut by name: read, set, and derivatives of a slice by them."""

import copy
import dataclasses as dc
from collections.abc import Iterable, Mapping

import numpy as np

from sliceit_drake.cutting.gradient import SliceGradient
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.workspace import parameter_row

__all__ = [
    "POINT_PARAMETERS",
    "get_parameter",
    "parameter_names",
    "parameter_step",
    "pull_back",
    "with_parameters",
]

GROUPS = ("material", "effects", "knife", "numerics")

POINT_PARAMETERS = (
    "point_scales.toughness",
    "point_scales.friction",
    "point_scales.flank_stiffness",
)
"""Parameters with a value for each cut point."""

# How the cut is computed, not what is cut; a number of slices; an event.
NUMERICAL = (
    "time_step",
    "stability_margin",
    "flank_length",
    "anchor_length",
    "edge_spread",
    "work_error",
    "slices",
    "slip",
    "thickness",
)
COMPLIANCES = ("effects.compliance.arm", "effects.compliance.holder")


def parameter_names(model: CuttingModel) -> list[str]:
    """Names of all shared real parameters, as "material.toughness" or
    "effects.relaxation.shares.0"."""
    return [name for group in GROUPS for name in _leaves(getattr(model, group), group)]


def _leaves(value: object, path: str) -> Iterable[str]:
    if dc.is_dataclass(value):
        for field in dc.fields(value):
            if field.name not in NUMERICAL:
                yield from _leaves(getattr(value, field.name), f"{path}.{field.name}")
    elif isinstance(value, list):
        for k, item in enumerate(value):
            yield from _leaves(item, f"{path}.{k}")
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield path


def get_parameter(model: CuttingModel, name: str) -> float | np.ndarray:
    """Value of a parameter; an array [P] for `POINT_PARAMETERS`.

    Raises:
        KeyError: There is no such parameter.
    """
    value: object = model
    for part in name.split("."):
        value = _child(value, part, name)
    if not isinstance(value, int | float | np.ndarray):
        raise KeyError(f"{name} is no single parameter")
    return value


def _child(value: object, part: str, name: str) -> object:
    if isinstance(value, list):
        if part.isdigit() and int(part) < len(value):
            return value[int(part)]
    elif dc.is_dataclass(value) and part in {f.name for f in dc.fields(value)}:
        return getattr(value, part)
    raise KeyError(f"{name}: there is no {part}")


def with_parameters(
    model: CuttingModel,
    values: Mapping[str, float | np.ndarray],
    inertia_of: CuttingModel | None = None,
) -> CuttingModel:
    """The same cut with other values of parameters.

    Args:
        model: The cut.
        values: By name.
        inertia_of: See `CuttingModel.derive`.

    Raises:
        KeyError: There is no such parameter.
        TimeStepError: The step is beyond the limit and masses are not scaled.
    """
    changed = {}
    for name, new in values.items():
        get_parameter(model, name)
        group, *path, last = name.split(".")
        if group not in changed:
            changed[group] = copy.deepcopy(getattr(model, group))
        owner = changed[group]
        for part in path:
            owner = _child(owner, part, name)
        if isinstance(owner, list):
            owner[int(last)] = float(new)
        else:
            setattr(owner, last, new if isinstance(new, np.ndarray) else float(new))
    return model.derive(inertia_of, **changed)


SCALES = {
    "effects.skin.toughness": 0.1,
    "effects.bluntness.initiation": 10.0,
    "effects.bluntness.dulling": 10.0,
    "effects.outside.toughness": 0.1,
    "effects.entry.initiation": 10.0,
    "effects.entry.dulling": 10.0,
    "effects.adhesion.stress": 100.0,
    "effects.adhesion.viscosity": 1e3,
    "effects.compliance.arm": 1e-6,
    "effects.compliance.holder": 1e-6,
    "material.static_friction": 0.1,
    "material.damping_time": 1e-5,
    "knife.edge_radius": 1e-5,
}
"""Sizes that matter of parameters that may be zero."""


def parameter_step(model: CuttingModel, name: str) -> float:
    """A size of the parameter that matters: its value, or where it may be zero a scale.

    Raises:
        KeyError: There is no such parameter.
    """
    value = get_parameter(model, name)
    return max(abs(float(value)), SCALES.get(name, 1e-3))


def pull_back(
    model: CuttingModel, gradient: SliceGradient, names: Iterable[str]
) -> dict[str, float | np.ndarray]:
    """Derivatives by named parameters, from those by what the kernels read.

    What the kernels read is an explicit, smooth function of each shared parameter, which takes a
    millisecond: its derivative is taken by central differences in double precision. Factors by cut
    point are differentiated in closed form. The added inertia does not follow the parameters.

    Args:
        model: The cut at which `gradient` was taken.
        gradient: Result of `SliceAdjoint.gradient`.
        names: Names of the parameters.
    """
    out: dict[str, float | np.ndarray] = {}
    for name in names:
        if name in POINT_PARAMETERS:
            out[name] = _by_point(model, gradient, name)
            continue
        if name in COMPLIANCES:
            out[name] = float(gradient.compliance[COMPLIANCES.index(name)])
            continue
        value = get_parameter(model, name)
        step = 1e-5 * parameter_step(model, name)
        moved = [with_parameters(model, {name: float(value) + shift}) for shift in (step, -step)]
        out[name] = 0.0
        for time_step, by_row in gradient.rows.items():
            more, less = (parameter_row(each.with_step(time_step)) for each in moved)
            out[name] += float(by_row @ (more - less)) / (2.0 * step)
    return out


def _by_point(model: CuttingModel, gradient: SliceGradient, name: str) -> np.ndarray:
    kind = name.split(".")[1]
    direct = {"toughness": "toughness", "friction": "friction_scale"}.get(kind, "flank_scale")
    adjoint = gradient.by(direct).copy()
    if kind == "friction":
        return adjoint
    if kind == "toughness":
        by_scale = model.toughness_by_scale
        adjoint *= by_scale
        force = model.edge_forces()
        rise = np.diff(force, axis=1) / model.tables.spacing
        highest, steepest = force.argmax(1), rise.argmax(1)
        points = np.arange(len(force))
        length = model.numerics.unloading_length
        flat = force[points, highest] / length >= rise[points, steepest]
        width = model.tables.width
        slope = np.where(
            flat,
            width[points, highest] / length,
            (np.diff(width, axis=1) / model.tables.spacing)[points, steepest],
        )
        return adjoint + gradient.by("unloading") * slope * by_scale
    return adjoint * model.flank_scale / model.point_scales.flank_stiffness
