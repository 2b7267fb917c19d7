"""The slices of a protocol on a station, simulated or real: cut in random order, and recorded."""

import copy
import dataclasses as dc
import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sliceit_drake.diagrams.outputs.slice_record_of_run import slice_record_of
from sliceit_drake.diagrams.run import Run, prepare_run
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.output_folder import unused
from sliceit_drake.records.metadata import slice_name
from sliceit_drake.records.slice_record import write_record
from sliceit_drake.robot_run.operated_robot import OperatedRobot
from sliceit_drake.stand_in.protocol import (
    Condition,
    Protocol,
    Specimen,
    scenario_of_cut,
    schedule,
)
from sliceit_drake.stand_in.session import is_recorded
from sliceit_drake.systems.analytic_cutter import AnalyticFood

__all__ = ["Collection"]


@dc.dataclass
class Collection:
    """A protocol that is cut on one station; what is recorded already is not cut again.

    Attributes:
        protocol: What is cut.
        station: Whose robot, controller, sensor and numerics are used.
        directory: Folder of the records, and on a robot of each slice's outputs.
        seed: Seed of the order and of the simulated variation.
        robot: The robot; None for the simulated station.
        move_to_start: Whether the knife goes to the slice's start before each slice.
        touch: Whether the bare knife finds the board before the first slice.
        put_fresh_food: Renews the food of an emulated robot; None where somebody does that.
    """

    protocol: Protocol
    station: Scenario
    directory: Path
    seed: int = 0
    robot: OperatedRobot | None = None
    move_to_start: bool = False
    touch: bool = False
    put_fresh_food: Callable[[Scenario], None] | None = None

    def cut(self, first: int | None = None) -> bool:
        """Cuts the first slices, or all, and records each; on a robot a dry run ends at the first.

        Returns:
            False if the robot was not ready, the operator did not confirm, or a slice ended early.
        """
        specimens = schedule(self.protocol, np.random.default_rng([self.seed, 0]))[:first]
        left = [specimen for specimen in specimens if not is_recorded(specimen, self.directory)]
        is_dry = self.robot is not None and self.robot.dry_run
        if self.robot is not None and self.touch and left and not is_dry:
            scenario = scenario_of_cut(self.protocol, left[0], self.station)
            if not self._find_board(self.robot, scenario):
                return False
        for specimen in left:
            scenario = scenario_of_cut(self.protocol, specimen, self.station)
            print(f"Slice {specimen.index + 1} of {len(specimens)}: {specimen.condition.label}")
            if self.robot is not None:
                made = self._cut_on_robot(self.robot, scenario, specimen)
            else:
                made = prepare_run(scenario)
                made.advance()
                self._write(specimen, made)
            if made is None:
                return False
            if is_dry:
                return not made.stopped
            if made.stopped:
                print(f"Stopped: {made.stopped}. Its record is kept. Start again to go on.")
                return False
        print(f"{len(specimens)} records in {self.directory}/")
        return True

    def _find_board(self, robot: OperatedRobot, scenario: Scenario) -> bool:
        """Finds the board's height on the bare board; the robot's file then has it."""
        if self.move_to_start and not robot.move_to_start(copy.deepcopy(scenario)):
            return False
        print("First the knife looks for the board. Take everything off it. Stand back.")
        if self.put_fresh_food is not None:
            bare = copy.deepcopy(scenario)
            bare.food = AnalyticFood(toughness=0.0)
            self.put_fresh_food(bare)
        return robot.find_board(scenario)

    def _cut_on_robot(
        self, robot: OperatedRobot, scenario: Scenario, specimen: Specimen
    ) -> Run | None:
        """The run; None if the robot was not ready or the operator did not confirm."""
        # Away from the last slice, before somebody reaches there.
        if self.move_to_start and not robot.dry_run:
            if not robot.move_to_start(copy.deepcopy(scenario)):
                return None
        print(f"Put under the knife: {_what(specimen.condition)}. Stand back.")
        if self.put_fresh_food is not None and not robot.dry_run:
            self.put_fresh_food(scenario)
        return robot.run(
            scenario,
            self.directory / slice_name(specimen.index),
            keep=functools.partial(self._write, specimen),
        )

    def _write(self, specimen: Specimen, made: Run) -> None:
        is_real = self.robot is not None
        provenance = "UR5e through RTDE." if is_real else "Simulated station, sliceit collect."
        record = slice_record_of(
            made, provenance, index=specimen.index, condition=specimen.condition.label
        )
        file = self.directory / slice_name(specimen.index)
        if made.stopped:
            # A slice that ended early does not count as cut; several may.
            file = unused(self.directory / f"{file.name}_stopped", ".csv", ".yaml")
        write_record(record, file)


def _what(condition: Condition) -> str:
    """What an operator puts under the knife."""
    what = "nothing, the bare board" if condition.without_food else "a fresh piece of food"
    extra = [" peeled"] * condition.peeled
    extra += [f" scaled by {condition.width_scale:g} in width"] * (condition.width_scale != 1.0)
    extra += [f" with {condition.weight:g} kg hung on the knife"] * (condition.weight > 0.0)
    return f"{what}{','.join(extra)}"
