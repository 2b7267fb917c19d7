"""Renders all pages and tables of docs/ that studies write, from stored results.

Nothing is measured: templates are filled with the values in the folder data beside a page, and
pages whose results stand in docs/results/*.json and *.jsonl are made from these. For changes of a
template, and to see that a page is what was measured. `architecture` and the studies that draw
figures are not run.
"""

import argparse
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path

from studies.benches import report as bench_report
from studies.benches.score import answers_of
from studies.calibration import coverage
from studies.hidden_effects.archive import unpack
from studies.hidden_effects.report import report
from studies.hidden_effects.score import judge_study
from studies.hidden_effects.study import read_facts
from studies.learning import comparison, faster_draws
from studies.marked_page import Place
from studies.pages import RESULTS, render
from studies.physics import foods_page
from studies.physics.verification_page import verification_page
from studies.project import aims
from studies.robot import faults

__all__ = ["add_arguments", "run", "stored_pages"]


def stored_pages(docs: Path) -> dict[str, str]:
    """Text of each page that shows stored results, by its file relative to docs.

    Args:
        docs: Folder of pages and results. Of a page that is written by hand only the marked places
            change.
    """
    pages = dict(_whole_pages(docs))
    for name, page, text in _places(docs):
        old = pages.get(page) or (docs / page).read_text(encoding="utf-8")
        pages[page] = Place(name).put(old, text, page)
    return pages


def _whole_pages(docs: Path) -> Iterator[tuple[str, str]]:
    """Name and text of each page that is rendered as a whole."""
    yield from ((page, text) for _, page, text in _rendered(docs, whole=True))
    results = docs / "results"
    yield "results/benchmarks.md", aims.page(results)
    verified = json.loads((results / "verification.json").read_text(encoding="utf-8"))
    yield "results/verification.md", verification_page(verified)
    rows: list[dict] = []
    for ours, (stem, _) in comparison.WHOSE.items():
        lines = (results / f"{stem}_evaluation.jsonl").read_text(encoding="utf-8").splitlines()
        rows += map(json.loads, lines)
        found = comparison.compare(rows, ours)
        equal = comparison.compare(rows, ours, comparison.EQUAL)
        yield f"results/{stem}_results.md", comparison.comparison_page(found, ours, equal)
    replicates = results / "coverage.jsonl"
    count = len(replicates.read_text(encoding="utf-8").splitlines())
    problem = coverage.Problem()
    command = f"python -m studies coverage --replicates {count} --output docs/results"
    # All replicates are there: none is computed.
    measured = coverage.coverage_study(problem, count, replicates)
    yield "results/coverage.md", coverage.coverage_page(problem, measured, command)
    yield "results/robot_faults.md", faults.page(faults.read(results / "robot_faults.jsonl"))
    with tempfile.TemporaryDirectory() as folder:
        study = Path(folder)
        unpack(results / "hidden_effects.jsonl", study)
        judged, facts = judge_study(study), read_facts(study / "study.json")
    yield "results/hidden_effects.md", report(judged, "figures/hidden_effects.png", facts)


def _places(docs: Path) -> Iterator[tuple[str, str, str]]:
    """Name, page and text of each marked place."""
    yield from _rendered(docs, whole=False)
    yield "foods", "reference/foods.md", foods_page.foods_table()
    yield "knives", "reference/foods.md", foods_page.knives_table()
    command = (
        "python -m studies faster_draws docs/results/slicing_evaluation.jsonl"
        " docs/results/faster_draws.jsonl --output docs/results/learning.md"
    )
    results = docs / "results"
    evaluation, faster = results / "slicing_evaluation.jsonl", results / "faster_draws.jsonl"
    reports = answers_of(results / "benches_report.jsonl")
    yield "bench_rates", "results/benches.md", bench_report.newest_rates(reports)
    yield "bench_runs", "results/benches.md", bench_report.runs_by_rule(reports)
    table = faster_draws.draws_table(evaluation, faster, command)
    yield "faster_draws", "results/learning.md", "\n".join(table)


def _rendered(docs: Path, whole: bool) -> Iterator[tuple[str, str, str]]:
    """Name, page and text of each template whose values are stored, of whole pages or of places."""
    for file in sorted(docs.rglob(f"{RESULTS}/*.json")):
        facts = json.loads(file.read_text(encoding="utf-8"))
        if facts["whole"] == whole:
            page = file.parent.with_name(facts["page"]).relative_to(docs).as_posix()
            yield file.stem, page, render(file.stem, **facts["values"]).rstrip("\n")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument(
        "--docs", metavar="FOLDER", type=Path, default=Path("docs"), help="pages; default: docs"
    )


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    for name, text in stored_pages(options.docs).items():
        (options.docs / name).write_text(text.rstrip("\n") + "\n", encoding="utf-8")
        print(f"wrote {options.docs / name}")
    return 0
