"""Curves as users bring them, each with something wrong, and what the commands say of it.

The good curve is the paper's potato (calibration/measured), 1.8 s of it after half a second of air,
with noise. Each is imported as a new user would, by `sliceit records import force`. What can be
imported and does not merely differ in what the import says is fitted too, on a coarse mesh and with
a search of four trials (`sliceit calibrate --structure setup --trials 4 --steps 0 --blocks 0`, some
20 s each). A row is right if what was said names the fault; of a curve that can be used as it is,
if no fault is named.
"""

import argparse
import contextlib
import dataclasses as dc
import io
import re
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sliceit_drake.calibration.setup import setup_of_record
from sliceit_drake.cli.main import main
from sliceit_drake.configuration import dump_yaml
from sliceit_drake.records.force_profile import load_force_profile
from sliceit_drake.records.validation import load_record
from sliceit_drake.resources import resource_path
from studies.figures import BLUE, new_figure, save_figure, tidy
from studies.pages import publish, table

__all__ = ["CURVES", "Curve", "add_arguments", "is_right", "run", "said_of"]

RATE, AIR, NOISE = 500.0, 0.5, 0.05
"""Of the good curve: rows a second, time before it, s, and standard deviation of its noise, N."""
REFINEMENT = 0.5
"""Elements along an edge, relative to those of the setup."""
FACTS = (
    *("--component", "vertical", "--food", "potato", "--shape", "cylinder"),
    *("--size", "0.04", "0.08", "0.04", "--speed", "0.02"),
)
FIT = ("--structure", "setup", "--trials", "4", "--steps", "0", "--starts", "1", "--blocks", "0")
TROUBLE = re.compile(r"^(?:sliceit|error|warning|Warning): .*|^.*(?:faulty|asks for).*", re.M)
"""Of what is said, the lines that name a fault."""

Columns = tuple[np.ndarray, np.ndarray]


@dc.dataclass(frozen=True)
class Curve:
    """A curve with something wrong.

    Attributes:
        name: What the user did.
        make: Its times and forces, from those of the good curve [n], s and N, and random numbers.
        expected: Regular expression of what should be said; empty if no fault should be named.
        options: Of the import, behind those that are right.
        fit: Whether it is fitted, and `expected` is looked for in what the fit says.
    """

    name: str
    make: Callable[[np.ndarray, np.ndarray, np.random.Generator], Columns]
    expected: str = ""
    options: Sequence[str] = ()
    fit: bool = False

    @property
    def verdict(self) -> str:
        """Where the expected words were said."""
        return "not told" if self.name in NOT_TOLD else "right"


NOT_TOLD = ("kgf", "begins in the food, with an offset", "grows without a cut")
"""Curves of which no more is said than of others, in which this is not wrong."""


def _spoiled(force: np.ndarray, rows: slice, value: float) -> np.ndarray:
    out = force.copy()
    out[rows] = value
    return out


def _then(time: np.ndarray, force: np.ndarray, more: np.ndarray) -> Columns:
    """The curve, and what the sensor shows after it."""
    after = time[-1] + np.arange(1, len(more) + 1) / RATE
    return np.append(time, after), np.append(force, more)


def _noise(rng: np.random.Generator, n: int) -> np.ndarray:
    return NOISE * rng.normal(size=n)


