"""docs/results/hidden_effects.md is what the runs beside it come to."""

import json
from pathlib import Path

from studies.__main__ import main

DOCS = Path(__file__).resolve().parent.parent / "docs/results"
RUNS = DOCS / "hidden_effects.jsonl"


def test_the_page_is_made_from_the_runs_and_says_how_they_were(tmp_path, capsys):
    assert main(["score", str(RUNS), "--output", str(tmp_path)]) == 0
    for name in ("hidden_effects.md", "hidden_effects.json", "hidden_effects.jsonl"):
        made = (tmp_path / name).read_text(encoding="utf-8")
        assert made == (DOCS / name).read_text(encoding="utf-8"), f"python -m studies score {RUNS}"
    study = json.loads(RUNS.read_text(encoding="utf-8").splitlines()[0])["study.json"]
    options = f"--seed {study['seed']} --replicates {study['replicates']}"
    assert (
        f"    python -m studies hidden --output output/hidden {options}" in capsys.readouterr().out
    )
