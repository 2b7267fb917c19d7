"""A cutting system or a food of a user's own gives a run with record, picture, replay, summary."""

import json

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, MotionPlan
from sliceit_drake.diagrams.hardware_station import RobotConnection
from sliceit_drake.diagrams.outputs.animation import can_draw
from sliceit_drake.diagrams.outputs.paraview import FoodFrames
from sliceit_drake.diagrams.outputs.slice_record_of_run import slice_record_of
from sliceit_drake.diagrams.run import prepare_run, simulate
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.diagrams.station import MakeStation
from sliceit_drake.hardware.hardware_config import HardwareConfig
from sliceit_drake.stand_in.curve_cutter import CurveCutter, CurveFood
from sliceit_drake.systems.analytic_cutter import AnalyticFood
from sliceit_drake.systems.compliance_controller import ComplianceControllerConfig
from sliceit_drake.systems.cut_report import FoodBodyFrame, FoodPicture
from sliceit_drake.systems.food_look import OTHER
from sliceit_drake.systems.knife_force import KnifeForceSystem

HEIGHT, WIDTH = 0.027, 0.03
CORNERS = WIDTH * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) + [0, 0, HEIGHT]


def scenario() -> Scenario:
    down = ConstantSpeed(distance=0.0372, speed=0.1, acceleration=2.0, label="slice")
    return Scenario(
        name="dough",
        food=AnalyticFood(diameter=HEIGHT),
        controller=ComplianceControllerConfig(
            mode="motion", error_scale=1.0, p_gains=[200.0] * 6, d_gains=[0.0] * 6
        ),
        motion=MotionPlan([down, Hold(duration=0.1)]),
    )


class Dough(KnifeForceSystem):
    """Resists in proportion to the depth, and tells no more than its ports."""

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(scenario.exchange_period)
        self.X_WF = scenario.X_WF()

    def advance(self, context, state, X_WK):
        top = self.X_WF.translation()[2] + HEIGHT
        depth = np.clip(top - X_WK.translation()[2], 0.0, HEIGHT)
        return np.array([0.0, 0.0, 0.0, 0.0, 0.0, 500.0 * depth]), depth / HEIGHT


class TalkingDough(Dough):
    """Tells all that the outputs of a run ask for."""

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(scenario)
        self.DeclareVectorOutputPort("pressure", 2, self._calc)

    def _calc(self, context, output: BasicVector) -> None:
        output.SetFromVector([self.wrench(context)[5] / WIDTH**2, 1.0])

    def recorded(self):
        return {"pressure": ["mean_pressure", "one"]}

    def describe(self):
        return "dough of 500 N/m."

    def summary(self, record):
        return {"peak_pressure_Pa": float(record["mean_pressure"].max())}

    def picture(self, context):
        triangles = CORNERS[[[0, 1, 2], [0, 2, 3]]]
        return FoodPicture(self.X_WF, triangles, np.array([False, True]))

    def body(self, context):
        points = self.X_WF.multiply(CORNERS.T).T
        intact = np.zeros(4)
        return FoodBodyFrame(0, points, points, np.arange(4)[None], intact, intact)


def test_one_that_tells_nothing_gives_record_picture_replay_and_summary(tmp_path):
    run = simulate(scenario(), cutting=Dough)
    summary = run.save(tmp_path)
    names = {file.name for file in tmp_path.iterdir()}
    assert names >= {"record.csv", "summary.json", "force.png", "scenario.yaml", "replay.html"}
    assert summary["peak_force_N"] > 10.0 and summary["cut_progress"] > 0.9
    # What only finite elements have is not made up.
    assert not {"elements", "energy_imbalance_J", "discretization_error"} & set(summary)
    assert run.half_cut.parts == [] and run.contact_margin.food is None
    assert "energy_work" not in run.record().columns
    with pytest.raises(ConfigurationError, match="has no body"):
        FoodFrames(prepare_run(scenario(), cutting=Dough), 30.0)


def test_what_it_tells_stands_in_record_picture_and_summary(tmp_path):
    run = prepare_run(scenario(), cutting=TalkingDough(scenario()), animation=True)
    frames = FoodFrames(run, 30.0)
    run.advance()
    record = run.record()
    force = record["food_wrench_f_z"]
    np.testing.assert_allclose(record["mean_pressure"], force / WIDTH**2)
    assert (record["one"] == 1.0).all()
    assert len(frames) > 5 and frames.bodies[0].points.shape == (4, 3)
    (part,) = run.half_cut.parts
    np.testing.assert_array_equal(part.mesh.colours[[0, 3]], [OTHER.skin, OTHER.flesh])
    (part,) = run.film.frames[-1].parts
    assert part.name == "food" and part.mesh.points.shape == (6, 3)
    run.save(tmp_path)
    assert (tmp_path / "slice.gif").exists() == can_draw()
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert summary["peak_pressure_Pa"] == pytest.approx(force.max() / WIDTH**2)
    assert "dough of 500 N/m." in run.plot().get_supxlabel()


def test_a_food_of_ones_own_says_where_the_knife_starts_and_what_is_cut():
    high = CurveFood("potato", width=0.04, height=0.05)
    station = MakeStation(scenario(), cutting=high)
    assert isinstance(station.cutting, CurveCutter) and station.cutting.food is high
    usual = MakeStation(scenario())
    higher = station.start_pose.translation() - usual.start_pose.translation()
    np.testing.assert_allclose(higher, [0.0, 0.0, 0.05 - HEIGHT], atol=1e-12)


def test_of_a_scenarios_food_that_is_replaced_only_the_geometry_is_made(monkeypatch):
    def fail(*arguments):
        raise AssertionError("what is not cut was prepared")

    for name in ("prepare_cut", "CuttingSolver"):
        monkeypatch.setattr(f"sliceit_drake.diagrams.prepared_food.{name}", fail)
    station = MakeStation(Scenario(), cutting=Dough)
    assert isinstance(station.cutting, Dough) and station.estimate_error is None
    assert RigidTransform.IsExactlyEqualTo(station.cutting.X_WF, Scenario().X_WF())


def test_what_does_not_fit_the_scenario_is_refused():
    other = scenario()
    other.exchange_period = 0.001
    with pytest.raises(ConfigurationError, match="period of the scenario"):
        MakeStation(scenario(), cutting=Dough(other))
    for cutting in (42, lambda _: None):
        with pytest.raises(ConfigurationError, match="Give a subclass of KnifeForceSystem"):
            MakeStation(scenario(), cutting=cutting)
    robot = RobotConnection(client=None, config=HardwareConfig())
    with pytest.raises(ConfigurationError, match="what lies on its board"):
        MakeStation(scenario(), hardware=robot, cutting=Dough)


@pytest.mark.parametrize(
    "found", [(np.zeros(3), 0.0), np.zeros(6), (np.full(6, np.nan), 0.0), (np.zeros(6), 7.0)]
)
def test_a_force_that_is_none_stops_the_run_and_names_the_class(found):
    class Wrong(Dough):
        def advance(self, context, state, X_WK):
            return found

    run = prepare_run(Scenario(), cutting=Wrong)
    with pytest.raises(RuntimeError, match=r"at t = 0\.002 s Wrong\.advance returned"):
        run.advance(0.02)


def test_a_slice_record_does_not_say_that_the_replaced_food_was_cut():
    run = prepare_run(Scenario(), cutting=Dough)
    run.advance(0.02)
    assert slice_record_of(run, "a test").metadata.food.name == "Dough"
