"""What the outputs of a run ask of the system that is cut."""

import dataclasses as dc
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiagramBuilder

from sliceit_drake.systems.declare import PlainSystem
from sliceit_drake.systems.food_look import OTHER

__all__ = ["Columns", "FoodBodyFrame", "FoodPicture", "FrameRecorder", "ReportingSystem"]


class Columns(Protocol):
    """A table whose columns have names."""

    def __getitem__(self, name: str, /) -> np.ndarray:
        """A column [n]."""
        ...


class FrameRecorder(Protocol):
    """A visualizer of meshes, which Meshcat's recordings do not animate by themselves."""

    def StartRecording(self) -> None:
        """Keeps every frame from now on."""

    def PublishRecording(self) -> None:
        """Writes the kept frames into Meshcat's recording."""


@dc.dataclass
class FoodPicture:
    """The surface of a food at one instant.

    Attributes:
        X_WF: Pose of the food frame.
        triangles: Corners in F [M, 3, 3], metres.
        is_cut_face: Whether each is on the cut [M].
        skin, flesh: Colours outside and inside, red, green, blue.
    """

    X_WF: RigidTransform
    triangles: np.ndarray
    is_cut_face: np.ndarray
    skin: tuple[float, float, float] = OTHER.skin
    flesh: tuple[float, float, float] = OTHER.flesh


@dc.dataclass
class FoodBodyFrame:
    """The solid of a food at one instant.

    Attributes:
        food: Which of a sequence's foods it is.
        points, rest: Corners now and before anything touched them, in W [V, 3], metres.
        tetrahedra: Their corners [M, 4].
        damage: Fraction of the toughness that is spent at each corner [V]: 0 intact, 1 cut.
        side: Side of the cut on which each corner is [V], 0 or 1.
    """

    food: int
    points: np.ndarray
    rest: np.ndarray
    tetrahedra: np.ndarray
    damage: np.ndarray
    side: np.ndarray


class ReportingSystem(PlainSystem):
    """A system that cuts, and what it tells beyond its ports, for record, picture and summary.

    A subclass overrides what it knows. By default there is nothing to tell: a run then has a
    record, a replay, a figure and a summary of what the ports carry alone.
    """

    def recorded(self) -> Mapping[str, Sequence[str]]:
        """Further output ports that a record keeps, and the names of their columns in it."""
        return {}

    def describe(self) -> str:
        """Parameters and discretisation, in one sentence, for the caption of a figure."""
        return ""

    def summary(self, record: Columns) -> dict[str, Any]:
        """Facts for the summary of a run, whose record has the columns of `recorded`."""
        return {}

    def section_areas(self) -> list[float]:
        """Areas of the sections that are cut one after another, m^2; empty if they have none.

        A system that has some records `food_index`, which of them is being cut, and `energy_work`.
        """
        return []

    def picture(self, context: Context) -> FoodPicture | None:
        """The food's surface in this system's context, or None."""
        return None

    def body(self, context: Context) -> FoodBodyFrame | None:
        """The food's solid in this system's context, or None."""
        return None

    def contact_responses(self, offset: float) -> list[np.ndarray]:
        """What `cutting.contact_response.contact_responses` says; empty if it is not known."""
        return []

    def frame_size(self) -> float:
        """Bytes that a frame of the food takes in a replay."""
        return 0.0

    def add_visualizer(
        self, builder: DiagramBuilder, meshcat: Meshcat, period: float
    ) -> FrameRecorder | None:
        """Adds what draws the food each `period`, s, to this system's diagram, and connects it.

        Returns:
            What must be told when to record, or None.
        """
        return None
