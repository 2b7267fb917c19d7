"""Writes docs/results/benchmarks.md: each aim of the project with the value that was measured last.

It measures nothing: values are those that the studies wrote into a page or a JSON file of docs. A
test fails where the page is not what this makes of them.
"""

import argparse
import dataclasses as dc
import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from studies.benches.draw import LAWS
from studies.benches.score import Judged, judge, named_by, rates
from studies.benches.score import measured as with_values
from studies.learning.comparison import PAPER
from studies.pages import render

__all__ = ["Row", "add_arguments", "page", "run"]

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results"
NOT_MEASURED = "not measured"


@dc.dataclass(frozen=True)
class Row:
    """An aim.

    Attributes:
        what: Is aimed at.
        aim: In words.
        value: What was measured, or None.
        met: Whether it is reached; None without a value.
        command: That measures it.
        source: Where its value stands, relative to docs/results.
    """

    what: str
    aim: str
    value: str | None
    met: bool | None
    command: str
    source: str

    def cells(self) -> tuple[str, ...]:
        """A row of a table."""
        if self.value is None:
            verdict, value = "-", NOT_MEASURED
        else:
            verdict, value = ("reached" if self.met else "**missed**"), self.value
        name = f"[{Path(self.source).name}]({self.source})" if self.value else ""
        return (self.what, self.aim, value, verdict, f"`{self.command}`", name)


