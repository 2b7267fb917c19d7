"""Effects: small classes that change one thing in a world, and what they see of a slice.

A user's own effect is a file with one subclass, given as `sliceit record ... --effect FILE:SIZE`:

    from sliceit_drake.stand_in.effect import Effect, Series

    class Brine(Effect):
        '''Food pulls on the blade in proportion to how much of it is wet.'''

        unit = "N"
        typical = 1.0

        def respond(self, series: Series) -> None:
            series.other[:, 5] -= self.size * series.cut
"""

import dataclasses as dc

import numpy as np

from sliceit_drake.configuration import ConfigurationError

__all__ = ["Effect", "Now", "Series", "SliceTruth", "Tissue"]


@dc.dataclass(frozen=True)
class SliceTruth:
    """What the world knows of one slice: what is the same while it is cut.

    Attributes:
        index: Order in the session, from 0.
        peeled: Whether the skin is off.
        height: Height of the food at the cut, metres; 0 without food.
        width: Width of the food along the edge, metres; 0 without food.
        toughness: Toughness of the food as the world has it, J/m^2.
        reference_speed: Speed at which it has that, m/s.
    """

    index: int = 0
    peeled: bool = False
    height: float = 0.0
    width: float = 0.0
    toughness: float = 400.0
    reference_speed: float = 0.02


@dc.dataclass(frozen=True)
class Tissue:
    """Places in the section or the food [M], metres.

    Attributes:
        x: Coordinate along the edge, from the middle of the section.
        height: Height above the board.
        depth: Depth below the outline, vertically.
        distance: Distance from the outline, inwards.
    """

    x: np.ndarray
    height: np.ndarray
    depth: np.ndarray
    distance: np.ndarray


@dc.dataclass
class Now:
    """The knife before a short stretch of its path, and what an effect may change about it.

    Attributes:
        time, period: Begin and duration of the stretch, s.
        position: Commanded position of Ko in F at its end [3], metres.
        press, draw: Speed of Ko into the food and along the edge, m/s.
        depth: Depth of the edge below the top of the food at the end, metres; negative above it.
        travel: Path of the edge in the food so far, metres.
        swept: Area that the flanks have swept so far, m^2.
        force: Force of food and board on the knife in the stretch before, in F [3], N.
        toughness, friction: Factors on the world's own; effects multiply.
        knife_shift: Knife off its commanded position, in F [3], metres; effects add.
        food_shift: Food off its place, in F [3], metres; effects add.
    """

    time: float
    period: float
    position: np.ndarray
    press: float
    draw: float
    depth: float
    travel: float
    swept: float
    force: np.ndarray
    toughness: float = 1.0
    friction: float = 1.0
    knife_shift: np.ndarray = dc.field(default_factory=lambda: np.zeros(3))
    food_shift: np.ndarray = dc.field(default_factory=lambda: np.zeros(3))

    @property
    def speed(self) -> float:
        """Speed of the edge, m/s."""
        return float(np.hypot(self.press, self.draw))


@dc.dataclass
class Series:
    """One slice as the world has it, every coupling step. Wrenches are on the knife, moment about
    Ko and force, in F [N, 6], Nm and N.

    Attributes:
        slice: What is the same during the slice.
        time: End of each coupling step [N], s, equally spaced.
        R, p: Commanded pose of the knife in F [N, 3, 3] and [N, 3], metres.
        p_true: True position of Ko [N, 3], metres.
        v: Velocity of Ko, in F [N, 3], m/s.
        phase: Label of the motion's segment at each time.
        depth: Depth of the true edge below the top of the food [N], metres.
        flank: Area of both flanks in front of cut food [N], m^2.
        flank_arm: Vector from Ko to the middle of that area, in F [N, 3], metres.
        cut: Fraction of the section that is cut [N].
        edge, normal, friction: Wrenches of the food by mechanism.
        board: Wrench of the board.
        other: Wrench of anything else.
    """

    slice: SliceTruth
    time: np.ndarray
    R: np.ndarray
    p: np.ndarray
    p_true: np.ndarray
    v: np.ndarray
    phase: list[str]
    depth: np.ndarray
    flank: np.ndarray
    flank_arm: np.ndarray
    cut: np.ndarray
    edge: np.ndarray
    normal: np.ndarray
    friction: np.ndarray
    board: np.ndarray
    other: np.ndarray

    @property
    def period(self) -> float:
        """Time between two rows, s."""
        return float(self.time[1] - self.time[0])

    @property
    def press(self) -> np.ndarray:
        """Speed of Ko into the food [N], m/s."""
        return -self.v[:, 2]

    @property
    def draw(self) -> np.ndarray:
        """Speed of Ko along the edge [N], m/s."""
        return np.asarray(np.einsum("nc,nc->n", self.v, self.R[:, :, 0]))

    @property
    def force(self) -> np.ndarray:
        """Force of all on the knife, in F [N, 3], N."""
        return self.wrench()[:, 3:]

    def wrench(self) -> np.ndarray:
        """Wrench of all on the knife [N, 6]."""
        return self.edge + self.normal + self.friction + self.board + self.other


class Effect:
    """One cause of measured forces that differ from the base model's, of a size.

    Every hook does nothing unless it is overridden; a size of 0 changes nothing. A new copy serves
    each slice, so what a hook keeps in `self` is forgotten after it.

    Attributes:
        cause: What a diagnosis would have to call it; empty where it stands in no list of causes.
        unit: Unit of the size.
        typical: A size that matters and could be met in a kitchen.
        least: Least size that has a meaning.
        every_coupling_step: Whether `drive` must see each, as where it feeds a force back.
        size: How much of the effect there is.
    """

    cause = ""
    unit = ""
    typical = 1.0
    least = -np.inf
    every_coupling_step = False

    def __init__(self, size: float | None = None) -> None:
        """Makes an effect of a size; of its typical one if there is none.

        Raises:
            ConfigurationError: The size is no finite number, or less than `least`.
        """
        self.size = self.typical if size is None else float(size)
        if not np.isfinite(self.size) or self.size < self.least:
            raise ConfigurationError(
                f"has no meaning with a size of {self.size:g}",
                field=type(self).__name__,
                fix=f"Give at least {self.least:g}; {self.typical:g} is typical.",
            )

    def begin(self, facts: SliceTruth, rng: np.random.Generator) -> None:
        """Prepares for a slice.

        Args:
            facts: What the world knows of the slice.
            rng: Random numbers for what differs from slice to slice.
        """
        self.facts = facts
        self.rng = rng

    def reshape(self, p: np.ndarray) -> np.ndarray:
        """Where the food's material is that nominally is at p [V, 3], metres, in F."""
        return p

    def toughness(self, at: Tissue) -> np.ndarray | float:
        """Factor on the toughness [M]."""
        return 1.0

    def stiffness(self, at: Tissue) -> np.ndarray | float:
        """Factor on the modulus [M]."""
        return 1.0

    def drive(self, now: Now) -> None:
        """Changes the factors and shifts of `now` before a stretch of the path."""

    def respond(self, series: Series) -> None:
        """Changes the forces of a slice when it is done, in place."""

    def measure(self, series: Series, wrench: np.ndarray) -> np.ndarray:
        """The wrench that the sensor gets.

        Args:
            series: The slice.
            wrench: Wrench on the knife, moment about Ko and force, in K [N, 6].

        Returns:
            The same, changed.
        """
        return wrench
