"""What a slice record says besides its series: its YAML file (docs/reference/records.md).

A field that is null was not given. One that was looked for and is not known is also listed in
`SliceMetadata.unknown`, so that a forgotten field can be told from an unknown one.
"""

import dataclasses as dc

from sliceit_drake.configuration import ConfigurationError, choice, quantity

__all__ = [
    "PHASE_LABELS",
    "FoodFacts",
    "KnifeFacts",
    "NominalMotion",
    "Phase",
    "ProcessingStep",
    "SensorFacts",
    "SliceMetadata",
    "ToolFacts",
    "WrenchFacts",
    "slice_name",
]

PHASE_LABELS = (
    "air",
    "approach",
    "slice",
    "hold",
    "retract",
    "second_pass",
    "board_press",
    "weight",
    "other",
)
"""air: moving or resting without contact; weight: the resting tool in several orientations."""


@dc.dataclass
class FoodFacts:
    """The food, and where its frame F is in the world W.

    F has Fz up, its origin on the board under the middle of the cut, and Fy along the normal of
    the cut.
    """

    name: str = "unknown"
    shape: str = choice("unknown", ("cylinder", "halfcylinder", "box", "ellipsoid", "unknown"))
    """Cylinders and halves of them lie along Fy."""
    size: list[float] | None = quantity(None, "m", low=1e-3, high=1.0, size=3)
    """Extent along Fx, Fy, Fz."""
    support: str = choice("unknown", ("clamped_slab", "end_slice", "unknown"))
    """clamped_slab: held on both sides of the cut; end_slice: the slice is free to part."""
    slice_thickness: float | None = quantity(None, "m", low=1e-4, high=0.5)
    """Thickness of the slice cut off."""
    peeled: bool | None = None
    position: list[float] | None = quantity(None, "m", low=-5.0, high=5.0, size=3)
    """p_WF, position of F's origin in W."""
    yaw: float | None = quantity(None, "rad", low=-6.3, high=6.3)
    """Rotation of F in W about Wz."""


@dc.dataclass
class KnifeFacts:
    """The knife: measures of its section as in `sliceit_drake.cutting.knife`."""

    name: str = "unknown"
    length: float | None = quantity(None, "m", low=0.02, high=0.6)
    """Length of the edge."""
    height: float | None = quantity(None, "m", low=5e-3, high=0.3)
    """From the shoulder to the spine."""
    spine_thickness: float | None = quantity(None, "m", low=2e-4, high=2e-2)
    """Thickness at the spine."""
    edge_thickness: float | None = quantity(None, "m", low=1e-6, high=2e-3)
    """Thickness at the shoulder of the edge bevel."""
    tip_height: float | None = quantity(None, "m", low=1e-6, high=5e-3)
    """From the edge to the shoulder."""
    edge_radius: float | None = quantity(None, "m", low=0.0, high=5e-4)
    """Radius of the rounded edge."""


@dc.dataclass
class ToolFacts:
    """All that hangs beyond the wrench sensor, knife included."""

    mass: float | None = quantity(None, "kg", low=0.0, high=20.0)
    """Mass."""
    center_of_mass: list[float] | None = quantity(None, "m", low=-1.0, high=1.0, size=3)
    """Position of the centre of mass from Ko, in K."""
    inertia: list[float] | None = quantity(None, "kg m2", low=-10.0, high=10.0, size=6)
    """Ixx, Iyy, Izz, Ixy, Ixz, Iyz about the centre of mass, in K."""


@dc.dataclass
class Phase:
    """A stretch of the record, in the record's time."""

    label: str = choice("other", PHASE_LABELS)
    """What the knife does."""
    start: float = quantity(0.0, "s", low=-1e9, high=1e11)
    """First time."""
    end: float = quantity(0.0, "s", low=-1e9, high=1e11)
    """Time when the next begins."""

    def check(self, where: str) -> None:
        if self.end <= self.start:
            raise ConfigurationError(
                f"{self.end:.6g} s does not come after start, {self.start:.6g} s",
                field=f"{where}.end",
                fix="Give the time at which the phase ends.",
            )


@dc.dataclass
class NominalMotion:
    """The motion that the knife was told to make."""

    speed: float | None = quantity(None, "m/s", low=1e-5, high=2.0)
    """Speed of the press while slicing."""
    draw_ratio: float | None = quantity(None, "", low=-100.0, high=100.0)
    """Draw over press speed while slicing."""
    phases: list[Phase] = dc.field(default_factory=list)


