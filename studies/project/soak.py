"""An hour of everything side by side, killed at random.

  python -m studies soak --minutes 60 --output docs/results/soak.md

`sliceit simulate`, `calibrate`, `diagnose`, `train`, and `hardware` on an emulated controller each
run again and again, all at once. Half of the runs are killed by SIGKILL at a random time, and the
same command is called again in the same folder until it ends by itself. Nothing may be lost by
that:
  - the files that a run writes have the same bytes as those of the first run, which is not killed
  - no process is left behind
  - the emulated arm comes to rest when its program is killed
  - later runs take no more memory than the first ones
Ends with status 1 if something was lost.
"""

import argparse
import contextlib
import dataclasses as dc
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sliceit_drake.emulator.process import EmulatorProcess
from studies.figures import BLUE, ORANGE, new_figure, save_figure, tidy
from studies.pages import publish, render_and_store
from studies.robot.faults import CLIENT_PACE, MOTION, PACE, REST, SCENARIO, await_rest

__all__ = ["Job", "Run", "Soak", "add_arguments", "run"]

SLICEIT = (sys.executable, "-m", "sliceit_drake.cli.main")
MORE = 1.2
"""Allowed peak memory of the last third of a job's runs, over that of the first third. Equal runs
of a calibration differ by 14 % (888 to 1,010 MB of six)."""
DATE = re.compile(rb"\d{4}-\d{2}-\d{2}")
"""Foods name the day of their calibration, which may end in the hour."""
LINGER = 20.0
"""Wall time in which the processes of a killed run have to end, s."""


@dc.dataclass
class Run:
    """A run, with all its calls.

    Attributes:
        kills: Calls that were killed.
        memory: Greatest resident memory of a call, MB.
        seconds: Wall time of the last call.
        lost: What was lost, in words.
    """

    kills: int = 0
    memory: float = 0.0
    seconds: float = 0.0
    lost: list[str] = dc.field(default_factory=list)


@dc.dataclass
class Job:
    """A command that is called again and again.

    Attributes:
        name: Of it.
        command: What is called; {folder} is the folder of a run.
        results: Files in that folder that are the same in each run.
        typed: What it is told on its standard input.
        around: Made around each call; what it gives is called after a kill, and says what is wrong.
    """

    name: str
    command: Sequence[str]
    results: tuple[str, ...] = ()
    typed: bytes = b""
    around: Callable[[], contextlib.AbstractContextManager[Callable[[], list[str]]]] = lambda: (
        contextlib.nullcontext(lambda: [])
    )


