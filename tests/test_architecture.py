"""docs/explanation/architecture.md names what there is; its picture is drawn from the imports."""

import re
from pathlib import Path

from studies.project.architecture import draw, layers, needless, uses

ROOT = Path(__file__).resolve().parent.parent
PAGE = (ROOT / "docs/explanation/architecture.md").read_text(encoding="utf-8")


def test_the_page_tells_every_folder_in_a_sentence():
    folders = {f.parent.name for f in (ROOT / "sliceit_drake").glob("*/__init__.py")} | {"studies"}
    assert set(re.findall(r"^\| `(\w+)` \|", PAGE, re.M)) == folders
    assert {folder for row in layers() for folder in row} == folders


def test_the_modules_that_the_walks_pass_are_there():
    named = re.findall(r"`([a-z_]+/[a-z_/]*?(?:\.py)?)`", PAGE)
    for name in named:
        folders = [ROOT / "sliceit_drake", *(ROOT / "sliceit_drake").iterdir()]
        assert any((folder / name).exists() for folder in folders), name
    for walk in PAGE.split("## ")[1:]:
        assert 10 < len(re.findall(r"^\d+\. ", walk, re.M)) <= 20


def test_the_picture_leaves_out_what_longer_paths_of_arrows_say(tmp_path):
    found = {("a", "b"): 1, ("b", "c"): 2, ("a", "c"): 3, ("b", "d"): 1}
    assert needless(found) == {("a", "c")}
    assert ("calibration", "prediction") in uses(layers())
    draw(tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 10_000
