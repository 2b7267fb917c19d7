"""docs/results/benchmarks.md says what the benchmarks wrote, and where they wrote nothing."""

import json
import shutil
from pathlib import Path

import pytest

from studies.project import aims

ROOT = Path(__file__).resolve().parent.parent
SOURCES = (
    "results/speed.md",
    "explanation/calibration.md",
    "results/verification.json",
    "results/hidden_effects.json",
)


@pytest.fixture
def docs(tmp_path):
    (tmp_path / "explanation").mkdir()
    (tmp_path / "results" / "benchmarks").mkdir(parents=True)
    for name in (*SOURCES, "results/random_slices.md"):
        shutil.copy(ROOT / "docs" / name, tmp_path / name)
    return tmp_path / "results"


def write(docs: Path, name: str, **values: float) -> None:
    facts = {"command": "python", "machine": "2 cores", "values": values}
    (docs / "benchmarks" / f"{name}.json").write_text(json.dumps(facts), encoding="utf-8")


def line(text: str, begin: str) -> str:
    (found,) = (row for row in text.splitlines() if row.startswith(f"| {begin}"))
    return found


def test_the_page_is_what_its_command_makes():
    page = (ROOT / "docs/results/benchmarks.md").read_text(encoding="utf-8")
    assert page == aims.page(), "python -m studies aims"


def test_where_nothing_was_measured_the_page_says_so_and_names_the_command(tmp_path):
    text = aims.page(tmp_path)
    rows = [row for row in text.splitlines() if row.startswith("| ") and "`" in row]
    assert len(rows) > 12
    assert all("not measured | - | `" in row for row in rows)
    assert "reached" not in "".join(rows)


@pytest.mark.parametrize(
    ("name", "values", "begin", "limit"),
    [
        ("station_speed", {"spring_real_time_factor": 9.0}, "station", ("real_time_factor", -4.0)),
        (
            "first_run",
            {"second_picture_s": 9.0, "install_s": 60.0},
            "from",
            ("first_picture_s", 60),
        ),
        ("diagnosis_speed", {"records": 18.0, "warm_s": 1.0}, "diagnosis of", ("cold_s", 90.0)),
        ("diagnosis_speed", {"records": 18.0, "cold_s": 1.0}, "the same again,", ("warm_s", 15.0)),
        (
            "learning_speed",
            {"spring_2_decisions_a_second": 1.0},
            "80,000",
            ("cutting_2_decisions_a_second", -80_000 / 1200),
        ),
        (
            "learning_speed",
            {"spring_2_decisions_a_second": 130.0},
            "the same against",
            ("cutting_2_decisions_a_second", -100.0),
        ),
    ],
)
def test_a_new_value_comes_onto_the_page_and_is_judged(docs, name, values, begin, limit):
    key, bound = limit
    verdicts = []
    for factor in (0.99, 1.01):
        write(docs, name, **values, **{key: abs(bound) * factor})
        row = line(aims.page(docs), begin)
        assert f"[{name}.json](benchmarks/{name}.json)" in row
        verdicts.append("reached" if "| reached |" in row else "missed")
        assert ("**missed**" in row) == (verdicts[-1] == "missed")
    wanted = ["missed", "reached"] if bound < 0 else ["reached", "missed"]
    assert verdicts == wanted


def test_too_few_tetrahedra_or_records_do_not_count(docs):
    values = dict(sub_step_us=10.0, slice_s=0.05, mesh_error=0.01, step_error=0.001)
    search = dict(search_slice_s=0.04, search_step_error=0.002, gradient_slices=3.0)
    for tetrahedra, verdict in ((1199.0, "**missed**"), (1200.0, "reached")):
        write(docs, "cutting_speed", tetrahedra=tetrahedra, **values, **search)
        assert f"| {verdict} |" in line(aims.page(docs), "27 mm of cucumber")
    write(docs, "diagnosis_speed", records=17.0, cold_s=1.0, warm_s=1.0)
    assert "**missed**" in line(aims.page(docs), "diagnosis of 18")


def test_numbers_of_pages_are_found_where_they_stand_now(docs):
    text = aims.page(docs)
    for begin in ("27 mm", "a sub-step", "gradient", "station", "calibrating tomato", "200 random"):
        assert "not measured" not in line(text, begin), begin