class Soak:
    """Calls a job again and again until the time is over.

    Args:
        job: Which.
        folder: For its runs.
        seed: Of the kills.
    """

    def __init__(self, job: Job, folder: Path, seed: int) -> None:
        self.job, self.folder = job, folder
        self.runs: list[Run] = []
        self._rng = np.random.default_rng(seed)
        self._first: dict[str, bytes] = {}
        self._length = 0.0

    def until(self, end: float) -> None:
        """Runs; the last run ends after `end` (of time.monotonic) without a kill.

        The first run of all is not killed: the others are compared with it.
        """
        while not self.runs or time.monotonic() < end:
            # Always the same, since results may name it.
            folder = self.folder / "run"
            made = Run()
            killed = True
            while killed:
                with self.job.around() as after_kill:
                    if killed := self._call(folder, made, end):
                        made.lost += after_kill()
            self._compare(folder, made)
            self.runs.append(made)
            shutil.rmtree(folder, ignore_errors=True)

    def _call(self, folder: Path, made: Run, end: float) -> bool:
        """Calls the command once; whether it was killed."""
        command = [word.replace("{folder}", str(folder)) for word in self.job.command]
        killed_after = np.inf
        if self.runs and time.monotonic() < end and self._rng.random() < 0.5:
            killed_after = self._rng.uniform(0.0, self._length)
        begin = time.monotonic()
        with tempfile.TemporaryFile() as said:
            process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=said,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            assert process.stdin is not None
            with contextlib.suppress(BrokenPipeError):
                process.stdin.write(self.job.typed)
                process.stdin.flush()
            killed = False
            while True:
                pid, status, usage = os.wait4(process.pid, os.WNOHANG)
                if pid:
                    break
                if not killed and time.monotonic() - begin > killed_after:
                    os.kill(process.pid, signal.SIGKILL)
                    killed = True
                time.sleep(0.05)
            process.returncode = os.waitstatus_to_exitcode(status)
            process.stdin.close()
            made.seconds = time.monotonic() - begin
            made.memory = max(made.memory, usage.ru_maxrss / 1024.0)
            # It may have ended by itself at that moment.
            killed = killed and process.returncode == -signal.SIGKILL
            if killed:
                made.kills += 1
            elif process.returncode != 0:
                said.seek(0)
                words = said.read().decode("utf-8", "replace").strip().splitlines()[-5:]
                made.lost.append(f"ended with status {process.returncode}: {' / '.join(words)}")
            else:
                self._length = max(self._length, made.seconds)
        if left := _left_of(process.pid):
            made.lost.append(f"left behind: {', '.join(left)}")
        return killed

    def _compare(self, folder: Path, made: Run) -> None:
        for name in self.job.results:
            file = folder / name
            found = DATE.sub(b"", file.read_bytes()) if file.exists() else b""
            if not found:
                made.lost.append(f"{name} is not there")
            elif found != self._first.setdefault(name, found):
                made.lost.append(f"{name} is not that of the first run")

    def memory(self) -> tuple[float, float]:
        """Median peak of the first third of the runs without a kill, and of the last, MB."""
        peaks = [r.memory for r in self.runs if not r.kills]
        third = max(len(peaks) // 3, 1)
        return float(np.median(peaks[:third])), float(np.median(peaks[-third:]))

    def lost(self) -> list[str]:
        """All that was lost, memory that grew included."""
        out = [
            f"{self.job.name}, run {k}: {text}" for k, r in enumerate(self.runs) for text in r.lost
        ]
        first, last = self.memory()
        if last > MORE * first:
            out.append(f"{self.job.name}: memory from {first:.0f} to {last:.0f} MB")
        return out


def _left_of(session: int) -> list[str]:
    """Commands of a session that have not ended after `LINGER`."""
    end = time.monotonic() + LINGER
    while True:
        left = []
        for file in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError):
                state, _, _, of = file.read_bytes().rpartition(b")")[2].split()[:4]
                if int(of) == session and state != b"Z":
                    words = (file.parent / "cmdline").read_bytes().split(b"\0")
                    left.append(b" ".join(words)[:120].decode("utf-8", "replace"))
        if not left or time.monotonic() > end:
            return left
        time.sleep(0.5)


ADDRESS = "127.0.0.91"


@contextlib.contextmanager
def _emulator():  # type: ignore[no-untyped-def]
    """An emulated controller; gives what says whether its arm is at rest."""
    options = ["--set", f"{{{MOTION}}}"]
    with EmulatorProcess(
        SCENARIO, ADDRESS, PACE, lockstep=True, options=options, timeout=600.0
    ) as emulator:

        def at_rest() -> list[str]:
            status = await_rest(emulator.pendant)
            moves = np.abs(status["velocities"]).max() > REST
            return ["the arm went on after its program was killed"] if moves else []

        yield at_rest


