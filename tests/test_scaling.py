"""The cost model of many workers says what was measured with one, and where it ends."""

from pathlib import Path

import pytest

from studies.scaling import scaling

ROOT = Path(__file__).resolve().parent.parent


def test_one_worker_is_as_fast_as_measured_and_many_as_fast_as_the_storage():
    run = scaling.SearchRun(1, 100, 50.0, simulation=0.4, storage=0.06, proposal=0.04)
    limits = scaling.StorageLimits({1: 150.0, 2: 200.0}, read=1e-4, reads=20_000.0)
    for shared in (False, True):
        assert scaling.search_rate(1, run, limits, shared) == pytest.approx(2.0)
        # Another worker's trial takes 0.1 ms to read beside 0.5 s of one's own.
        assert scaling.search_rate(2, run, limits, shared) == pytest.approx(4.0, rel=1e-3)
    # A file: 200 trials are written a second. A server also sends each trial to all: 1/200 s to
    # write one and 999/20,000 s to send it.
    assert scaling.search_rate(1000, run, limits, False) == pytest.approx(200.0)
    assert scaling.search_rate(1000, run, limits, True) == pytest.approx(1 / (0.005 + 0.04995))
    assert scaling.search_rate(30, run, limits, True) == pytest.approx(60.0, rel=0.01)
    of_file = scaling.saturation(lambda n: scaling.search_rate(n, run, limits, False))
    of_server = scaling.saturation(lambda n: scaling.search_rate(n, run, limits, True))
    assert 90 < of_file < 120 and 20 < of_server < 60


def test_a_session_is_as_fast_as_its_workers_the_scheduler_or_the_writer():
    run = scaling.DaskRun({1: 20.0, 2: 11.0}, slices=10, tasks=300.0, write=0.01, size=10_000)
    assert scaling.dask_rate(1, run) == pytest.approx(0.5)
    assert scaling.dask_rate(100, run) == pytest.approx(50.0)
    assert scaling.dask_rate(1000, run) == pytest.approx(100.0)
    assert 180 < scaling.saturation(lambda n: scaling.dask_rate(n, run)) < 220


def test_tables_say_what_was_measured_and_go_between_the_marks(tmp_path):
    runs = [
        scaling.SearchRun(1, 100, 50.0, 0.4, 0.06, 0.04),
        scaling.SearchRun(2, 104, 28.0, 0.42, 0.07, 0.05),
    ]
    limits = {"PostgreSQL": scaling.StorageLimits({1: 150.0, 2: 200.0}, 1e-4, 20_000.0)}
    page = f"before\n{scaling.PLACE.begin}\nold\n{scaling.PLACE.end}\nafter\n"
    file = tmp_path / "page.md"
    file.write_text(page, encoding="utf-8")
    scaling.PLACE.publish(
        file,
        searches=scaling.search_rows({"PostgreSQL": runs}),
        limits=scaling.limit_rows(limits),
        dask=None,
        model=scaling.model_values({"PostgreSQL": runs}, limits, None),
        command="a command",
        machine="a machine",
    )
    text = file.read_text(encoding="utf-8")
    lines = text.splitlines()
    assert "| PostgreSQL | 2 | 104 | 28.0 | 3.71 | 1.86 | 420.0 ms | 70.0 ms | 50.0 ms |" in lines
    assert "| PostgreSQL | 150 | 200 | 10000 | 20000 |" in lines
    assert "| 1 | 2 (100 %) |" in lines
    assert "old" not in text and text.startswith("before\n") and text.endswith("\nafter\n")
    assert scaling.PLACE.put(text, "old", "page.md") == page
    with pytest.raises(ValueError, match="page.md has not the lines"):
        scaling.PLACE.put("no marks", "", "page.md")
    # The page that ships has both.
    shipped = (ROOT / "docs/results/scaling.md").read_text(encoding="utf-8")
    assert scaling.PLACE.put(shipped, "", "docs/results/scaling.md")
