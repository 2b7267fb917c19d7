"""The knife: its section, its signed distance, the stiffness of its blade, and knives by name."""

import dataclasses as dc
import itertools
from pathlib import Path

import numpy as np

from sliceit_drake.configuration import ConfigurationError, choice, load_yaml, quantity
from sliceit_drake.resources import known_yaml

__all__ = [
    "STEEL_DENSITY",
    "UNSUPPORTED",
    "Knife",
    "NamedKnife",
    "load_knife",
    "section_distance",
    "signed_distance",
]

FOLDER = "calibration/knives"

STEEL_DENSITY = 7800.0
"""kg/m^3."""

UNSUPPORTED = {
    "serrated": "teeth cut by their points and saw; toughness times width does not describe that",
    "curved": "a curved edge meets the food point by point; contact and board take a straight one",
    "single bevel": "it pushes the blade aside; both sides of the section are alike here",
}
"""Kinds of knives that are known and cannot be computed, and why."""


@dc.dataclass
class Knife:
    """A straight double-bevel knife of constant section.

    Knife frame K: origin at the middle of the edge, Kx along the edge, Kz from the spine to the
    edge, Ky the blade's normal. The section is the convex polygon tip, shoulder, spine, mirrored in
    the plane y = 0. Defaults are the knife of the SliceIt! configuration ("gazebo").
    """

    profile: str = choice("straight", ("straight", *UNSUPPORTED))
    """Kind of edge; only a straight one with two equal bevels can be computed."""
    spine_thickness: float = quantity(3.5e-3, "m", low=2e-4, high=2e-2)
    """Thickness at the spine."""
    edge_thickness: float = quantity(8e-5, "m", low=1e-6, high=2e-3)
    """Thickness at the shoulder, where the edge bevel begins."""
    height: float = quantity(59e-3, "m", low=5e-3, high=0.3)
    """From the shoulder to the spine."""
    tip_height: float = quantity(4e-5, "m", low=1e-6, high=5e-3)
    """From the edge to the shoulder."""
    length: float = quantity(0.150, "m", low=0.02, high=0.6)
    """Length of the edge."""
    edge_radius: float = quantity(0.0, "m", low=0.0, high=5e-4)
    """Radius of the rounded edge and of the other corners."""
    lateral_stiffness: float = quantity(2e4, "N/m", low=1e2, high=1e8)
    """Stiffness of the edge's middle against lateral force: a steel cantilever of the mean section
    held 0.1 m away, 3 E I / L^3 = 17 kN/m with E = 200 GPa."""
    lateral_relaxation_time: float = quantity(1e-3, "s", low=0.0, high=0.1)
    """Damping over stiffness of the bending blade."""

    def check(self, where: str) -> None:
        if self.profile in UNSUPPORTED:
            raise ConfigurationError(
                f"{self.profile} is not supported: {UNSUPPORTED[self.profile]}",
                field=f"{where}.profile",
                fix="Use a knife with a straight edge and two bevels, as calibration/knives lists.",
            )
        if self.edge_thickness >= self.spine_thickness:
            raise ConfigurationError(
                f"= {self.edge_thickness} m is not below spine_thickness, {self.spine_thickness} m",
                field=f"{where}.edge_thickness",
                fix="Give the thickness of the bevel's shoulder, as 8e-5.",
            )
        # The distance is that of a convex section: the bevel must be blunter than the flank.
        slender = self.edge_thickness * self.height / (self.spine_thickness - self.edge_thickness)
        if self.tip_height > slender:
            raise ConfigurationError(
                f"= {self.tip_height} m makes the edge bevel more slender than the flanks; the "
                "section must be convex",
                field=f"{where}.tip_height",
                fix=f"Give at most {slender:.4g} m, edge_thickness * height / (spine - edge).",
            )
        limit = 0.5 * min(self.edge_thickness, self.tip_height)
        if self.edge_radius > limit:
            raise ConfigurationError(
                f"= {self.edge_radius} m does not fit into the edge bevel",
                field=f"{where}.edge_radius",
                fix=f"Give at most half of edge_thickness and of tip_height, {limit} m.",
            )

    def lateral_mass(self) -> float:
        """Mass of steel that moves with the edge's middle when the blade bends, kg.

        33/140 of the blade, as for the first mode of a cantilever with a mass at its end.
        """
        section = 0.5 * (self.spine_thickness + self.edge_thickness) * self.height
        return 33.0 / 140.0 * STEEL_DENSITY * section * self.length

    def half_section(self) -> np.ndarray:
        """Corners of the half section, tip to spine, drawn in by `edge_radius`.

        Returns:
            Array [3, 2] of (|y|, height above the edge), metres. The distance to the knife is the
            distance to this polygon minus `edge_radius`.
        """
        outer = np.array(
            [
                [0.0, 0.0],
                [0.5 * self.edge_thickness, self.tip_height],
                [0.5 * self.spine_thickness, self.tip_height + self.height],
            ]
        )
        r = self.edge_radius
        if r == 0.0:
            return outer
        bevel, flank = _outward_normals(outer)
        spine = np.array([0.0, 1.0])
        mirrored_bevel = bevel * [-1.0, 1.0]

        def meet(n1: np.ndarray, p1: np.ndarray, n2: np.ndarray, p2: np.ndarray) -> np.ndarray:
            return np.linalg.solve(np.array([n1, n2]), [n1 @ p1 - r, n2 @ p2 - r])

        return np.array(
            [
                meet(bevel, outer[0], mirrored_bevel, outer[0]),
                meet(bevel, outer[0], flank, outer[1]),
                meet(flank, outer[2], spine, outer[2]),
            ]
        )

    def parameters(self) -> np.ndarray:
        """The section as the kernels take it, see `layouts.KNIFE` [8]."""
        return np.concatenate([self.half_section().ravel(), [self.edge_radius, 0.5 * self.length]])


