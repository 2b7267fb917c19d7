"""Trained policies cut foods by a law of the diagnosis' benches, which no policy was chosen by.

The law is `slice_push`: fracture work per area, a spring before it, flanks that rub. Its constants
are drawn from the seed for each food, the slices of a food differ as those of the curves world do,
and board, robot, sensor and places are as in the other worlds of `sliceit evaluate`. Writes a line
for each slice to --output, as that does, and goes on where it is.
"""

import argparse
import copy
import dataclasses as dc
import zlib
from pathlib import Path

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, State

from sliceit_drake.cli.evaluate import cut_and_print
from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.learning.unseen_worlds import Case, cases_of, cut
from sliceit_drake.stand_in.curve_cutter import edge_over_middle
from sliceit_drake.stand_in.protocol import Condition, Specimen
from sliceit_drake.stand_in.slicing_worlds import SLICING_FOODS, SlicingWorld, slice_size
from sliceit_drake.systems.knife_force import CuttingSetup, KnifeForceSystem
from studies.benches.law_world import Cut
from studies.benches.section import Section
from studies.benches.slice_push import SlicePush

__all__ = ["ForeignCutter", "ForeignFood", "ForeignWorld", "add_arguments", "run"]

WORLD = "slice_push"


class _Kept:
    """A cut as a value of a context: copies share the section and the law, which never change."""

    def __init__(self, cut: Cut | None = None) -> None:
        self.cut = cut

    def __deepcopy__(self, memo: dict[int, object]) -> "_Kept":
        cut = copy.copy(self.cut)
        for name, value in vars(cut).items() if cut is not None else ():
            if name not in ("section", "law"):
                setattr(cut, name, copy.deepcopy(value, memo))
        return _Kept(cut)


@dc.dataclass
class ForeignFood:
    """A round food on the board that is cut by a law.

    Attributes:
        law: Its constants.
        diameter: Metres.
        toughness, friction: Factors of this slice.
    """

    law: SlicePush
    diameter: float
    toughness: float = 1.0
    friction: float = 1.0

    @property
    def height(self) -> float:
        """From the board to the top, metres."""
        return self.diameter

    def make_cutting(self, setup: CuttingSetup) -> "ForeignCutter":
        """The system that this food is in a station."""
        return ForeignCutter(self, setup.X_WF(), setup.exchange_period)


class ForeignCutter(KnifeForceSystem):
    """The knife in a food that is cut by a law; see `KnifeForceSystem`.

    The law sees the edge where it is over the middle of the food. Its force on the edge acts at the
    middle of the section there, that on the flanks half way up to the food's top.

    Args:
        food: The food.
        X_WF: Pose of the food frame: the food stands at its origin, the edge is along Fx.
        exchange_period: Duration of a coupling step, s.
    """

    def __init__(self, food: ForeignFood, X_WF: RigidTransform, exchange_period: float) -> None:
        super().__init__(exchange_period)
        self.food, self._X_FW = food, X_WF.inverse()
        self._section = Section(food.diameter, food.diameter, is_round=True)
        self._cut = self.DeclareAbstractState(Value(_Kept()))
        self._deepest = self.DeclareDiscreteState([food.height])

    def start(self, context: Context, state: State, X_WK: RigidTransform) -> None:
        food, (x, _, z) = self.food, self._edge(X_WK)
        specimen = Specimen(0, Condition(), toughness=food.toughness, friction=food.friction)
        begun = food.law.begin(self._section, specimen, x, z)
        state.get_mutable_abstract_state(int(self._cut)).set_value(_Kept(begun))
        self._set(state, int(self._deepest), [food.height])

    def advance(
        self, context: Context, state: State, X_WK: RigidTransform
    ) -> tuple[np.ndarray, float]:
        x, y, z = self._edge(X_WK)
        kept = copy.deepcopy(context.get_abstract_state(int(self._cut)).get_value())
        forces = kept.cut.advance(self.exchange_period, x, z, 1.0, 1.0)
        state.get_mutable_abstract_state(int(self._cut)).set_value(kept)
        deepest = min(float(context.get_discrete_state(self._deepest).value()[0]), z)
        self._set(state, int(self._deepest), [deepest])
        p_FKo = (self._X_FW @ X_WK).translation()
        arm = np.array([kept.cut.middle, y, z]) - p_FKo
        raised = arm + [0.0, 0.0, 0.5 * max(self.food.height - z, 0.0)]
        moment = np.cross(arm, forces[0]) + np.cross(raised, forces[1] + forces[2])
        R_WF = self._X_FW.rotation().matrix().T
        wrench = np.concatenate([R_WF @ moment, R_WF @ forces.sum(0)])
        return wrench, self._section.above(deepest) / self._section.area

    def _edge(self, X_WK: RigidTransform) -> tuple[float, float, float]:
        """Where Ko is along the edge, and where the edge is over the middle of the food, in F."""
        X_FK = self._X_FW @ X_WK
        place, _ = edge_over_middle(X_FK.translation(), X_FK.rotation().matrix()[:, 0])
        x, y, z = place.tolist()
        return x, y, z


@dc.dataclass
class ForeignWorld(SlicingWorld):
    """Foods that are cut by a law of the benches."""

    name = WORLD

    def _cut(
        self, scenario: Scenario, calibrated: CalibratedFood, rng: np.random.Generator
    ) -> ForeignFood:
        diameter, (tough, rub) = slice_size(calibrated, rng)
        of_food = [self.seed, *(zlib.crc32(t.encode()) for t in (self.name, calibrated.food.name))]
        law = SlicePush.drawn(np.random.default_rng(of_food))
        return ForeignFood(law, diameter, tough, rub)


def _cut_case(case: Case) -> dict:
    return cut(case, ForeignWorld(case.seed))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("policies", nargs="+", metavar="POLICY", type=Path, help="of a training")
    parser.add_argument("--seed", type=int, default=0, help="of law and slices; 0")
    parser.add_argument("--slices", type=int, help="of each food; as many as the paper's")
    parser.add_argument("--workers", type=int, default=2, help="processes; 2")
    parser.add_argument(
        "--output", metavar="FILE", type=Path, required=True, help=".jsonl file of slices"
    )


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    cases = cases_of(options.policies, [WORLD], SLICING_FOODS, [3e4], options.seed, options.slices)
    cut_and_print(cases, options.output, options.workers, _cut_case)
    return 0
