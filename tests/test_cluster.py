"""What is made on a cluster is what one process makes."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import warp
from example_slices import HEIGHT, short_press

from sliceit_drake import cluster
from sliceit_drake.calibration.setup import CalibrationSetup, ParameterRange
from sliceit_drake.cli.main import main
from sliceit_drake.configuration import ConfigurationError, dump_yaml
from sliceit_drake.cutting.driver import Driver
from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, MotionPlan
from sliceit_drake.diagnosis.causes.material import SkinToughness
from sliceit_drake.diagnosis.prediction import ActiveCause, Point, SlicePredictor
from sliceit_drake.prediction.cluster import on_cluster
from sliceit_drake.prediction.record_target import Meshing
from sliceit_drake.prediction.simulator import Workers
from sliceit_drake.stand_in.protocol import Condition, Protocol
from studies.__main__ import main as studies
from studies.hidden_effects import runner
from studies.hidden_effects.bench import model_food
from studies.hidden_effects.cases import Case, Hidden
from studies.hidden_effects.runner import food_file, run_case
from studies.hidden_effects.study import run_study

distributed = pytest.importorskip("distributed")

QUIET = {"dashboard_address": "127.0.0.1:0", "worker_dashboard_address": "127.0.0.1:0"}


@pytest.fixture(scope="module")
def local():
    """Two workers in processes of their own."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", **QUIET
    ) as local:
        yield local


def points() -> list[Point]:
    """Points of two meshes, with other materials and another food."""
    finer = Meshing(refinement=1.0)
    skin = ActiveCause(SkinToughness(), {"toughness": 1.0, "thickness": 1.2e-3})
    return [
        Point(),
        Point({"material.toughness": 220.0}),
        Point(causes=(skin,)),
        Point(meshing=finer),
        Point({"material.friction": 0.2}, meshing=finer),
    ]


def predictor(workers: Workers = 1) -> SlicePredictor:
    setup = CalibrationSetup(
        food=Food(shape=Cylinder(HEIGHT, 0.06, 3, [0.0, 0.004, 0.012]), hold_distance=0.0119),
        parameters=[ParameterRange("material.toughness", 50.0, 1000.0)],
    )
    return SlicePredictor(setup, [short_press()], (Meshing(0.5), Meshing(1.0)), workers=workers)


def test_slices_on_a_cluster_are_those_of_one_process(local, monkeypatch):
    alone = [row[0].wrench for row in predictor().predict(points())]
    with on_cluster(local.scheduler_address) as workers:
        # Of this process alone: the workers are others.
        monkeypatch.setattr(Driver, "run", None)
        spread = predictor(workers)
        seen: list[tuple[int, int]] = []
        rows = spread.predict(points(), lambda done, of: seen.append((done, of)))
    assert seen[-1] == (5, 5) and spread.simulator.simulated == 5
    for one, (other,) in zip(alone, rows, strict=True):
        assert np.abs(one).max() > 0.1
        np.testing.assert_array_equal(one, other.wrench)


def test_a_scheduler_that_does_not_answer_is_named_with_what_to_do():
    with pytest.raises(ConfigurationError, match="tcp://127.0.0.1:9") as error:
        with on_cluster("tcp://127.0.0.1:9", patience=0.5):
            pass
    assert error.value.field == "--scheduler" and "dask scheduler" in error.value.fix


def small_protocol() -> Protocol:
    plan = MotionPlan(
        [
            Hold(duration=0.05, label="air"),
            ConstantSpeed(distance=0.01, speed=0.1, acceleration=5.0, label="slice"),
        ]
    )
    food = Food(shape=Cylinder(HEIGHT, 0.06, 3, [0.0, 0.004, 0.012]), hold_distance=0.0119)
    return Protocol(food=food, conditions=[Condition("press", plan, replicates=3)])


def contents(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}