class Docs:
    """What stands in a folder of pages.

    Args:
        folder: With pages, and with `benchmarks/NAME.json`.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def text(self, name: str) -> str:
        """A page; empty where there is none."""
        file = self.folder / name
        return file.read_text(encoding="utf-8") if file.exists() else ""

    def values(self, name: str) -> Mapping[str, float]:
        """What a benchmark wrote; empty where it has not run."""
        text = self.text(f"benchmarks/{name}.json")
        return json.loads(text)["values"] if text else {}

    def facts(self, name: str) -> Any:
        """A JSON file of a study; None where there is none."""
        text = self.text(name)
        return json.loads(text) if text else None

    def numbers(self, name: str, pattern: str) -> tuple[float, ...] | None:
        """The groups of a pattern in a page; None where it is not there.

        Raises:
            ValueError: It is there several times.
        """
        found = re.findall(pattern, self.text(name), re.M)
        if len(found) > 1:
            raise ValueError(f"{name} has {pattern!r} {len(found)} times")
        if not found:
            return None
        groups = found[0] if isinstance(found[0], tuple) else (found[0],)
        return tuple(float(group) for group in groups)

    def cells(self, name: str, begin: str, count: int) -> list[str]:
        """The other cells of the row of a table that begins so and has as many; none without it.

        Raises:
            ValueError: There are several such rows.
        """
        rows = [line[2:-2].split(" | ") for line in self.text(name).splitlines()]
        first = begin.split(" | ")
        found = [r for r in rows if r[: len(first)] == first and len(r) == len(first) + count]
        if len(found) > 1:
            raise ValueError(f"{name} has {len(found)} rows that begin with {begin}")
        return found[0][len(first) :] if found else []


def named(found: tuple[float, ...] | None, *names: str) -> dict[str, float]:
    """What `Docs.numbers` found, by name; empty where it found nothing."""
    return dict(zip(names, found, strict=True)) if found else {}


def measured(
    what: str,
    aim: str,
    command: str,
    source: str,
    values: Mapping[str, float] | None,
    show: Callable[[Mapping[str, float]], tuple[str, bool]],
) -> Row:
    """The row of an aim, of values that may be absent."""
    value, met = show(values) if values else (None, None)
    return Row(what, aim, value, met, command, source)


def cutting(docs: Docs) -> tuple[Mapping[str, float], str]:
    """What a cut costs, and where that stands: JSON, or the page of an older run."""
    values = docs.values("cutting_speed")
    if values:
        return values, "benchmarks/cutting_speed.json"
    row = docs.numbers("speed.md", r"^\| 1728 \| (\d+\.\d) \| ([\d.]+) \| ([\d.]+) % \|$")
    step = docs.numbers("speed.md", r"^Force error of the sub-step against 5e-5 s: ([\d.]+) %")
    search = docs.numbers("speed.md", r"^\| 1728 \| 0\.001 \| ([\d.]+) \| ([\d.]+) % \|$")
    gradient = docs.numbers("speed.md", r"parameters and the path: ([\d.]+) slices")
    if row is None or step is None or search is None or gradient is None:
        return {}, "speed.md"
    return {
        "tetrahedra": 1728.0,
        "sub_step_us": row[0],
        "slice_s": row[1],
        "mesh_error": row[2] / 100.0,
        "step_error": step[0] / 100.0,
        "search_slice_s": search[0],
        "search_step_error": search[1] / 100.0,
        "gradient_slices": gradient[0],
    }, "speed.md"


def station(docs: Docs) -> tuple[Mapping[str, float], str]:
    """Real-time factors of the station, and where they stand."""
    values = docs.values("station_speed")
    if values:
        return values, "benchmarks/station_speed.json"
    found = docs.numbers(
        "speed.md", r"runs at ([\d.]+) times real time, and at ([\d.]+) with the spring"
    )
    names = ("real_time_factor", "spring_real_time_factor")
    return named(found, *names), "speed.md"


def speed_rows(docs: Docs) -> Iterator[Row]:
    """Aims for the simulation's cost."""
    command = "python -m studies cutting_speed --json docs/results/benchmarks/cutting_speed.json"
    values, source = cutting(docs)
    yield measured(
        "27 mm of cucumber, no robot, one core, defaults",
        "<= 0.10 s, >= 1,200 tetrahedra",
        command,
        source,
        values,
        lambda v: (
            f"{v['slice_s']:.3f} s: {v['tetrahedra']:.0f} tetrahedra, error of the mesh "
            f"{v['mesh_error']:.2%}, of the sub-step {v['step_error']:.2%} (with the sub-step of 1 "
            f"ms of a search {v['search_slice_s']:.3f} s, {v['search_step_error']:.2%})",
            v["slice_s"] <= 0.1 and v["tetrahedra"] >= 1200,
        ),
    )
    yield measured(
        "a sub-step of 1,500 tetrahedra, one core",
        "<= 36 us",
        command,
        source,
        values,
        lambda v: (
            f"{v['sub_step_us'] * 1500 / v['tetrahedra']:.1f} us, from {v['sub_step_us']:.1f} us "
            f"of {v['tetrahedra']:.0f}",
            v["sub_step_us"] * 1500 / v["tetrahedra"] <= 36.0,
        ),
    )
    yield measured(
        "gradient of a slice by all parameters and the path",
        "<= 6 slices",
        command,
        source,
        values,
        lambda v: (f"{v['gradient_slices']:.2f} slices", v["gradient_slices"] <= 6.0),
    )
    values, source = station(docs)
    yield measured(
        "station with arm and control while it cuts, one core",
        ">= 4 times real time",
        "python -m studies station_speed --json docs/results/benchmarks/station_speed.json",
        source,
        values,
        lambda v: (
            f"{v['real_time_factor']:.2g} (spring-only baseline "
            f"{v['spring_real_time_factor']:.2g})",
            v["real_time_factor"] >= 4.0,
        ),
    )
    page = "speed.md"
    found = docs.numbers(page, r"today's [\d.]+ to [\d.]+ us: ([\d.]+) times as fast")
    yield measured(
        "the same against the code of version 0.1 (20b84b1), in turns",
        ">= 2.4 times as fast",
        "python -m studies station_speed",
        page,
        named(found, "ratio"),
        lambda v: (f"{v['ratio']:g} times", v["ratio"] >= 2.4),
    )
    batch = docs.cells(page, "16", 4)
    yield measured(
        "a cut of a batch of 16, two cores",
        "<= 0.05 s",
        command,
        page,
        {"seconds": float(batch[-1])} if batch else None,
        lambda v: (f"{v['seconds']:g} s", v["seconds"] <= 0.05),
    )
    cuts = [int(n) for n in re.findall(r"^\| cuda:0 \| (\d+) \|", docs.text(page), re.M)]
    yield measured(
        "cuts side by side on a GPU",
        "1 to 4096",
        "python -m studies batch_speed",
        page,
        {"most": max(cuts)} if cuts else None,
        lambda v: (f"1 to {v['most']}", v["most"] >= 4096),
    )
    values = docs.values("first_run")
    yield measured(
        "from the installed wheel to the first picture, kernels compiled",
        "<= 60 s",
        "python -m studies first_run --json docs/results/benchmarks/first_run.json",
        "benchmarks/first_run.json",
        values,
        lambda v: (
            f"{v['first_picture_s']:.0f} s (the second {v['second_picture_s']:.0f} s; installing "
            f"took {v['install_s']:.0f} s)",
            v["first_picture_s"] <= 60.0,
        ),
    )


