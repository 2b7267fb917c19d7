"""The runs of the study: which effects are hidden, how strong, in which protocol, by which seed.

All follows from one seed. Kinds and effects alternate, so that any first part of the list says
something of all.
"""

import dataclasses as dc
import hashlib
from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np

from sliceit_drake.stand_in.effect_registry import EFFECTS
from studies.hidden_effects.truth import BASE_OF, CAUSE_OF, UNKNOWN

__all__ = ["KINDS", "PAIRS", "Case", "Hidden", "SizeOf", "make_cases"]

KINDS: dict[str, int] = {
    "single": 210,
    "nothing": 201,
    "unknown": 60,
    "pairs": 40,
    "poor": 60,
    "base": 12,
    "curve": 40,
}
"""Kinds of runs, and the least number of each."""

STRENGTHS = (2.0, 3.0)
"""Range of what is drawn for delta."""

PAIRS: tuple[tuple[str, str, str], ...] = (
    ("rich", "skin", "sensor_tilt"),
    ("full", "bulk_relaxation", "board_height"),
    ("rich", "rate_toughness", "sensor_tilt"),
    ("full", "arm_compliance", "blunt_edge"),
    ("rich", "flank_adhesion", "drive_vibration"),
    ("full", "dulling_edge", "sensor_drift"),
    ("rich", "holder_compliance", "section_shape"),
    ("full", "stick_slip", "rate_toughness"),
    ("rich", "food_slip", "bulk_relaxation"),
    ("full", "sensor_drift", "slice_push_law"),
    ("rich", "board_height", "core"),
)
"""Effects that are hidden together, fixed before any was diagnosed: families and phases differ, and
none is of a class with the other by docs/results/identifiability.md (all at 20 degrees or more)."""

CURVE_EFFECTS = ("skin", "rate_toughness", "sensor_delay", "board_height", "flank_adhesion")
CURVE_DELTAS = (0.5, 1.0, 2.0, 4.0)
BASE_LEFT = 0.5
"""Greatest strength of what a refit leaves of a shift of a base parameter: a refit takes up small
ones, and of larger ones what is not linear is left."""
BASE_RANGE = (0.5, 1.0)
"""Sizes of such shifts, of the size of that strength or, if less, of twice the typical one."""

RICH_AND_FULL = ("rich", "full")


@dc.dataclass(frozen=True)
class Hidden:
    """An effect at a size; `delta` is its strength, None for a shift of a base parameter."""

    effect: str
    size: float
    delta: float | None

    @property
    def text(self) -> str:
        """As `make_effect` takes it."""
        return f"{self.effect}:{self.size!r}"


@dc.dataclass(frozen=True)
class Case:
    """A run.

    Attributes:
        name: That tells nothing.
        kind: One of `KINDS`.
        protocol: Name.
        hidden: Effects.
        seed: Of the session.
    """

    name: str
    kind: str
    protocol: str
    hidden: tuple[Hidden, ...]
    seed: int

    @classmethod
    def of(cls, facts: Mapping[str, object]) -> "Case":
        """From plain values."""
        values = dict(facts)
        hidden = values.pop("hidden")
        assert isinstance(hidden, list)
        return cls(hidden=tuple(Hidden(**h) for h in hidden), **values)  # type: ignore[arg-type]


SizeOf = Callable[[str, str, float], float | None]
"""Size of an effect in a protocol at a strength, or None."""


def make_cases(
    size_of: SizeOf,
    poor_effects: Sequence[str],
    seed: int = 0,
    kinds: Sequence[str] = tuple(KINDS),
    counts: Mapping[str, int] | None = None,
    protocols: Sequence[str] = ("rich", "full", "poor"),
    effects: Sequence[str] | None = None,
) -> list[Case]:
    """The list of runs.

    Args:
        size_of: Finds sizes.
        poor_effects: Effects whose cause is of a class with others in the poor protocol.
        seed: All follows from it.
        kinds: Which kinds.
        counts: Of each kind, other than `KINDS`.
        protocols: Which may be used; a kind that has none of its own among them is left out.
        effects: Which may be hidden; all by default. Only their sizes are asked for.
    """
    maker = _Maker(size_of, seed, protocols, EFFECTS if effects is None else effects)
    of_kind = {
        "single": maker.single,
        "nothing": maker.nothing,
        "unknown": maker.unknown,
        "pairs": maker.pairs,
        "poor": lambda n: maker.poor(poor_effects, n),
        "base": maker.base,
        "curve": maker.curve,
    }
    placed: list[tuple[float, int, Case]] = []
    for rank, kind in enumerate(kinds):
        cases = of_kind[kind]((counts or KINDS)[kind])
        placed += [((k + 0.5) / len(cases), rank, case) for k, case in enumerate(cases)]
    return [case for _, _, case in sorted(placed, key=lambda entry: entry[:2])]


