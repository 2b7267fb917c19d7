"""The soak: a run that is killed and called again loses nothing, and what does is found."""

import sys
import time

import pytest

from studies.project import soak
from studies.project.soak import Job, Soak

WRITE = """
import pathlib, subprocess, sys, time
folder = pathlib.Path(sys.argv[1])
folder.mkdir(parents=True, exist_ok=True)
file = folder / "result"
done = len(file.read_text()) if file.exists() else 0
{more}
with file.open("a") as out:
    for _ in range(10 - done):
        out.write("x")
        out.flush()
        time.sleep(0.02)
"""


def soaked(tmp_path, more: str = "", seconds: float = 2.0) -> Soak:
    script = tmp_path / "script.py"
    script.write_text(WRITE.replace("{more}", more))
    command = (sys.executable, str(script), "{folder}")
    made = Soak(Job("write", command, ("result",)), tmp_path / "runs", seed=1)
    made.until(time.monotonic() + seconds)
    return made


@pytest.fixture(autouse=True)
def _short_linger(monkeypatch):
    monkeypatch.setattr(soak, "LINGER", 0.3)


def test_what_goes_on_after_a_kill_loses_nothing(tmp_path):
    made = soaked(tmp_path)
    assert sum(r.kills for r in made.runs) > 1
    assert made.runs[0].kills == 0
    assert not made.lost()


def test_what_begins_anew_in_an_old_file_is_found(tmp_path):
    lost = soaked(tmp_path, "done = 0").lost()
    assert lost and all("result is not that of the first run" in text for text in lost)


def test_a_process_that_is_left_behind_is_found(tmp_path):
    child = "subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(1)'])"
    lost = soaked(tmp_path, child, seconds=1.0).lost()
    assert lost and all("left behind" in text and "time.sleep(1)" in text for text in lost)


def test_a_run_that_fails_is_found_with_its_last_words(tmp_path):
    lost = soaked(tmp_path, "done or sys.exit('no disk')", seconds=0.5).lost()
    assert any("ended with status 1: no disk" in text for text in lost)
    assert any("result is not there" in text for text in lost)


def test_a_date_may_change_and_nothing_else(tmp_path):
    made = Soak(Job("write", (), ("result",)), tmp_path, seed=0)
    runs = [soak.Run() for _ in range(3)]
    texts = ("2026-11-27, force 1", "2026-11-28, force 1", "2026-11-28, force 2")
    for text, one in zip(texts, runs, strict=True):
        (tmp_path / "result").write_text(text)
        made._compare(tmp_path, one)
    assert [bool(one.lost) for one in runs] == [False, False, True]


def test_memory_that_grows_from_run_to_run_is_found(tmp_path):
    made = soaked(tmp_path, seconds=1.0)
    for number, one in enumerate(made.runs):
        one.kills, one.memory = 0, 100.0 + 20.0 * number
    assert ["memory from" in text for text in made.lost()] == [True]