def learning_rows(docs: Docs) -> Iterator[Row]:
    """Aims for the cost of learning."""
    values, source = docs.values("learning_speed"), "benchmarks/learning_speed.json"
    command = (
        "python -m studies learning_speed --output docs/results/learning.md "
        "--json docs/results/benchmarks/learning_speed.json"
    )

    def rate(name: str) -> float:
        return values[f"{name}_2_decisions_a_second"]

    def minutes(name: str) -> float:
        return 80_000 / rate(name) / 60.0

    yield measured(
        "80,000 decisions of SAC, two cores, two environments, learning included",
        "<= 20 min",
        command,
        source,
        values,
        lambda _: (
            f"{minutes('cutting'):.0f} min, from {rate('cutting'):.1f} decisions a second",
            minutes("cutting") <= 20.0,
        ),
    )
    yield measured(
        "the same against the spring-only baseline",
        "<= 1.3 times its time",
        command,
        source,
        values,
        lambda _: (
            f"{rate('spring') / rate('cutting'):.2f} ({rate('cutting'):.1f} and "
            f"{rate('spring'):.1f} decisions a second)",
            rate("spring") / rate("cutting") <= 1.3,
        ),
    )


FORCE_RATIO = 0.55
BOARD_RATIO = 0.4
USUAL_BOARD = 3e4


def slicing_rows(docs: Docs) -> Iterator[Row]:
    """Aims for what a policy of the cutting simulator is worth, on the usual board but for one."""
    command = (
        "python -m studies slicing docs/results/slicing_evaluation.jsonl "
        "--policies models/policies/cutting_0 models/policies/spring_0 --output docs/results"
    )
    source = "slicing_results.md"
    facts = docs.facts("slicing_results.json") or []
    by_case = {(f["world"], f["food"]): f for f in facts if f["board_stiffness"] == USUAL_BOARD}
    highest = value = None
    if facts:
        highest = max(max(f["ratios"]["median_force"][2], f["strict_ratio"][2]) for f in facts)
        boards = sorted({f["board_stiffness"] for f in facts})
        listed = ", ".join(f"{board / 1e3:g}" for board in boards)
        value = f"<= {highest:.2f} in {len(facts)} cases, boards of {listed} kN/m"
    yield Row(
        "contact force, ours over spring only, unfinished slices of ours counted as the worst of "
        "the baseline's: every food, world and board",
        "interval below 1",
        value,
        None if highest is None else highest < 1.0,
        command,
        source,
    )
    for world in ("curves", "stand_in"):
        name = world.replace("_", "-")
        for food, paper in PAPER.items():
            case = by_case.get((world, food))
            for metric, of, least in (
                ("median_force", "contact force", paper),
                ("board_peak", "peak force on the board", BOARD_RATIO),
            ):
                value = met = None
                if case is not None:
                    ratio, low, high = case["ratios"][metric]
                    value = f"{ratio:.2f} ({low:.2f} to {high:.2f})"
                    met = ratio <= least and high < 1.0
                yield Row(
                    f"{of}, ours over spring only: {food}, {name} world",
                    f"<= {least:g}, interval below 1",
                    value,
                    met,
                    command,
                    source,
                )
        done = [f["completed"]["cutting"] for (w, _), f in by_case.items() if w == world]
        share = f"{100 * sum(done) / len(done):.1f} % on average over foods" if done else None
        met = min(done) == 1.0 if done else None
        yield Row(f"slices completed by ours, {name} world", "all", share, met, command, source)


