"""What is known of a slice, and the force that is predicted for it."""

import dataclasses as dc
from typing import Any

import numpy as np

from sliceit_drake.configuration import ConfigurationError

__all__ = ["ForceSeries", "SharedFacts", "SliceFacts"]


@dc.dataclass(frozen=True)
class SliceFacts:
    """What is known of a slice beside its motion.

    Attributes:
        name, condition: Of the record.
        slice_index: Order in the session, from 0.
        knife_slices: Slices cut since the knife was sharpened, before this; the order in the
            session where that is not known.
        peeled: Whether the skin is off.
        food: Whether there is food.
        height, width: Of the food's section, metres; 0 without food.
        speed: Of the press while slicing, m/s; 0 where none is given.
        draw_ratio: Draw over press speed while slicing.
        tared: Whether the sensor was zeroed before the record.
    """

    name: str = ""
    condition: str = ""
    slice_index: int = 0
    knife_slices: int = 0
    peeled: bool = False
    food: bool = True
    height: float = 0.0
    width: float = 0.0
    speed: float = 0.0
    draw_ratio: float = 0.0
    tared: bool = True


class SharedFacts(SliceFacts):
    """What replicates have in common: what a cause sees that does not go `by_slice`."""

    @classmethod
    def of(cls, facts: SliceFacts) -> "SharedFacts":
        """Those of a slice."""
        return cls(**{f.name: getattr(facts, f.name) for f in dc.fields(SliceFacts)})

    def __getattribute__(self, name: str) -> Any:
        if name in ("slice_index", "knife_slices"):
            raise ConfigurationError(
                f"asks for {name}, which replicates do not share",
                field="cause",
                fix="Set by_slice = True in its class.",
            )
        return super().__getattribute__(name)


@dc.dataclass
class ForceSeries:
    """A predicted slice on an even grid of times; wrenches on the knife, moment about Ko and force,
    in F, mean over the coupling step that ends at the time, Nm and N.

    Attributes:
        time: Ends of the coupling steps [N], s, on the record's clock.
        R, p: Pose X_FK of the knife as recorded [N, 3, 3] and [N, 3], metres.
        v, w: Velocity of Ko and angular velocity, in F [N, 3], m/s and rad/s.
        parts: By mechanism, each [N, 6]: edge, normal, friction, board, weight.
        depth: Of the edge below the top of the food [N], metres; negative above it.
        in_contact: Whether food or board touch the knife [N].
        wrench: Sum of the parts, as causes have changed it [N, 6].
    """

    time: np.ndarray
    R: np.ndarray
    p: np.ndarray
    v: np.ndarray
    w: np.ndarray
    parts: dict[str, np.ndarray]
    depth: np.ndarray
    in_contact: np.ndarray
    wrench: np.ndarray

    @property
    def period(self) -> float:
        """Between two rows, s."""
        return float(self.time[1] - self.time[0])

    @property
    def speed(self) -> np.ndarray:
        """Speed of Ko [N], m/s."""
        return np.asarray(np.linalg.norm(self.v, axis=1))

    def in_knife(self, vectors: np.ndarray) -> np.ndarray:
        """Vectors of F [N, 3] in the knife's axes K."""
        return np.asarray(np.einsum("nji,nj->ni", self.R, vectors))

    def in_food(self, vectors: np.ndarray) -> np.ndarray:
        """Vectors of K [N, 3] or [3] in the food's axes F."""
        if vectors.ndim == 1:
            return np.asarray(self.R @ vectors)
        return np.asarray(np.einsum("nij,nj->ni", self.R, vectors))
