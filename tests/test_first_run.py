"""What a new user's machine may refuse, and how what runs on it is ended."""

import ast
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from sliceit_drake import output_folder
from sliceit_drake.cli.main import main
from sliceit_drake.cli.progress import StageBars
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.warp_start import load_modules
from sliceit_drake.cutting.workers import worker_processes
from sliceit_drake.output_folder import check_output
from studies.__main__ import main as studies

ROOT = Path(__file__).resolve().parent.parent
SMALL_FOOD = "{food: {shape: !Cylinder {rings: 3, layers: [0.0, 0.004, 0.012]}}}"


def test_all_files_are_text_in_utf8_whatever_the_locale():
    without = []
    for file in [*ROOT.glob("sliceit_drake/**/*.py"), *ROOT.glob("studies/**/*.py")]:
        for call in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not isinstance(call, ast.Call):
                continue
            name = getattr(call.func, "attr", getattr(call.func, "id", ""))
            mode = [a.value for a in call.args if isinstance(a, ast.Constant)]
            binary = any(isinstance(m, str) and m.strip("rwax+") == "b" for m in mode)
            if name in ("read_text", "write_text", "open") and not binary:
                if "encoding" not in {keyword.arg for keyword in call.keywords}:
                    without.append(f"{file.relative_to(ROOT)}:{call.lineno}")
    assert without == []


@pytest.mark.parametrize(
    ("program", "command"), [(main, "simulate"), (main, "train"), (studies, "random")]
)
def test_a_place_that_cannot_be_written_is_refused_before_anything_is_computed(
    program, command, tmp_path, capsys
):
    (tmp_path / "file").touch()
    assert program([command, "--output", str(tmp_path / "file" / "folder")]) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert "file: --output: cannot be written to (" in shown.err


def test_a_default_place_that_cannot_be_written_is_refused_too(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "output").touch()
    assert main(["simulate"]) == 2
    assert capsys.readouterr().out == ""


def test_looking_at_a_place_makes_nothing_and_changes_no_file(tmp_path):
    check_output(tmp_path / "a" / "b")
    (tmp_path / "page.md").write_text("text", encoding="utf-8")
    check_output(tmp_path / "page.md")
    assert [p.name for p in tmp_path.iterdir()] == ["page.md"]
    assert (tmp_path / "page.md").read_text(encoding="utf-8") == "text"


def test_a_disk_that_refuses_is_a_message_and_no_traceback(monkeypatch, capsys):
    def refuse(*_, **__):
        raise OSError(28, "No space left on device", "out/record.csv")

    monkeypatch.setattr(output_folder, "check_output", refuse)
    assert main(["simulate", "--output", "out"]) == 2
    assert capsys.readouterr().err == "sliceit: out/record.csv: No space left on device\n"