def corrected_rows(docs: Docs) -> Iterator[Row]:
    """Aims for policies that correct a rule: force and time on the usual board, the end on all."""
    command = (
        "python -m studies slicing docs/results/corrected_evaluation.jsonl "
        "docs/results/slicing_evaluation.jsonl --ours corrected --output docs/results"
    )
    source = "corrected_results.md"
    facts = docs.facts("corrected_results.json") or []
    usual = [f for f in facts if f["board_stiffness"] == USUAL_BOARD]
    for metric, of, least in (
        ("median_force", "contact force", FORCE_RATIO),
        ("duration", "time", 1.0),
        ("board_peak", "peak force on the board", BOARD_RATIO),
    ):
        found = sorted(f["ratios"][metric][0] for f in usual)
        yield Row(
            f"{of}, corrections of a rule over spring only: every food and world",
            f"<= {least:g}",
            f"{found[0]:.2f} to {found[-1]:.2f}" if found else None,
            found[-1] <= least if found else None,
            command,
            source,
        )
    done = [f["completed"]["cutting"] for f in facts]
    yield Row(
        "slices completed by corrections of a rule: every food, world and board",
        "all",
        f"{100 * min(done):.1f} to {100 * max(done):.1f} %" if done else None,
        min(done) == 1.0 if done else None,
        command,
        source,
    )


def calibration_rows(docs: Docs) -> Iterator[Row]:
    """Aims for calibrations: error, time, and what their bands and intervals hold."""
    source = "../explanation/calibration.md"
    number = r"([\d.]+)"
    for food, timed in (
        ("cucumber", "tomato cucumber"),
        ("tomato", "tomato cucumber"),
        ("potato", "potato"),
    ):
        found = docs.numbers(source, rf"^\| {food} \| {number} (?:\| [\d.]+ ){{4}}\| [^|]+ \|$")
        yield measured(
            f"error on the measured {food}",
            "<= half of DiSECt's",
            "python -m studies calibration --output FOLDER",
            source,
            named(found, "ratio"),
            lambda v: (f"{v['ratio']:.2f} of that half", v["ratio"] <= 1.0),
        )
        found = docs.numbers(source, rf"^\| {food} \| (\d+) \| (\d+) \| \d+ \| [\d.]+ \|$")
        yield measured(
            f"`sliceit calibrate`, {food}: first picture, and in all",
            "<= 60 s and 300 s",
            f"python -m studies calibration_times --foods {timed}",
            source,
            named(found, "first", "all"),
            lambda v: (
                f"{v['first']:.0f} s, {v['all']:.0f} s",
                v["first"] <= 60 and v["all"] <= 300,
            ),
        )
        found = docs.numbers(source, rf"^\| {food} \| [\d.]+ \| [\d.]+ \| (\d+) % \| {number} \|$")
        yield measured(
            f"lower half of the {food} by a fit to the upper half: in the 90 % band, its width",
            ">= 90 %, <= 1.5 of the force",
            "python -m studies half_depth --output docs/figures/half_depth.png",
            source,
            named(found, "inside", "width"),
            lambda v: (
                f"{v['inside']:.0f} %, {v['width']:g} of the force",
                v["inside"] >= 90.0 and v["width"] <= 1.5,
            ),
        )
    found = docs.numbers(source, rf"of 2 mm, left out in two sets, are predicted with {number} N")
    yield measured(
        "blocks of 2 mm of the tomato that were left out",
        "<= 2.7 N",
        "python -m studies calibration --output FOLDER",
        source,
        named(found, "error"),
        lambda v: (f"{v['error']:g} N", v["error"] <= 2.7),
    )
    for law in ("slice_push", "bonds"):
        for record in ("same speed", "other speeds", "draws"):
            found = docs.numbers(
                source,
                rf"^\| {law} \| {record} \| \d+ \| (\d+) % \| [\d.]+ \| {number} \| \d+ % "
                rf"\| {number} \|$",
            )
            yield measured(
                f"90 % bands on {law}, {record}: what they hold, and their interval score",
                "85 to 95 %, less than of a constant width",
                "python -m studies bands --laws slice_push bonds --draws 6",
                source,
                named(found, "inside", "score", "constant"),
                lambda v: (
                    f"{v['inside']:.0f} %, {v['score']:g} N of {v['constant']:g} N",
                    85.0 <= v["inside"] <= 95.0 and v["score"] < v["constant"],
                ),
            )
    found = docs.numbers("coverage.md", rf"^All parameters together: \*\*{number} %\*\*")
    yield measured(
        "90 % intervals of parameters, the knife turning round",
        "hold the truth in 85 to 95 %",
        "python -m studies coverage --replicates 12 --output docs/results",
        "coverage.md",
        named(found, "inside"),
        lambda v: (f"{v['inside']:g} %", 85.0 <= v["inside"] <= 95.0),
    )