CURVES = (
    Curve("nothing wrong", lambda t, f, _: (t, f), fit=True),
    Curve("60 rows a second", lambda t, f, _: (t[::8], f[::8])),
    Curve("offset of 3 N", lambda t, f, _: (t, f + 3.0), "mean force before that is taken off"),
    Curve(
        "clipped at 20 N",
        lambda t, f, _: (t, np.minimum(f, 20.0)),
        "clipped|at its limit",
        fit=True,
    ),
    Curve("zero drifts by 1 N/s", lambda t, f, _: (t, f + t), "changes by", fit=True),
    Curve(
        "speed 2.5 times too high",
        lambda t, f, _: (t, f),
        "motion.speed: 0.05 m/s",
        ("--speed", "0.05"),
    ),
    Curve("speed half of the true", lambda t, f, _: (t, f), "correct --speed", ("--speed", "0.01")),
    Curve(
        "height and width exchanged",
        lambda t, f, _: (t, f),
        "the last number of",
        ("--size", "0.04", "0.04", "0.08"),
    ),
    Curve("size in mm", lambda t, f, _: (t, f), "Is it in mm", ("--size", "40", "80", "40")),
    Curve("speed in mm/s", lambda t, f, _: (t, f), "Is it in mm/s", ("--speed", "20")),
    Curve("time in ms", lambda t, f, _: (1e3 * t, f), "Is it in ms"),
    Curve("kN", lambda t, f, _: (t, 1e-3 * f), "import it again with --units s kN"),
    Curve("mN", lambda t, f, _: (t, 1e3 * f), "import it again with --units s mN"),
    Curve("kgf", lambda t, f, _: (t, f / 9.81), "table names no unit"),
    Curve("never touched", lambda t, _, rng: (t, _noise(rng, len(t))), "never rises"),
    Curve("a constant", lambda t, f, _: (t, 0.0 * f + 3.0), "never rises"),
    Curve("two slices", lambda t, f, _: _then(t, f, f), "holds 2 slices.*--between"),
    Curve(
        "the knife waits at the end, speed unknown",
        lambda t, f, rng: _then(t, f, 30.0 + _noise(rng, 600)),
        "is level at",
        ("--speed", "unknown"),
    ),
    Curve(
        "the knife leaves at the end, speed unknown",
        lambda t, f, rng: _then(t, f, _noise(rng, 900)),
        "is level at",
        ("--speed", "unknown"),
    ),
    Curve("upside down", lambda t, f, _: (t, -f), "import it again with --sign by_knife"),
    Curve(
        "upside down, taken for a norm",
        lambda t, f, _: (t, -f),
        "import it again with --component vertical",
        ("--component", "norm"),
    ),
    Curve(
        "a norm with an offset",
        lambda t, f, _: (t, np.abs(f + 3.0)),
        "no zero can be taken off a norm",
        ("--component", "norm"),
    ),
    Curve("begins in the food", lambda t, f, _: (t[400:], f[400:]), "no air phase|has not 10 rows"),
    Curve(
        "begins in the food, with an offset",
        lambda t, f, _: (t[400:], f[400:] + 3.0),
        "sensor's zero",
        fit=True,
    ),
    Curve(
        "ends at half of the depth",
        lambda t, f, _: (t[:700], f[:700]),
        "If it went on to the board",
    ),
    Curve(
        "one row of 600 N",
        lambda t, f, _: (t, _spoiled(f, slice(700, 701), 600.0)),
        "1 row far from",
        fit=True,
    ),
    Curve(
        "the sensor hangs for 0.4 s",
        lambda t, f, _: (t, _spoiled(f, slice(600, 800), f[600])),
        "shows the same for 0.4 s",
    ),
    Curve(
        "rows without a number",
        lambda t, f, _: (t, _spoiled(f, slice(600, 620), np.nan)),
        "not a finite number",
    ),
    Curve(
        "times twice", lambda t, f, _: (np.repeat(t[::2], 2)[: len(t)], f), "remove repeated ones"
    ),
    Curve("last row first", lambda t, f, _: (t[::-1], f[::-1]), "Sort the rows"),
    Curve(
        "grows without a cut",
        lambda t, f, rng: (t, 8.0 * np.clip(t - AIR, 0.0, None) + _noise(rng, len(t))),
        "not determined",
        fit=True,
    ),
)


def good_curve() -> Columns:
    """Time [n], s, and vertical force on the knife [n], N, without noise."""
    profile = load_force_profile(
        resource_path("calibration/measured/sliceit_real_potato_force.csv")
    )
    shown = profile.is_read
    begin, end = profile.time[shown][[0, -1]]
    time = np.arange(0.0, AIR + end - begin, 1.0 / RATE)
    force = np.interp(time - AIR + begin, profile.time[shown], profile.force[shown])
    level = float(profile.force[shown][0])
    return time, np.where(time < AIR, 0.0, np.maximum(force - level, 0.0))


