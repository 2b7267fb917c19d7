"""A part of the study of hidden effects: a fresh draw of single effects, pairs, unknowns and nulls.

Each diagnosis is a process of its own that sees a folder of records and a food, as
docs/results/hidden_effects.md says, which also gives how often it is right of 633 runs. What is cut
next (`poor` runs of that study) is protected by tests/test_next_experiment.py.
"""

import dataclasses as dc
import json
import secrets
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from sliceit_drake.configuration import dump_yaml
from studies.hidden_effects.bench import model_food, protocol_named
from studies.hidden_effects.cases import Case, Hidden
from studies.hidden_effects.runner import food_file
from studies.hidden_effects.score import Judgement, judge_study
from studies.hidden_effects.sizes import ProtocolSizes
from studies.hidden_effects.study import run_study
from studies.hidden_effects.truth import CAUSE_OF

pytestmark = pytest.mark.second_tier

REPLICATES = 100
MIN_RIGHT = 10
"""Fewest of the twelve runs that must be right."""
SINGLE = (
    "skin",
    "bulk_relaxation",
    "rate_toughness",
    "flank_adhesion",
    "sensor_drift",
    "sensor_tilt",
    "board_height",
    "blunt_edge",
    "drive_vibration",
)
OF_ONE_PRESS = ("core", "section_shape", "sensor_drift", "drive_vibration")
"""Effects that presses of one speed show."""
PAIRS = (("skin", "sensor_tilt"), ("rate_toughness", "sensor_tilt"))
UNKNOWN = ("magnetic_board", "warm_wrist")


def drawn(rng: np.random.Generator) -> list[Case]:
    """Runs of every kind; of what is hidden the strength stands in place of the size."""

    def case(kind: str, protocol: str, *effects: str) -> Case:
        hidden = tuple(Hidden(e, np.nan, float(rng.uniform(2.0, 3.0))) for e in effects)
        name = f"{rng.integers(16**10):010x}"
        return Case(name, kind, protocol, hidden, int(rng.integers(1, 2**31)))

    return [
        *(case("single", "rich", str(e)) for e in rng.choice(SINGLE, 5, replace=False)),
        *(case("single", "poor", str(e)) for e in rng.choice(OF_ONE_PRESS, 2, replace=False)),
        case("pairs", "rich", *PAIRS[rng.integers(len(PAIRS))]),
        *(case("unknown", "rich", effect) for effect in UNKNOWN),
        case("nothing", "rich"),
        case("nothing", "poor"),
    ]


def sized(cases: list[Case], protocol: str, output: Path) -> tuple[list[Case], dict]:
    """Cases of a protocol with the sizes of what is hidden, and the angles to all causes."""
    sizes = ProtocolSizes(protocol, output / "cache")
    found, near = [], {}
    for case in (c for c in cases if c.protocol == protocol):
        hidden = []
        for h in case.hidden:
            assert h.delta is not None
            hidden.append(dc.replace(h, size=sizes.size_about(h.effect, h.delta)))
            if h.effect in CAUSE_OF:
                near[h.effect] = sizes.angles_at(h.effect, hidden[-1].size)
        found.append(dc.replace(case, hidden=tuple(hidden)))
    return found, near


def is_wrong_name(judgement: Judgement) -> bool:
    """Whether something is named that was not hidden, nor mimics it; a class that is too large is
    a miss, but no wrong name."""
    return any(set(names) <= set(judgement.wrong) for names in judgement.classes)


def test_a_fresh_draw_of_effects_is_diagnosed_rightly(tmp_path):
    seed = secrets.randbits(31)
    print(f"seed {seed}")
    cases = drawn(np.random.default_rng(seed))
    assert len(cases) >= 12
    for name in ("rich", "poor"):
        food_file(tmp_path, name).parent.mkdir(exist_ok=True)
        dump_yaml(model_food(protocol_named(name)), food_file(tmp_path, name))
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        jobs = {n: pool.submit(sized, cases, n, tmp_path) for n in ("rich", "poor")}
        made = {name: job.result() for name, job in jobs.items()}
    (tmp_path / "truth").mkdir()
    cases = [case for found, _ in made.values() for case in found]
    for case in cases:
        file = tmp_path / "truth" / f"{case.name}.json"
        file.write_text(json.dumps(dc.asdict(case)), encoding="utf-8")
    for name, facts in (
        ("near", {name: near for name, (_, near) in made.items()}),
        ("classes", {name: {"classes": {}} for name in made}),
    ):
        (tmp_path / f"{name}.json").write_text(json.dumps(facts), encoding="utf-8")
    run_study(cases, tmp_path, REPLICATES, workers=2)

    judgements = judge_study(tmp_path)
    said = "\n".join(
        f"{'right' if j.right else 'WRONG'} {j.case.protocol} {j.effects}: {j.verdict} {j.classes}"
        for j in judgements
    )
    print(said)
    assert len(judgements) == len(cases)
    assert sum(j.right for j in judgements) >= MIN_RIGHT, f"seed {seed}\n{said}"
    # A confident wrong name is worse than a miss.
    assert not any(map(is_wrong_name, judgements)), f"seed {seed}\n{said}"