STEP_AIMS = {
    "press and draw, 20 mm/s": (0.5, None),
    "press and draw, 100 mm/s": (0.5, None),
    "holds, 20 mm/s": (1.0, None),
    "holds, 100 mm/s": (1.0, None),
    "turning round, 5 to 100 mm/s": (1.5, 10.0),
}
"""By motion the RMS error of the sub-step that is allowed, and the largest over the peak, %."""


def stepping_rows(docs: Docs) -> Iterator[Row]:
    """Aims for the error of the sub-step, of the worst of five foods and of the station."""
    command, source = "python -m studies stepping --output FOLDER", "stepping.md"
    for motion, (limit, peak) in STEP_AIMS.items():
        cells = docs.cells(source, motion, 6)[1:]
        errors = [[float(x) for x in re.findall(r"[\d.]+(?= %)", cell)] for cell in cells]
        value = met = None
        if errors:
            rms, largest = (max(column) for column in zip(*errors, strict=True))
            value = f"{rms:.2f} %" + (f", {largest:g} %" if peak else "")
            met = rms <= limit and (peak is None or largest <= peak)
        yield Row(
            f"error of the sub-step, {motion}: the worst of five foods",
            f"<= {limit:g} % RMS" + (f", {peak:g} % of the peak" if peak else ""),
            value,
            met,
            command,
            source,
        )
    runs = ("cucumber_measured", "cucumber_measured, held half way", "cucumber_policy")
    rows = [docs.cells(source, f"{run} | 0.001", 7) for run in runs]
    value = met = None
    if all(rows):
        rms, largest = (max(float(row[k]) for row in rows) for k in (0, 1))
        value, met = f"{rms:g} %, {largest:g} %", rms <= 1.5 and largest <= 10.0
    yield Row(
        "the same in the station, with a retract, a hold and a policy",
        "<= 1.5 % RMS, 10 % of the peak",
        value,
        met,
        command,
        source,
    )


def accuracy_rows(docs: Docs) -> Iterator[Row]:
    """Aims for what the physics computes."""
    results = docs.facts("verification.json")
    values = results and {"mesh": results["mesh"]["estimate"], "step": results["step"]["estimate"]}
    yield measured(
        "discretisation error of mesh and step at the defaults (Richardson)",
        "<= 2 % RMS",
        "python -m studies verification --output docs/results/verification.md",
        "verification.md",
        values,
        lambda v: (
            f"{v['mesh']:.1%} of the mesh, {v['step']:.2%} of the sub-step",
            v["mesh"] + v["step"] <= 0.02,
        ),
    )
    yield from stepping_rows(docs)
    contact = docs.facts("data/contact.json")
    changes = {
        name: max(abs(float(row[k].split(" %")[0])) for row in contact["values"]["rows"])
        for name, k in (("stiff", 2), ("mesh", 4))
        if contact
    }
    yield measured(
        "largest change of the force with a flank contact 4 times as stiff, and mesh twice as fine",
        "<= 2 % each",
        "python -m studies contact --output docs/results/contact.md",
        "contact.md",
        changes,
        lambda v: (f"{v['stiff']:g} %, {v['mesh']:g} %", max(v.values()) <= 2.0),
    )
    counts = docs.numbers("random_slices.md", r"^\| all \| (\d+) \| (\d+) \| (\d+) \| (\d+) \|$")
    names = ("cut", "refused", "stopped", "unexplained")
    yield measured(
        "200 random slices: cut, or a reason",
        "none unexplained",
        "python -m studies random --count 200 --seed 1 --output docs/results",
        "random_slices.md",
        named(counts, *names),
        lambda v: (
            ", ".join(f"{v[name]:.0f} {name}" for name in names),
            v["unexplained"] == 0.0 and sum(v.values()) >= 200,
        ),
    )


