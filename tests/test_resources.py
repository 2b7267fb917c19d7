"""Files that ship with the project are found in a checkout and in a wheel, and fail clearly."""

import importlib.util
import shutil
from pathlib import Path

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from sliceit_drake import resources

ROOT = Path(__file__).resolve().parent.parent


def test_a_model_of_the_checkout_is_found():
    assert resources.resource_path("models/ur5e/ur5e.urdf") == ROOT / "models/ur5e/ur5e.urdf"


def test_a_wheel_reads_its_own_copy_and_not_a_neighbour_of_the_package(tmp_path, monkeypatch):
    package = tmp_path / "sliceit_drake"
    for models in (package / "_resources" / "models", tmp_path / "models"):
        models.mkdir(parents=True)
        shutil.copy(ROOT / "models" / "package.xml", models)
    monkeypatch.setattr(resources, "_PACKAGE", package)
    found = resources.resource_path("models/package.xml")
    assert found == package / "_resources" / "models" / "package.xml"


def test_an_installation_without_models_says_where_it_looked(tmp_path, monkeypatch):
    (tmp_path / "models").mkdir()  # Of another package.
    monkeypatch.setattr(resources, "_PACKAGE", tmp_path / "sliceit_drake")
    with pytest.raises(FileNotFoundError, match=r"_resources.*\(wheel\).*\(checkout\).*Install"):
        resources.resource_path("models/package.xml")


def test_a_missing_file_is_named():
    with pytest.raises(FileNotFoundError, match=r"no .*models/ur5e/ur5.urdf. Check the spelling"):
        resources.resource_path("models/ur5e/ur5.urdf")


@pytest.mark.parametrize("path", ["", "tests/test_resources.py", "models/../tests", "/models/x"])
def test_paths_outside_the_shipped_folders_are_refused(path):
    with pytest.raises(ValueError, match="begins with one of calibration, hardware, models"):
        resources.resource_path(path)


def test_a_file_here_goes_before_one_of_the_same_path_that_ships(tmp_path, monkeypatch):
    path = "scenarios/cucumber_measured.yaml"
    monkeypatch.chdir(tmp_path)
    assert resources.file_or_resource(path) == ROOT / path
    (tmp_path / "scenarios").mkdir()
    (tmp_path / path).touch()
    assert resources.file_or_resource(path) == Path(path)


@pytest.mark.parametrize("path", ["", "scenarios", "scenarios/none.yaml", "elsewhere.yaml"])
def test_where_there_is_no_file_there_is_none(path):
    assert resources.file_or_resource(path) is None


def test_package_uris_load_through_drake_and_the_map_may_be_added_twice():
    plant = MultibodyPlant(1e-3)
    parser = Parser(plant)
    resources.add_package_map(parser)
    resources.add_package_map(parser)
    parser.AddModelsFromUrl("package://sliceit_drake_models/ur5e/ur5e.urdf")
    assert plant.HasModelInstanceNamed("ur5e")


def test_the_committed_meshes_are_those_that_the_script_draws():
    spec = importlib.util.spec_from_file_location("make_meshes", ROOT / "models/make_meshes.py")
    make_meshes = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(make_meshes)
    for name, build in make_meshes.MESHES.items():
        drawn = make_meshes.gltf(build())
        committed = make_meshes.json.loads((ROOT / "models" / f"{name}.gltf").read_text())
        assert drawn["materials"] == committed["materials"], name
        for ours, theirs in zip(drawn["accessors"], committed["accessors"], strict=True):
            assert ours["count"] == theirs["count"], name
            for limit in set(ours) & {"min", "max"}:
                np.testing.assert_allclose(ours[limit], theirs[limit], atol=1e-6, err_msg=name)