def _outward_normals(section: np.ndarray) -> np.ndarray:
    """Outward unit normals of bevel and flank [2, 2]."""
    side = np.diff(section, axis=0)
    normal = np.stack([side[:, 1], -side[:, 0]], axis=1)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


@dc.dataclass
class NamedKnife:
    """A knife and its sources.

    Attributes:
        knife: Measures of the knife.
        sources: Source of each measure, by the field's name; a measure without is chosen freely.
        note: What it cannot be used for.
    """

    knife: Knife = dc.field(default_factory=Knife)
    sources: dict[str, str] = dc.field(default_factory=dict)
    note: str = ""

    def check(self, where: str) -> None:
        fields = [field.name for field in dc.fields(Knife)]
        for name in self.sources:
            if name not in fields:
                raise ConfigurationError(
                    "is the source of nothing that a knife has",
                    field=f"{where}.sources.{name}",
                    fix=f"Known: {', '.join(fields)}.",
                )


def load_knife(name: str | Path, field: str = "knife_name") -> NamedKnife:
    """Reads a knife that ships, or a YAML file; `field` is the path of what names it, for errors.

    Raises:
        ConfigurationError: Naming file, field and fix.
    """
    unknown = f"there is no knife {str(name)!r}; there are"
    otherwise = "Name one of them, or give a YAML file (docs/reference/foods.md)."
    return load_yaml(NamedKnife, known_yaml(name, FOLDER, unknown, field, otherwise))


def section_distance(knife: Knife, y: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Signed distance to the knife's section [N], metres, negative inside.

    Args:
        knife: The knife.
        y: Coordinates along Ky [N], metres.
        height: Heights above the edge (-z_K) [N], metres.
    """
    section = knife.half_section()
    p = np.stack([np.abs(y), np.asarray(height, float)], axis=-1)
    normals = np.concatenate([_outward_normals(section), [[0.0, 1.0]]])
    planes = [(p - corner) @ n for corner, n in zip(section, normals, strict=True)]
    inside = np.max(planes, axis=0)
    corners = np.concatenate([section, [[0.0, section[2, 1]]]])
    nearest = np.full(len(p), np.inf)
    for a, b in itertools.pairwise(corners):
        along = np.clip(((p - a) @ (b - a)) / ((b - a) @ (b - a)), 0.0, 1.0)
        offset = p - (a + along[:, None] * (b - a))
        nearest = np.minimum(nearest, np.linalg.norm(offset, axis=-1))
    return np.where(inside > 0.0, nearest, inside) - knife.edge_radius


def signed_distance(knife: Knife, p_KP: np.ndarray) -> np.ndarray:
    """Signed distance [N] of points [N, 3] to the knife, a prism of `length`: negative inside.

    Points are in the knife frame; all is in metres.
    """
    section = section_distance(knife, p_KP[:, 1], -p_KP[:, 2])
    beyond = np.abs(p_KP[:, 0]) - 0.5 * knife.length
    outside = np.hypot(np.maximum(section, 0.0), np.maximum(beyond, 0.0))
    return np.asarray(outside + np.minimum(np.maximum(section, beyond), 0.0))