def test_records_of_a_cluster_are_those_of_one_process(local, tmp_path):
    file = tmp_path / "small.yaml"
    dump_yaml(small_protocol(), file)
    command = ["record", str(file), "--seed", "5", "--effect", "skin:0.5", "--refinement", "0.5"]
    command += ["--time-step", "5e-4"]
    alone, spread = tmp_path / "alone", tmp_path / "spread"
    assert main([*command, "--workers", "1", "--output", str(alone)]) == 0
    # One was there: it is neither made nor touched again.
    spread.mkdir()
    for name in ("slice_001.csv", "slice_001.yaml"):
        (spread / name).write_bytes((alone / name).read_bytes())
    kept = (spread / "slice_001.csv").stat().st_mtime_ns
    where = ["--backend", "dask", "--scheduler", local.scheduler_address]
    assert main([*command, *where, "--output", str(spread)]) == 0
    assert len(contents(alone)) == 6 and contents(spread) == contents(alone)
    assert (spread / "slice_001.csv").stat().st_mtime_ns == kept


def fake_diagnosis(command: list[str], cwd: Path, **_: object) -> object:
    """Digests what a diagnosis reads, in place of hours of simulations."""
    h = hashlib.sha256(Path(command[command.index("--model") + 1]).read_bytes())
    for file in sorted(Path(cwd, "records").iterdir()):
        h.update(file.read_bytes())
    cache = Path(command[command.index("--cache") + 1])
    assert cache.is_dir()
    (cache / h.hexdigest()).touch()
    result = Path(cwd) / command[command.index("--output") + 1]
    result.mkdir()
    (result / "diagnosis.json").write_text(json.dumps({"digest": h.hexdigest()}))

    class Done:
        returncode, stdout, stderr = 0, "a table", ""

    return Done()


def test_a_sweep_on_a_cluster_is_that_of_one_process(tmp_path, monkeypatch):
    # Asks the system for the processor's name, by a program.
    warp.init()
    monkeypatch.setattr(runner.subprocess, "run", fake_diagnosis)
    monkeypatch.setattr(runner, "protocol_named", lambda name: small_protocol())
    cases = [
        Case(f"c0ffe{k}", "single", "poor", (Hidden("toughness", 0.1 * k, 2.0),), k)
        for k in range(3)
    ]
    outputs = [tmp_path / "alone", tmp_path / "spread"]
    for output in outputs:
        food_file(output, "poor").parent.mkdir(parents=True)
        dump_yaml(model_food(small_protocol()), food_file(output, "poor"))
        (output / "cache").mkdir()
    for case in cases:
        run_case(case, outputs[0], 10)
    # Workers in this process: what is replaced above is replaced for them.
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, **QUIET
    ) as local:
        with cluster.connected(local.scheduler_address) as client:
            # Runs that are there are not made again.
            run_case(cases[1], outputs[1], 10)
            made = (outputs[1] / "runs" / cases[1].name / "timing.json").stat().st_mtime_ns
            assert run_study(cases, outputs[1], 10, client=client) == 3
    assert (outputs[1] / "runs" / cases[1].name / "timing.json").stat().st_mtime_ns == made
    digests = set()
    for case in cases:
        alone, spread = (contents(output / "runs" / case.name) for output in outputs)
        assert (
            json.loads(spread.pop("timing.json")).keys()
            == json.loads(alone.pop("timing.json")).keys()
        )
        assert set(alone) == {"diagnosis.json", "table.txt"} and spread == alone
        digests.add(alone["diagnosis.json"])
    assert len(digests) == 3


def pretend(version: str) -> None:
    cluster.code_version = lambda: version


def test_workers_of_another_version_are_refused(local):
    with distributed.Client(local.scheduler_address, set_as_default=False) as client:
        client.run(pretend, "another")
        try:
            with pytest.raises(ConfigurationError, match="another version") as error:
                with cluster.connected(local.scheduler_address):
                    pass
        finally:
            client.run(pretend, cluster.code_version())
    assert error.value.field == "--scheduler" and "Install" in error.value.fix


@pytest.mark.parametrize(
    ("program", "command"),
    [
        (main, ["record"]),
        (main, ["diagnose", "records", "--model", "cucumber"]),
        (studies, ["hidden"]),
    ],
)
def test_a_backend_without_its_scheduler_is_refused(
    program, command, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "records").mkdir()
    assert program([*command, "--output", str(tmp_path), "--backend", "dask"]) == 2
    assert "--scheduler: is not given" in capsys.readouterr().err
