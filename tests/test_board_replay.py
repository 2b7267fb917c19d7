"""The board's law on a replayed knife motion, and the steps that a station needs for it."""

import dataclasses as dc

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sliceit_drake.configuration import ConfigurationError, validate
from sliceit_drake.cutting.board import Board, impact_peak_loss
from sliceit_drake.cutting.foods.food import Food, make_food_model
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, Motion, MotionPlan, Recorded, Retract
from sliceit_drake.cutting.simulate import SliceResult, simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.diagrams.outputs.run_log import Record
from sliceit_drake.diagrams.run import prepare_run
from sliceit_drake.diagrams.scenario import Scenario, load_scenario
from sliceit_drake.diagrams.station import MakeStation
from sliceit_drake.resources import resource_path
from sliceit_drake.systems.analytic_cutter import AnalyticFood

PERIOD = 0.002
DIAMETER = 0.010


def analytic(stiffness: float, time_step: float = 1e-3, speed: float = 0.05) -> Scenario:
    """Cuts an analytic food down to the board, presses 1 mm further and withdraws."""
    scenario = load_scenario(resource_path("scenarios/cucumber_measured.yaml"))
    scenario.food, scenario.measurement = AnalyticFood(diameter=DIAMETER), None
    scenario.start.clearance = 0.002
    scenario.board.stiffness, scenario.robot.plant_time_step = stiffness, time_step
    scenario.motion = MotionPlan(
        [
            ConstantSpeed(distance=DIAMETER + 0.003, speed=speed, acceleration=2.0),
            Hold(duration=0.1),
            Retract(distance=0.01, speed=0.05, acceleration=1.0),
        ]
    )
    return scenario


def replay(scenario: Scenario, record: Record, food: Food, file) -> SliceResult:
    """Drives the knife along the record's poses in F, through a food on the same board."""
    X_FW = scenario.X_WF().inverse()
    R_FW = Rotation.from_matrix(X_FW.rotation().matrix())
    R_WK = Rotation.from_quat(record.vector("knife_pose_quat", "wxyz"), scalar_first=True)
    quaternions = (R_FW * R_WK).as_quat(scalar_first=True)
    positions = X_FW.multiply(record.vector("knife_pose_p").T).T
    header = "time,p_WK_x,p_WK_y,p_WK_z,quat_WK_w,quat_WK_x,quat_WK_y,quat_WK_z"
    rows = np.column_stack([record["time"], positions, quaternions])
    np.savetxt(file, rows, delimiter=",", header=header, comments="", fmt="%.9g")
    plan = MotionPlan([Recorded(file=str(file), placement="world")])
    motion = Motion(plan, plan.segments[0].first_pose())
    model = make_food_model(food, scenario.knife, scenario.numerics)
    board = dc.replace(scenario.board, height=0.0)
    return simulate_slice(CuttingSolver(model, scenario.exchange_period), motion, board)


@pytest.mark.parametrize(
    ("stiffness", "time_step", "speed"), [(1e4, 1e-3, 0.1), (3e4, 1e-3, 0.05), (4e5, 2.5e-4, 0.05)]
)
def test_a_replayed_station_record_has_the_stations_board_force(
    stiffness, time_step, speed, tmp_path
):
    scenario = analytic(stiffness, time_step, speed)
    run = prepare_run(scenario)
    run.advance()
    record = run.record()
    scenario.numerics.time_step = 1e-4
    food = Food(shape=Cylinder(diameter=DIAMETER, rings=2, layers=[0.0, 0.004, 0.012]))
    result = replay(scenario, record, food, tmp_path / "knife.csv")
    # Result k is at the end of coupling step k, record row k at its begin.
    np.testing.assert_allclose(result.time, record["time"][1:], atol=1e-9)
    station, replayed = record["board_wrench_f_z"][1:], result.board_wrench[:, 5]
    peak = station.max()
    touching = station > 0.05 * peak
    assert peak > 5.0 and touching.sum() > 20
    assert replayed.max() == pytest.approx(peak, rel=0.02)
    assert replayed.sum() == pytest.approx(station.sum(), rel=0.01)
    assert np.sqrt(np.mean((replayed - station)[touching] ** 2)) < 0.05 * peak


def test_a_replayed_station_record_has_the_foods_force_as_well(tmp_path):
    overrides = "{food: {shape: !Cylinder {rings: 3, layers: [0.0, 0.004, 0.012]}}}"
    scenario = load_scenario(resource_path("scenarios/cucumber_measured.yaml"), overrides)
    scenario.start.clearance = 0.002
    # A station watches for events in the food more closely than a replay: other sub-steps.
    scenario.numerics.step_by_need = False
    scenario.motion = MotionPlan([ConstantSpeed(distance=0.030, speed=0.05, acceleration=2.0)])
    run = prepare_run(scenario)
    run.advance()
    record = run.record()
    result = replay(scenario, record, scenario.food, tmp_path / "knife.csv")
    # The station holds the mean over a coupling step through the next, and logs before it updates.
    station, replayed = record["food_wrench_f_z"][2:], result.food_wrench[:-1, 5]
    assert station.max() > 10.0
    np.testing.assert_allclose(replayed, station, atol=0.01)
    board, again = record["board_wrench_f_z"][1:], result.board_wrench[:, 5]
    assert again.max() == pytest.approx(board.max(), rel=0.02)
    assert again.sum() == pytest.approx(board.sum(), rel=0.02)


# Steps ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("x", [0.02, 0.1, 0.3])
def test_the_peak_loss_is_that_of_a_mass_on_a_backward_euler_spring(x):
    mass, stiffness = 5.0, 2e5
    h = x * np.sqrt(mass / stiffness)
    forces = []
    for phase in np.linspace(0.0, 1.0, 21)[1:]:  # Where in its first step it touches.
        p, v, peak = -(1.0 - phase) * h, 1.0, 0.0
        while v > 0.0:
            # The whole step ends at p + h v' with m v' = m v - h k max(p + h v', 0).
            new = (v - h * stiffness / mass * p) / (1.0 + x * x)
            v = new if p + h * new > 0.0 else v
            p += h * v
            peak = max(peak, stiffness * p)
        forces.append(peak)
    free = np.sqrt(stiffness * mass)
    loss = 1.0 - np.mean(forces) / free
    assert loss == pytest.approx(impact_peak_loss(stiffness, mass, h), rel=0.1)


def test_a_board_too_stiff_for_the_plants_step_is_refused_with_a_step_that_does():
    pattern = r"scenario\.board\.stiffness: .* too stiff .*plant_time_step 0\.000181818 s or less"
    with pytest.raises(ConfigurationError, match=pattern) as refused:
        MakeStation(analytic(1e6))
    assert 0.04 < MakeStation(analytic(1e6, PERIOD / 11)).board_peak_loss <= 0.05
    stiffness = float(refused.value.fix.split("at most ")[1].split(" N")[0])
    assert 0.04 < MakeStation(analytic(stiffness)).board_peak_loss <= 0.05


def test_a_board_without_a_thickness_is_refused():
    with pytest.raises(ConfigurationError, match=r"board\.size: has 2 values\. Give 3"):
        validate(Board(size=[0.3, 0.2]), "board")
