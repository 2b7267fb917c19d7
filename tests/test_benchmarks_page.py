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
    "results/benches_report.jsonl",
    "results/contact.md",
    "results/coverage.md",
    "results/data/contact.json",
    "results/data/endurance.json",
    "results/data/policy_and_motion.json",
    "results/hidden_effects.json",
    "results/robot_faults.md",
    "results/stepping.md",
    "results/verification.json",
)

CALIBRATION = "../explanation/calibration.md"
STEP = "error of the sub-step, "
CALIBRATE = "`sliceit calibrate`, "
CORRECTIONS = "contact force, corrections of a rule over the optimised motion: "


@pytest.fixture
def docs(tmp_path):
    (tmp_path / "explanation").mkdir()
    for folder in ("benchmarks", "data"):
        (tmp_path / "results" / folder).mkdir(parents=True)
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


def test_each_table_with_a_miss_says_why():
    sections = (ROOT / "docs/results/benchmarks.md").read_text(encoding="utf-8").split("\n## ")
    for section in sections[1:]:
        assert ("*Why missed*" in section) == ("| **missed** |" in section), section[:40]


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
            "the same against the spring",
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
    names = ("cutting_speed", "diagnosis_speed", "first_run", "learning_speed", "station_speed")
    for name in names:
        shutil.copy(ROOT / f"docs/results/benchmarks/{name}.json", docs / "benchmarks")
    for name in ("slicing_results.json", "corrected_results.json"):
        shutil.copy(ROOT / "docs/results" / name, docs)
    rows = [row for row in aims.page(docs).splitlines() if "not measured | - |" in row]
    (soak,) = rows
    assert "for an hour, killed at random" in soak


@pytest.mark.parametrize(
    ("name", "old", "new", "begin"),
    [
        ("stepping.md", "0.48 % (1.4 %)", "0.51 % (1.4 %)", STEP + "press and draw, 20"),
        ("stepping.md", "1.07 % (6.2 %)", "1.07 % (10.2 %)", STEP + "turning"),
        ("stepping.md", "0.001 | 0.34 |", "0.001 | 1.51 |", "the same in the station"),
        ("data/contact.json", "+1.7 % (", "-2.1 % (", "largest change of the force"),
        ("data/contact.json", "-1.4 % (", "-2.1 % (", "largest change of the force"),
        ("speed.md", "0.073 | 0.042 |", "0.073 | 0.051 |", "a cut of a batch"),
        ("coverage.md", "**85.7 %**", "**84.9 %**", "90 % intervals"),
        ("robot_faults.md", "101 of 101 faults", "100 of 101 faults", "faults that leave"),
        ("robot_faults.md", "0 of 200 slices", "0 of 199 slices", "slices without"),
        ("data/endurance.json", '"slope": 0.0', '"slope": 10.1', "memory"),
        ("data/policy_and_motion.json", '"10.2 N"', '"10.8 N"', CORRECTIONS + "tomato"),
        (CALIBRATION, "28 | 267 | 407", "28 | 301 | 407", CALIBRATE + "tomato"),
        (CALIBRATION, "15 | 108 | 157", "61 | 108 | 157", CALIBRATE + "potato"),
        (CALIBRATION, "92 % | 0.26 |", "89 % | 0.26 |", "lower half of the cucumber"),
        (CALIBRATION, "90 % | 0.32 |", "90 % | 1.51 |", "lower half of the potato"),
        (CALIBRATION, "predicted with 1.29 N", "predicted with 2.71 N", "blocks"),
        (CALIBRATION, "| 12 | 95 % |", "| 12 | 96 % |", "90 % bands on slice_push, draws"),
        (CALIBRATION, "| 1.63 | 87 %", "| 2.83 | 87 %", "90 % bands on bonds, same"),
    ],
)  # fmt: skip
def test_what_a_page_says_is_judged(docs, name, old, new, begin):
    assert "| reached |" in line(aims.page(docs), begin)
    file = docs / name
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new), encoding="utf-8")
    assert "| **missed** |" in line(aims.page(docs), begin)


def test_draws_of_a_bench_that_are_too_few_do_not_count(docs):
    reported = (docs / "benches_report.jsonl").read_text(encoding="utf-8").splitlines()
    facts = [json.loads(text) for text in reported]
    newest = [f for f in facts if f["commit"] == facts[-1]["commit"]]
    strips = [f for f in newest if f["case"]["law"] == "strips"]
    assert "**missed**" in line(aims.page(docs), "strips: no name for what")
    # The same runs as if they were of twelve draws.
    more = [f | {"case": f["case"] | {"draw": k}} for k in range(12) for f in strips]
    text = "".join(json.dumps(f) + "\n" for f in more)
    (docs / "benches_report.jsonl").write_text(text, encoding="utf-8")
    assert "12 draws | reached |" in line(aims.page(docs), "strips: no name for what")
    assert "12 draws | **missed** |" in line(aims.page(docs), "strips: right")