def test_without_a_place_for_kernels_a_run_has_its_own_and_warp_says_nothing(tmp_path):
    (tmp_path / "home").touch()
    code = (
        "from sliceit_drake.cutting.warp_start import start_warp\n"
        "start_warp()\n"
        "import warp, os\n"
        "print(warp.config.kernel_cache_dir)\n"
        "print('another line', file=__import__('sys').stderr)\n"
    )
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("WARP", "XDG"))}
    environment |= {"HOME": str(tmp_path / "home"), "TMPDIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    kernels = Path(done.stdout.strip())
    assert tmp_path in kernels.parents and not kernels.exists()
    first, second = done.stderr.splitlines()
    assert str(tmp_path / "home") in first and "WARP_CACHE_PATH" in first
    assert second == "another line"


def test_two_modules_of_kernels_are_loaded_side_by_side_and_none_by_two_threads(monkeypatch):
    together = threading.Barrier(2, timeout=30.0)
    at_work, twice = set(), []

    def load(name, device, block_dim):
        twice.extend({name} & at_work)
        at_work.add(name)
        together.wait()  # Breaks where another does not come while this one is at work.
        at_work.remove(name)

    monkeypatch.setattr("warp.load_module", load)
    other = threading.Thread(target=load_modules, args=(["a", "b"], "cpu"))
    other.start()
    load_modules(["a", "b"], "cpu")
    other.join()
    assert twice == [] and not together.broken


def test_a_program_that_ends_while_kernels_load_ends_without_a_traceback():
    code = (
        "import os, time, warp\n"
        "from sliceit_drake.cutting.warp_start import start_loading\n"
        "def load(name, **_):\n"
        "    time.sleep(0.2)\n"
        "    os.write(1, name.encode())\n"
        "def names():\n"
        "    for name in 'abc':\n"
        "        time.sleep(0.1)\n"  # For a thread of its own, long enough to be overtaken.
        "        yield name\n"
        "warp.load_module = load\n"
        "start_loading(names(), 'cpu')\n"
        "raise SystemExit(3)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (3, "")
    assert sorted(done.stdout) == ["a", "b", "c"]


def test_kernels_start_where_there_is_no_standard_error():
    code = (
        "import sys\n"
        "sys.stderr = None\n"
        "from sliceit_drake.cutting.warp_start import start_warp\n"
        "start_warp()\n"
        "import warp\n"
        "print(warp.get_device('cpu'))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "cpu\n"


def test_a_kill_ends_a_run_as_ctrl_c_does_offline_and_keeps_what_there_is(
    tmp_path, monkeypatch, capsys
):
    parts = []

    def kill_in_the_third(bars, name, time, duration, remark):
        parts.append(time)
        if len(parts) == 3:
            os.kill(os.getpid(), signal.SIGTERM)

    def connect(*_):
        raise AssertionError("a run needs no network")

    monkeypatch.setattr(StageBars, "show", kill_in_the_third)
    monkeypatch.setattr(socket.socket, "connect", connect)
    before = signal.getsignal(signal.SIGTERM)
    output = tmp_path / "a folder"
    options = ["--set", SMALL_FOOD, "--no-replay", "--no-animation", "--output", str(output)]
    assert main(["simulate", *options]) == 1
    assert signal.getsignal(signal.SIGTERM) is before
    summary = json.loads((output / "summary.json").read_text(encoding="utf-8"))
    assert summary["stopped"] == "interrupted by the user"
    assert summary["simulated_time_s"] == pytest.approx(0.06)
    names = {path.name for path in output.iterdir()}
    assert names == {"force.png", "record.csv", "summary.json", "scenario.yaml"}
    assert "What there is so far is kept" in capsys.readouterr().out


def test_a_command_that_goes_on_says_so_when_it_is_interrupted(tmp_path, monkeypatch, capsys):
    def interrupt(*_, **__):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(10.0)

    monkeypatch.setattr(output_folder, "check_output", interrupt)
    calibrate = ["calibrate", "x", "--food", "cucumber"]
    (tmp_path / "begun").mkdir()
    for command, folder, goes_on in (
        (calibrate, "begun", True),
        (calibrate, "nothing_yet", False),
        (["export", str(tmp_path)], "begun", False),
    ):
        assert main([*command, "--output", str(tmp_path / folder)]) == 130
        error = capsys.readouterr().err
        assert error.startswith("sliceit: interrupted")
        assert ("the same command goes on" in error) == goes_on


def test_each_stage_has_a_bar_that_is_there_from_its_beginning_and_ends_with_it(capsys):
    with StageBars() as bars:
        bars.show("long", 0, 2)
        assert "long:   0%" in capsys.readouterr().err
        bars.show("long", 2, 2)
        bars.show("grows", 1, 2)
        bars.show("grows", 2, 3)
        bars.show("long", 1, 2)  # It comes again.
        bars.show("grows", 3, 3)
    shown = capsys.readouterr().err
    assert "2/2" in shown and "3/3" in shown and "grows: 3it" not in shown
    assert shown.index("long: 100%") < shown.index("long:  50%")


def leave_a_note(folder: Path) -> None:
    """For a process: works until it is ended."""
    try:
        # Within, since what waits for this file ends the process at once.
        (folder / "began").touch()
        time.sleep(600.0)
    finally:
        (folder / "cleaned").touch()


def test_processes_end_with_the_command_that_started_them_and_clean_up(tmp_path):
    with pytest.raises(KeyboardInterrupt), worker_processes(1) as pool:
        running, waiting = (pool.submit(leave_a_note, tmp_path) for _ in range(2))
        while not (tmp_path / "began").exists():
            time.sleep(0.05)
        (process,) = pool._processes.values()
        os.kill(process.pid, signal.SIGINT)  # As a terminal does; it is not for the process.
        raise KeyboardInterrupt
    assert (tmp_path / "cleaned").exists()
    assert isinstance(running.exception(), SystemExit)
    assert not process.is_alive()
    # A second one is handed to a process before it is wanted, and ended alike.
    assert waiting.cancelled() or isinstance(waiting.exception(), SystemExit)


def test_an_error_of_a_folder_names_the_option():
    with pytest.raises(ConfigurationError, match="--cache: cannot be written"):
        check_output(Path("/proc/none"), "--cache")


def test_what_ships_can_be_named_as_the_help_does_from_any_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["records", "check", "calibration/records/cucumber.csv"]) == 0
    assert "cucumber" in capsys.readouterr().out
    here = tmp_path / "calibration" / "records"
    here.mkdir(parents=True)
    # What a user has of that name comes first.
    assert main(["records", "check", "calibration/records"]) == 2
