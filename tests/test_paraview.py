"""Series for ParaView have the food's body, the knife and the forces that the record has."""

import dataclasses as dc
import shutil
import xml.etree.ElementTree as ET
from pathlib import Path

import meshio
import numpy as np
import pytest
from split_measures import material_volumes

from sliceit_drake.cli.main import main
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.foods.food import Food, make_food_model
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.mesh.surface import food_body
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.diagrams.outputs.paraview import FoodFrames, write_series
from sliceit_drake.diagrams.run import prepare_run
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.resources import resource_path
from sliceit_drake.tables import read_columns

# So that the plane crosses tetrahedra.
OBLIQUE = "cut_normal: [0.15, 1.0, 0.0], cut_point: [0.0, 0.0007, 0.0]"
SMALL = f"{{food: {{shape: !Cylinder {{rings: 2, layers: [0.0, 0.004, 0.012]}}, {OBLIQUE}}}}}"


def volumes(points: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    x = points[tetrahedra]
    return np.linalg.det(x[:, 1:] - x[:, :1]) / 6.0


@pytest.mark.parametrize(
    ("normal", "point"),
    [([0.0, 1.0, 0.0], 0.0), ([0.15, 1.0, 0.0], 7e-4), ([-0.1, 1.0, 0.2], -2e-3)],
)
def test_a_body_is_as_large_as_the_food_on_each_side_of_the_cut(normal, point):
    shape = Cylinder(rings=3, layers=[0.0, 0.004, 0.012])
    food = Food(shape=shape, cut_normal=normal, cut_point=[0.0, point, 0.0])
    model = make_food_model(food, Knife(), Numerics())
    body, split = food_body(model), model.split
    corners = body.positions(model, model.nodes)
    volume, side = volumes(corners, body.tetrahedra), body.side[body.tetrahedra]
    assert volume.min() > 0.0
    assert (side == side[:, :1]).all()
    material = material_volumes(split)
    for which in (0, 1):
        whole = material[split.node_side[split.tetrahedra[:, 0]] == which].sum()
        assert volume[side[:, 0] == which].sum() == pytest.approx(whole, rel=1e-9)
    # Each cut point is a corner of both sides, at its place.
    for which in (0, 1):
        here = (body.side == which) & (body.cut_point >= 0)
        assert sorted(body.cut_point[here]) == list(range(len(split.points)))
    at = (corners - model.X_FC_position) @ model.X_FC_rotation
    cut = body.cut_point >= 0
    np.testing.assert_allclose(at[cut], split.points[body.cut_point[cut]], atol=1e-12)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A run of 0.95 s, in which the knife enters, with a series of ten frames a second."""
    folder = tmp_path_factory.mktemp("run")
    arguments = ["--duration", "0.95", "--no-replay", "--output", str(folder), "--set", SMALL]
    assert (
        main(["simulate", "cucumber_measured", *arguments, "--paraview", "vtu", "--fps", "10"]) == 0
    )
    return folder


def frames_of(folder: Path) -> tuple[list[float], dict[str, list[meshio.Mesh]]]:
    """Times, and meshes by name, as run.pvd lists them."""
    times: list[float] = []
    meshes: dict[str, list[meshio.Mesh]] = {}
    for entry in ET.parse(folder / "run.pvd").getroot().iter("DataSet"):
        name, time = entry.attrib["name"], float(entry.attrib["timestep"])
        meshes.setdefault(name, []).append(meshio.read(folder / entry.attrib["file"]))
        if name == "food":
            times.append(time)
    return times, meshes


def test_the_series_of_a_run_has_its_body_its_knife_and_its_forces(run):
    times, meshes = frames_of(run / "paraview")
    np.testing.assert_allclose(times, 0.1 * np.arange(10), atol=1e-9)
    food, knife, force = meshes["food"], meshes["knife"], meshes["force"]
    assert len(food) == len(knife) == len(force) == 10
    scenario = load_scenario(run / "scenario.yaml")
    model = make_food_model(scenario.food, scenario.knife, scenario.numerics)
    body, whole = food_body(model), material_volumes(model.split).sum()
    for frame in food:
        assert len(frame.points) == len(body.ends)
        np.testing.assert_array_equal(frame.cells_dict["tetra"], body.tetrahedra)
        volume = volumes(frame.points, frame.cells_dict["tetra"])
        # The knife presses what it touches: nearly incompressible, and not inverted.
        assert volume.min() > 0.0 and volume.sum() == pytest.approx(whole, rel=0.02)
        assert set(np.unique(frame.point_data["side"])) == {0.0, 1.0}
    rest = (
        model.X_FC_position * 0.0 + scenario.X_WF().multiply(body.positions(model, model.nodes).T).T
    )
    np.testing.assert_allclose(food[-1].points - food[-1].point_data["displacement"], rest)
    assert np.abs(food[0].point_data["displacement"]).max() < 1e-5
    assert np.abs(food[-1].point_data["displacement"]).max() > 1e-4
    damage = [frame.point_data["damage"] for frame in food]
    assert damage[0].max() < 1e-9 and damage[-1].max() > 0.9 and damage[-1].min() == 0.0
    assert all(
        (after >= before - 1e-9).all()
        for before, after in zip(damage[:-1], damage[1:], strict=True)
    )
    names = ["time", "food_wrench_f_x", "food_wrench_f_z", "food_wrench_m_y", "sensor_wrench_f_z"]
    names += ["knife_pose_p_x", "knife_pose_p_y", "knife_pose_p_z"]
    record = read_columns(run / "record.csv", names)
    for time, at, blade in zip(times, force, knife, strict=True):
        k = int(np.abs(record["time"] - time).argmin())
        assert record["time"][k] == pytest.approx(time, abs=1e-9)
        food_force, moment = at.point_data["food_force"][0], at.point_data["food_moment"][0]
        sensed = at.point_data["sensor_force"][0]
        for value, name in (
            (food_force[0], "food_wrench_f_x"),
            (food_force[2], "food_wrench_f_z"),
            (moment[1], "food_wrench_m_y"),
            (sensed[2], "sensor_wrench_f_z"),
        ):
            assert value == pytest.approx(record[name][k], rel=1e-6, abs=1e-9)
        place = [record[f"knife_pose_p_{a}"][k] for a in "xyz"]
        np.testing.assert_allclose(at.points[0], place, atol=1e-7)
        # The edge is the blade's lowest part, and Ko on it.
        assert blade.points[:, 2].min() == pytest.approx(place[2], abs=1e-4)
    assert record["food_wrench_f_z"][-1] > 1.0


def test_a_run_is_exported_again_as_it_was(run, capsys):
    assert main(["export", str(run), "--format", "xdmf", "--fps", "10"]) == 0
    printed = capsys.readouterr().out
    assert "10 frames" in printed and "differs" not in printed
    _, meshes = frames_of(run / "paraview")
    for name in ("food", "knife", "force"):
        with meshio.xdmf.TimeSeriesReader(run / "paraview" / f"{name}.xdmf") as reader:
            points, cells = reader.read_points_cells()
            assert reader.num_steps == 10
            for k, mesh in enumerate(meshes[name]):
                time, values, _ = reader.read_data(k)
                assert time == pytest.approx(0.1 * k, abs=1e-9)
                np.testing.assert_array_equal(cells[0].data, mesh.cells[0].data)
                np.testing.assert_allclose(points + values["displacement"], mesh.points)
                for key, value in mesh.point_data.items():
                    np.testing.assert_allclose(values[key], value, atol=1e-15)


def test_a_run_that_is_not_the_records_is_said_to_be_another(run, tmp_path, capsys):
    lines = (run / "record.csv").read_text(encoding="utf-8").splitlines()
    column = lines[0].split(",").index("food_wrench_f_z")
    cells = lines[40].split(",")
    cells[column] = "17.5"
    kept = [lines[0], *lines[1:40], ",".join(cells)]
    (tmp_path / "record.csv").write_text("\n".join(kept) + "\n", encoding="utf-8")
    (tmp_path / "scenario.yaml").write_text((run / "scenario.yaml").read_text(), encoding="utf-8")
    assert main(["export", str(tmp_path), "--fps", "50"]) == 0
    assert "differs from the record by up to 17.5 N" in capsys.readouterr().out
    assert len(list((tmp_path / "paraview").glob("food_*.vtu"))) == 4


def test_what_cannot_be_exported_is_refused(run, tmp_path, capsys):
    own = tmp_path / "own"
    shutil.copytree(run, own)
    (own / "summary.json").write_text('{"own": {"policy": "Gentle"}}', encoding="utf-8")
    assert main(["export", str(own)]) == 2
    assert "the user's own policy, which its folder does not have" in capsys.readouterr().err
    assert main(["export", str(tmp_path)]) == 2
    assert "there is no scenario.yaml" in capsys.readouterr().err
    prepared = prepare_run(load_scenario(resource_path("scenarios/cucumber_spring.yaml")))
    with pytest.raises(ConfigurationError, match="finite elements"):
        FoodFrames(prepared, 30.0)
    with pytest.raises(ConfigurationError, match="--fps"):
        FoodFrames(prepare_run(load_scenario(run / "scenario.yaml")), 0.0)


def test_a_sequence_is_no_xdmf_series(run, tmp_path):
    frames = FoodFrames(prepare_run(load_scenario(run / "scenario.yaml")), 10.0)
    frames.bodies.append(dc.replace(frames.bodies[0], food=1))
    with pytest.raises(ConfigurationError, match="changes from slice to slice"):
        write_series(frames, tmp_path, "xdmf")