def diagnosis_rows(docs: Docs) -> Iterator[Row]:
    """Aims for the diagnosis."""
    values, source = docs.values("diagnosis_speed"), "benchmarks/diagnosis_speed.json"
    command = f"python -m studies diagnosis_speed --json docs/results/{source}"
    for key, what, limit in (
        ("cold_s", "diagnosis of 18 records, all causes", 90.0),
        ("warm_s", "the same again, with what it has kept", 15.0),
    ):
        value = met = None
        if values:
            value = f"{values[key]:.1f} s, {values['records']:.0f} records"
            met = values[key] <= limit and values["records"] >= 18
        yield Row(what, f"<= {limit:.0f} s", value, met, command, source)
    study = docs.facts("hidden_effects.json") or {"requirements": []}
    for row in study["requirements"]:
        shown = f", {row['shown']}" if row["shown"] else ""
        yield Row(
            f"hidden effects: {row['what']}",
            row["asked"],
            f"{row['hits']} of {row['runs']}{shown}",
            row["met"],
            "python -m studies score docs/results/hidden_effects.jsonl --output docs/results",
            "hidden_effects.md",
        )


BENCH_AIMS = {
    "named rightly": ("right, where the effect is twice noise and misfit or more", 0.9, 0.95),
    "wrongly": ("wrong there", 0.05, 0.02),
    "material beside": ("a material cause named beside it", 0.1, 0.1),
    "alarm, nothing hidden": ("bench or sensor cause named where nothing is hidden", 0.03, 0.03),
    "unlisted: no name": ("no name for what stands in no list", 0.9, 0.9),
    "of the right cause's gain": ("gain on left-out records, of the right cause's", 0.8, 0.8),
}
"""By column of the table: what it is, the share that is aimed at, and that on finite elements."""
BENCH_DRAWS = 12


def bench_rows(docs: Docs) -> Iterator[Row]:
    """Aims for the diagnosis under other laws, with the newest rule that was reported on."""
    source = "benches.md"
    lines = docs.text("benches_report.jsonl").splitlines()
    reported = [json.loads(line) for line in lines]
    newest = [facts for facts in reported if facts["commit"] == reported[-1]["commit"]]
    for law in LAWS:
        judged: dict[int, list[Judged]] = {}
        for facts in newest:
            if facts["case"]["law"] == law and (hidden := facts["hidden"]) is not None:
                found = judge(named_by("diagnosis", facts, "earlier"), hidden, "earlier")
                found = with_values(found, facts["earlier"], hidden)
                judged.setdefault(facts["case"]["draw"], []).append(found)
        shares = rates(judged, np.random.default_rng(0)) if judged else {}
        for title, (what, *limits) in BENCH_AIMS.items():
            limit = limits[law == "finite_elements"]
            least = limit > 0.5
            value = met = None
            if title in shares:
                share, *_, runs = shares[title]
                share_of = title.endswith("gain")
                hits = (
                    f"{100 * share:.0f} %, {runs} runs"
                    if share_of
                    else f"{share * runs:.0f} of {runs}"
                )
                value = f"{hits}, {len(judged)} draws"
                met = len(judged) >= BENCH_DRAWS and (share >= limit if least else share <= limit)
            yield Row(
                f"{law}: {what}",
                f"{'>=' if least else '<='} {100 * limit:.0f} % of >= {BENCH_DRAWS} draws",
                value,
                met,
                "python -m studies bench_score docs/results/benches_report.jsonl",
                source,
            )


MOTION_RATIO = 1.15


def motion_rows(docs: Docs) -> Iterator[Row]:
    """Aims for the corrections of a rule beside motions that were optimised for the food."""
    facts = docs.facts("data/policy_and_motion.json")
    rows = facts["values"]["rows"] if facts else []
    pairs = {p[0]: (p, m) for p, m in zip(rows, rows[1:], strict=False) if p[1] == "corrected_0"}
    for food in PAPER:
        value = met = None
        if food in pairs:
            (_, _, _, force, *_, time), (_, _, _, least, *_, its_time) = pairs[food]
            ratio, of_time = (
                float(x.split()[0]) / float(y.split()[0])
                for x, y in ((force, least), (time, its_time))
            )
            value, met = f"{ratio:.2f} in {of_time:.2f} of its time", ratio <= MOTION_RATIO
        yield Row(
            f"contact force, corrections of a rule over the optimised motion: {food}",
            f"<= {MOTION_RATIO:g} at equal time",
            value,
            met,
            "python -m studies policy_and_motion models/policies/cutting_0 "
            "models/policies/corrected_0 --output docs/results/learning.md",
            "learning.md",
        )


