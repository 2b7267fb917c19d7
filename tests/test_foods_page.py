"""Foods and knives in docs: the tables are those of the files, and what to write can be used."""

import re
from pathlib import Path

import pytest

from sliceit_drake.calibration.setup import load_setup
from sliceit_drake.cutting.foods.food import make_food_model
from sliceit_drake.cutting.knife import load_knife
from sliceit_drake.diagrams.scenario import load_scenario
from studies.marked_page import Place
from studies.physics.foods_page import foods_table, knives_table

ROOT = Path(__file__).resolve().parent.parent
PAGE, TUTORIAL = (
    (ROOT / "docs" / name).read_text(encoding="utf-8")
    for name in ("reference/foods.md", "tutorials/food_of_your_own.md")
)


@pytest.mark.parametrize("name", ["foods", "knives"])
def test_tables_are_made_from_the_files_of_foods_and_knives(name):
    table = {"foods": foods_table, "knives": knives_table}[name]()
    command = "python -m studies foods_page --output docs/reference/foods.md"
    assert Place(name).put(PAGE, table, "docs/reference/foods.md") == PAGE, command


def test_what_the_pages_say_to_write_is_a_food_a_knife_and_a_setup(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for kind, text in re.findall(r"```(python|yaml)\n(.*?)```", PAGE + TUTORIAL, re.DOTALL):
        if kind == "python":
            exec(text, {})
        else:
            (tmp_path / text.split()[1]).write_text(text, encoding="utf-8")
    names = {file.name for file in tmp_path.iterdir()}
    assert names == {"knife.yaml", "radish.vtk", "radish.yaml", "radish_setup.yaml"}
    monkeypatch.chdir(ROOT)  # The mesh lies beside the files that name it.
    scenario = load_scenario(tmp_path / "radish.yaml")
    model = make_food_model(scenario.food, scenario.knife, scenario.numerics)
    press = scenario.motion.segments[0].distance
    assert press > model.top + scenario.start.clearance
    assert scenario.knife == load_knife("nakiri").knife
    assert load_setup(tmp_path / "radish_setup.yaml").food.material == scenario.food.material
    assert load_knife(tmp_path / "knife.yaml").knife.length == 0.18