class _Maker:
    def __init__(
        self, size_of: SizeOf, seed: int, protocols: Sequence[str], effects: Collection[str]
    ) -> None:
        self.size_of, self.seed = size_of, seed
        self.protocols, self.effects = protocols, effects

    def _visible(
        self, effects: Sequence[str], wanted: Sequence[str]
    ) -> list[tuple[str, list[str]]]:
        """Effects that can reach the least strength, and in which protocols."""
        protocols = [p for p in wanted if p in self.protocols]
        out = []
        for effect in (e for e in effects if e in self.effects):
            where = [p for p in protocols if self.size_of(p, effect, STRENGTHS[0]) is not None]
            if where:
                out.append((effect, where))
        return out

    def _case(
        self,
        kind: str,
        number: int,
        protocol: str,
        effects: Sequence[str],
        delta: float | None = None,
    ) -> Case:
        digest = hashlib.sha256(f"{self.seed} {kind} {number}".encode()).hexdigest()
        rng = np.random.default_rng(int(digest[:15], 16))
        hidden = tuple(self._hidden(protocol, effect, delta, rng) for effect in effects)
        return Case(digest[-10:], kind, protocol, hidden, int(rng.integers(1, 2**31)))

    def _hidden(
        self, protocol: str, effect: str, delta: float | None, rng: np.random.Generator
    ) -> Hidden:
        if effect in BASE_OF:
            largest = 2.0 * EFFECTS[effect].typical
            linear = self.size_of(protocol, effect, BASE_LEFT)
            largest = largest if linear is None else min(largest, linear)
            return Hidden(effect, largest * float(rng.uniform(*BASE_RANGE)), None)
        wanted = float(rng.uniform(*STRENGTHS)) if delta is None else delta
        size = self.size_of(protocol, effect, wanted)
        while size is None and delta is None and wanted > STRENGTHS[0]:
            # Stronger than any sensible size: drawn from what there is.
            wanted = max(STRENGTHS[0], wanted - 0.1)
            size = self.size_of(protocol, effect, wanted)
        assert size is not None
        return Hidden(effect, size, wanted)

    def listed(self, kind: str, visible: Sequence[tuple[str, list[str]]], count: int) -> list[Case]:
        """Effects in turn, two rounds in the first protocol that shows them and one in the next."""
        out: list[Case] = []
        rounds = -(-count // max(len(visible), 1))
        for turn in range(rounds):
            for effect, where in visible:
                protocol = where[min(turn % 3 // 2, len(where) - 1)]
                out.append(self._case(kind, len(out), protocol, [effect]))
        return out

    def single(self, count: int) -> list[Case]:
        return self.listed("single", self._visible(list(CAUSE_OF), RICH_AND_FULL), count)

    def poor(self, effects: Sequence[str], count: int) -> list[Case]:
        return self.listed("poor", self._visible(effects, ("poor",)), count)

    def unknown(self, count: int) -> list[Case]:
        return self.listed("unknown", self._visible(UNKNOWN, RICH_AND_FULL), count)

    def base(self, count: int) -> list[Case]:
        where = [p for p in ("rich",) if p in self.protocols]
        return self.listed(
            "base", [(e, where) for e in BASE_OF if where and e in self.effects], count
        )

    def nothing(self, count: int) -> list[Case]:
        names = self.protocols
        return [self._case("nothing", k, names[k % len(names)], ()) for k in range(count)]

    def pairs(self, count: int) -> list[Case]:
        possible = [
            pair
            for pair in PAIRS
            if pair[0] in self.protocols
            and set(pair[1:]) <= set(self.effects)
            and all(self.size_of(pair[0], effect, STRENGTHS[0]) is not None for effect in pair[1:])
        ]
        return [
            self._case("pairs", k, possible[k % len(possible)][0], possible[k % len(possible)][1:])
            for k in range(count if possible else 0)
        ]

    def curve(self, count: int) -> list[Case]:
        grid = [
            (effect, delta)
            for delta in CURVE_DELTAS
            for effect in CURVE_EFFECTS
            if "rich" in self.protocols
            and effect in self.effects
            and self.size_of("rich", effect, delta) is not None
        ]
        return [
            self._case("curve", k, "rich", [grid[k % len(grid)][0]], grid[k % len(grid)][1])
            for k in range(count if grid else 0)
        ]