def robot_rows(docs: Docs) -> Iterator[Row]:
    """Aims for the robot's path, on the emulated controller."""
    source = "robot_faults.md"
    command = "python -m studies faults --output docs/results"
    found = docs.numbers(source, r"^(\d+) of (\d+) faults added less than 1 mm")
    yield measured(
        "faults that leave the edge within 1 mm and the force within 5 N",
        "all of >= 60",
        command,
        source,
        named(found, "held", "faults"),
        lambda v: (
            f"{v['held']:.0f} of {v['faults']:.0f}",
            v["held"] == v["faults"] and v["faults"] >= 60,
        ),
    )
    found = docs.numbers(source, r"^(\d+) of (\d+) slices without a fault were stopped")
    yield measured(
        "slices without a fault that were stopped",
        "none of >= 200",
        command,
        source,
        named(found, "stopped", "slices"),
        lambda v: (
            f"{v['stopped']:.0f} of {v['slices']:.0f}",
            v["stopped"] == 0 and v["slices"] >= 200,
        ),
    )


def whole_rows(docs: Docs) -> Iterator[Row]:
    """Aims for the program as a whole."""
    facts = docs.facts("data/endurance.json")
    yield measured(
        "memory over the second half of an hour of slices",
        "<= 10 MB an hour",
        "python -m studies endurance --minutes 60 --output docs/results/endurance.md",
        "endurance.md",
        facts and facts["values"],
        lambda v: (f"{v['slope']:+.1f} MB an hour", v["slope"] <= 10.0),
    )
    facts = docs.facts("data/soak.json")
    value = met = None
    if facts:
        found = facts["values"]
        runs, kills = (sum(row[k] for row in found["rows"]) for k in (1, 2))
        value = f"{runs} runs, {kills} calls killed, {len(found['lost'])} things lost"
        met = not found["lost"] and found["minutes"] >= 60.0
    yield Row(
        "simulate, calibrate, diagnose, train, emulate side by side for an hour, killed at random",
        "nothing lost, memory flat",
        value,
        met,
        "python -m studies soak --minutes 60 --output docs/results/soak.md",
        "soak.md",
    )


SECTIONS = {
    "Cost of the simulation": speed_rows,
    "Accuracy": accuracy_rows,
    "Calibration": calibration_rows,
    "Diagnosis": diagnosis_rows,
    "Diagnosis under other laws": bench_rows,
    "Learning": learning_rows,
    "Slicing with what was learnt": slicing_rows,
    "Slicing with corrections of a rule": corrected_rows,
    "Policies beside optimised motions": motion_rows,
    "The robot's path": robot_rows,
    "The whole": whole_rows,
}


def page(folder: Path = RESULTS) -> str:
    """The page of what stands in a folder."""
    docs = Docs(folder)
    sections = {title: list(rows_of(docs)) for title, rows_of in SECTIONS.items()}
    rows = [row for of_section in sections.values() for row in of_section]
    known = [row for row in rows if row.value is not None]
    met = sum(bool(row.met) for row in known)
    files = sorted((folder / "benchmarks").glob("*.json"))
    return render(
        "benchmarks",
        sections={title: [row.cells() for row in rows] for title, rows in sections.items()},
        missing=[
            title for title, rows in sections.items() if any(row.met is False for row in rows)
        ],
        aims=len(rows),
        met=met,
        missed=len(known) - met,
        unknown=len(rows) - len(known),
        machines={
            file.name: json.loads(file.read_text(encoding="utf-8"))["machine"] for file in files
        },
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds nothing: the study has no arguments."""


def run(options: argparse.Namespace) -> int:
    """Writes the page."""
    (RESULTS / "benchmarks.md").write_text(page(), encoding="utf-8")
    return 0