@dc.dataclass
class WrenchFacts:
    """Meaning of the force and torque columns.

    Attributes:
        includes: Parts of the wrench, of food, board, gravity (the tool's weight) and inertia (of
            the tool).
    """

    sign: str = choice("on_knife", ("on_knife", "by_knife"))
    """on_knife: what food and board do to the knife, upwards when pressed down."""
    frame: str = choice("W", ("W", "K", "S", "F"))
    """Axes of the components: world, knife, sensor or food."""
    point: str = choice("Ko", ("Ko", "So", "unknown"))
    """Point of the torque: knife's or sensor's origin."""
    includes: list[str] = dc.field(default_factory=lambda: ["food", "board"])
    tared: str = choice("unknown", ("yes", "no", "unknown"))
    """Whether the sensor was zeroed in the air."""

    def check(self, where: str) -> None:
        for k, part in enumerate(self.includes):
            if part not in ("food", "board", "gravity", "inertia"):
                raise ConfigurationError(
                    f"{part!r} is not one of food, board, gravity, inertia",
                    field=f"{where}.includes[{k}]",
                    fix="Name the parts of the wrench that the sensor saw.",
                )


@dc.dataclass
class SensorFacts:
    """The wrench sensor, with its frame S fixed to the knife's frame K."""

    name: str = "unknown"
    force_range: float | None = quantity(None, "N", low=0.1, high=1e5)
    """Each force saturates at plus and minus this."""
    torque_range: float | None = quantity(None, "Nm", low=1e-3, high=1e4)
    """Each torque saturates at plus and minus this."""
    force_resolution: float | None = quantity(None, "N", low=0.0, high=50.0)
    """Step of the shown forces."""
    rate: float | None = quantity(None, "Hz", low=0.1, high=1e5)
    """Readings a second."""
    cutoff_frequency: float | None = quantity(None, "Hz", low=1e-2, high=1e5)
    """Low-pass filter inside the sensor; null for none."""
    position: list[float] | None = quantity(None, "m", low=-1.0, high=1.0, size=3)
    """Position of So from Ko, in K."""
    rotation: list[float] | None = quantity(None, "rad", low=-6.3, high=6.3, size=3)
    """Roll, pitch, yaw of S in K."""


@dc.dataclass
class ProcessingStep:
    """One step that made the series what they are, in the order of the list.

    Attributes:
        name: Name of the step, as in `sliceit_drake.records.preprocessing`.
        numbers: What repeats it, SI units.
        note: What else a reader should know.
    """

    name: str = ""
    numbers: dict[str, float] = dc.field(default_factory=dict)
    note: str = ""


@dc.dataclass
class SliceMetadata:
    """The YAML file of a slice record.

    Attributes:
        date: When the slice was cut, as 2026-03-01.
        provenance: Where the numbers come from and how they may be used.
        condition: Records with the same label were nominally the same cut (replicates).
        unknown: Names of fields, such as `food.size`, that are truly not known. A column named
            here, such as `p_WK_z`, is known up to a constant.
        processing: Steps applied to the series.
    """

    name: str = ""
    date: str = ""
    provenance: str = ""
    food: FoodFacts = dc.field(default_factory=FoodFacts)
    board_height: float | None = quantity(None, "m", low=-5.0, high=5.0)
    """Height of the board's surface in W."""
    knife: KnifeFacts = dc.field(default_factory=KnifeFacts)
    tool: ToolFacts = dc.field(default_factory=ToolFacts)
    motion: NominalMotion = dc.field(default_factory=NominalMotion)
    wrench: WrenchFacts = dc.field(default_factory=WrenchFacts)
    sensor: SensorFacts = dc.field(default_factory=SensorFacts)
    slice_index: int = quantity(0, "", low=0, high=10**6)
    """Order in the session, from 0."""
    knife_slices: int | None = quantity(None, "", low=0, high=10**7)
    """Slices cut since the knife was sharpened, before this."""
    condition: str = ""
    unknown: list[str] = dc.field(default_factory=list)
    processing: list[ProcessingStep] = dc.field(default_factory=list)

    def check(self, where: str) -> None:
        previous = -float("inf")
        for k, phase in enumerate(self.motion.phases):
            if phase.start < previous - 1e-9:
                raise ConfigurationError(
                    f"{phase.start:.6g} s is before the end of the last phase, {previous:.6g} s",
                    field=f"{where}.motion.phases[{k}].start",
                    fix="Sort the phases; they must not overlap.",
                )
            previous = phase.end


def slice_name(index: int) -> str:
    """Name of a record by its order in the session."""
    return f"slice_{index:03d}"