def said_of(curve: Curve, folder: Path) -> tuple[int, str]:
    """Exit status, and what the commands say of a curve, less what they say of any.

    Args:
        folder: For its file and results; empty.
    """
    time, force = good_curve()
    rng = np.random.default_rng(0)
    time, force = curve.make(time, force + _noise(rng, len(time)), rng)
    file = folder / "curve.csv"
    lines = [f"{t:.6f},{f:.6f}" for t, f in zip(time, force, strict=True)]
    file.write_text("\n".join(["time,force", *lines]) + "\n", encoding="utf-8")
    records = ["--output", str(folder / "records")]
    status, said = _typed("records", "import", "force", str(file), *records, *FACTS, *curve.options)
    if curve.fit and status == 0:
        record = folder / "records/curve.csv"
        setup = dc.replace(setup_of_record(load_record(record)), refinement=REFINEMENT)
        dump_yaml(setup, folder / "setup.yaml")
        food = ["--food", str(folder / "setup.yaml"), "--output", str(folder / "food")]
        status, more = _typed("calibrate", str(record), *food, *FIT, "--workers", "1")
        said += more
    return status, said.replace(f"{folder}/", "")


def _typed(*words: str) -> tuple[int, str]:
    """Exit status and all that a command prints."""
    out, bars = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(bars):
        status = main(list(words))
    errors = [line for line in bars.getvalue().splitlines() if line.startswith("sliceit: ")]
    return status, "\n".join([out.getvalue(), *errors])


def is_right(curve: Curve, status: int, said: str) -> bool:
    """Whether the commands say what is to be said."""
    if curve.expected:
        return re.search(curve.expected, said) is not None
    return status == 0 and not re.search(r"(?m)^(?:error|warning|sliceit): (?!.*not given)", said)


SHOWN = (
    "nothing wrong",
    "clipped at 20 N",
    "zero drifts by 1 N/s",
    "the knife waits at the end, speed unknown",
    "one row of 600 N",
    "grows without a cut",
)
"""Those that are drawn."""
PICTURE = "figures/adversarial_curves.png"


def draw(file: Path) -> None:
    """Draws some of the curves."""
    time, force = good_curve()
    figure = new_figure(9.0, 4.2)
    chosen = [curve for curve in CURVES if curve.name in SHOWN]
    for axes, curve in zip(figure.subplots(2, 3).flat, chosen, strict=True):
        rng = np.random.default_rng(0)
        axes.plot(*curve.make(time, force + _noise(rng, len(time)), rng), color=BLUE, lw=0.9)
        axes.set(ylim=(-3.0, 45.0), xlabel="time [s]", ylabel="force [N]")
        tidy(axes, curve.name.split(",")[0])
    save_figure(figure, file)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the study's arguments."""
    parser.add_argument("--no-fit", action="store_true", help="only import")
    parser.add_argument("--output", type=Path, metavar="PAGE", help="write the page")


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    rows = []
    for curve in tqdm(CURVES, desc="curves"):
        with tempfile.TemporaryDirectory() as folder:
            chosen = dc.replace(curve, fit=False) if options.no_fit else curve
            status, said = said_of(chosen, Path(folder))
        line = _line(curve, said)
        right = curve.verdict if is_right(curve, status, said) else "**wrong**"
        step = "import, fit" if chosen.fit else "import"
        rows.append((curve.name, step, line, ("used", "refused")[status != 0], right))
    page = f"{HEAD}\n{table('what the user did | commands | what was said | then | verdict', rows)}"
    publish(page, options.output)
    if options.output is not None:
        draw(options.output.parent / PICTURE)
    return int(any("wrong" in row[-1] for row in rows))


HEAD = """\
# Curves with something wrong

Import and calibration name the fault in all of these typical mistakes of a new user but three,
which cannot be told from good curves:

- kgf: a potato of 3 N is possible.
- A force that only grows is said to leave modulus and toughness open, as in many good curves.
- An offset cannot be taken off a curve that begins in the food.

The good curve is the paper's potato; `studies/calibration/adversarial.py` makes the others. "Used"
means that the commands end well, with or without a warning. "Right" means that the message names
the fault, or that a curve that can be used as it is gets none; the expected messages were written
down after an earlier run had been seen. The warning in the first row is about the coarse mesh, not
about the curve.

    python -m studies adversarial --output docs/results/adversarial_curves.md

![Force over time of six of the curves, as a user brings them](figures/adversarial_curves.png)
"""


def _line(curve: Curve, said: str) -> str:
    """The sentence that names the fault, or the first trouble."""
    lines = [line for line in said.splitlines() if line]
    hits = [line for line in lines if curve.expected and re.search(curve.expected, line)]
    hits = hits or TROUBLE.findall(said)
    return hits[0].replace("|", "/") if hits else "no fault"