def jobs(records: Path) -> list[Job]:
    """What runs side by side.

    Args:
        records: Folder of slices to diagnose.
    """
    to = ("--output", "{folder}")
    simulate = ("simulate", "cucumber_measured", "--no-replay", "--no-animation")
    potato = ("calibration/records/potato.csv", "--food", "potato", "--workers", "1")
    fast = ("--trials", "10", "--starts", "1", "--steps", "3", "--blocks", "0")
    diagnose = ("diagnose", str(records), "--model", "cucumber", "--workers", "1")
    train = ("train", "--steps", "800", "--set", "warm_up=200,validation_interval=400")
    often = ("--set", "validation_slices=2,checkpoint_interval=200")
    robot = ("hardware", SCENARIO, "--set", f"{{{MOTION}}}", "--robot", "hardware/emulated.yaml")
    there = ("--host", ADDRESS, "--pace", str(CLIENT_PACE), "--no-replay")
    return [
        Job("simulate", (*SLICEIT, *simulate, *to), ("record.csv",)),
        Job("calibrate", (*SLICEIT, "calibrate", *potato, *fast, *to), ("food.yaml",)),
        Job("diagnose", (*SLICEIT, *diagnose, *to), ("diagnosis.json", "extended.yaml")),
        Job("train", (*SLICEIT, *train, *often, *to), ("episodes.jsonl", "validation.jsonl")),
        Job("emulate", (*SLICEIT, *robot, *there, *to), typed=b"slice\n", around=_emulator),
    ]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("--minutes", type=float, default=60.0, help="that it takes (default 60)")
    parser.add_argument("--seed", type=int, default=0, help="of the kills (default 0)")
    parser.add_argument("--output", metavar="FILE", type=Path, help="page to write")


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        records = folder / "records"
        protocol = "calibration/protocols/poor.yaml"
        subprocess.run([*SLICEIT, "record", protocol, "--output", str(records)], check=True)
        soaks = [
            Soak(job, folder / job.name, options.seed + k) for k, job in enumerate(jobs(records))
        ]
        end = time.monotonic() + 60.0 * options.minutes
        with (
            ThreadPoolExecutor(len(soaks)) as pool,
            tqdm(total=options.minutes, desc="minutes", bar_format="{l_bar}{bar}| {n:.1f}") as bar,
        ):
            ends = [pool.submit(soak.until, end) for soak in soaks]
            while not all(each.done() for each in ends):
                time.sleep(1.0)
                left = (end - time.monotonic()) / 60.0
                bar.update(max(min(options.minutes - left, options.minutes) - bar.n, 0.0))
        # What broke down in a thread does so here.
        for each in ends:
            each.result()
    lost = [text for soak in soaks for text in soak.lost()]
    rows = [
        (
            s.job.name,
            len(s.runs),
            sum(r.kills for r in s.runs),
            *(f"{m:.0f} MB" for m in s.memory()),
        )
        for s in soaks
    ]
    values = {"command": options.command, "minutes": options.minutes, "rows": rows, "lost": lost}
    values |= {"linger": LINGER, "more": MORE}
    results = {s.job.name: s.runs for s in soaks}
    publish(render_and_store("soak", options.output, values, results), options.output)
    if options.output is not None:
        _draw(soaks, options.output.parent / "figures" / "soak.png")
    return int(bool(lost))


def _draw(soaks: Sequence[Soak], file: Path) -> None:
    """Peak memory of each run; those that were killed stand out."""
    figure = new_figure(10.0, 3.6)
    for axes, soak in zip(figure.subplots(1, len(soaks), sharey=True), soaks, strict=True):
        for killed, colour in ((False, BLUE), (True, ORANGE)):
            runs = [n for n, r in enumerate(soak.runs) if bool(r.kills) == killed]
            peaks = [soak.runs[n].memory for n in runs]
            label = "killed, and called again" if killed else "not killed"
            axes.plot(runs, peaks, "o", ms=4, color=colour, label=label)
        tidy(axes, soak.job.name)
        axes.set_xlabel("run")
    most = max(r.memory for soak in soaks for r in soak.runs)
    figure.axes[0].set(ylabel="peak memory [MB]", ylim=(0.0, 1.1 * most))
    figure.axes[0].legend(frameon=False, fontsize=8, loc="lower left")
    save_figure(figure, file, dpi=100)
