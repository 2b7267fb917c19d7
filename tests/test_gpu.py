"""Kernels on a GPU give what they give on the CPU; without one that is said, and nothing fails."""

import dataclasses as dc
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.batch import simulate_batch
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.gradient import SliceAdjoint
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import CuttingModel, Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan
from sliceit_drake.cutting.parameters import with_parameters
from sliceit_drake.cutting.workspace import Workspace
from studies.__main__ import main
from studies.physics import batch_speed

ROOT = Path(__file__).resolve().parent.parent
PERIOD = 2e-3


def cuts(device: str) -> list[CuttingModel]:
    food = Food(shape=Cylinder(rings=2, layers=[0.0, 4e-3, 12e-3]))
    base = make_food_model(food, Knife(), dc.replace(Numerics(precision="float64"), device=device))
    return [with_parameters(base, {"material.toughness": r}) for r in (250.0, 350.0, 450.0)]


def test_a_batch_on_a_gpu_is_that_on_the_cpu():
    if not wp.is_cuda_available():
        pytest.skip("no CUDA device on this machine: CPU and GPU are not compared")
    results = {}
    for device in ("cpu", "cuda:0"):
        models = cuts(device)
        plan = MotionPlan([ConstantSpeed(distance=0.02, speed=0.1)])
        motion = Motion(plan, start_pose(models[0], 1e-3))
        results[device] = simulate_batch(models, [motion], PERIOD)
    for here, there in zip(results["cpu"], results["cuda:0"], strict=True):
        assert here.failure is None and there.failure is None
        size = np.abs(here.food_wrench).max(0)
        # The order of sums differs, in double precision.
        np.testing.assert_array_less(
            np.abs(here.food_wrench - there.food_wrench).max(0), 1e-6 * size.max()
        )
        np.testing.assert_allclose(there.cut, here.cut, atol=1e-9)


def test_a_gradient_on_a_gpu_is_that_on_the_cpu():
    if not wp.is_cuda_available():
        pytest.skip("no CUDA device on this machine: CPU and GPU are not compared")
    found = []
    for device in ("cpu", "cuda:0"):
        model = cuts(device)[0]
        depth = 4e-4 * np.arange(61)
        p = np.stack([0.5 * depth, 0.0 * depth, model.top + 1e-4 - depth], axis=1)
        R = np.tile(np.diag([1.0, -1.0, -1.0]), (len(p), 1, 1))
        adjoint = SliceAdjoint(model, PERIOD)
        run = adjoint.run(R, p)
        weights = np.random.default_rng(0).normal(size=run.wrenches.shape)
        gradient = adjoint.gradient(run, weights)
        found.append((run.wrenches, gradient.position, gradient.by("toughness"), gradient.by("P")))
    for here, there in zip(*found, strict=True):
        assert np.abs(here).max() > 0.0
        np.testing.assert_allclose(there, here, rtol=0.0, atol=1e-6 * np.abs(here).max())


def test_a_device_that_is_not_there_is_named_with_those_that_are():
    model = cuts("cuda:99")[0]
    with pytest.raises(ConfigurationError, match="no device 'cuda:99'") as error:
        Workspace([model], PERIOD)
    assert error.value.field == "numerics.device" and "cpu" in error.value.fix


def test_the_benchmark_goes_on_without_a_gpu_and_says_why(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(batch_speed.wp, "is_cuda_available", lambda: False)
    page = tmp_path / "page.md"
    page.write_text(
        f"before\n{batch_speed.PLACE.begin}\n{batch_speed.PLACE.end}\nafter\n", encoding="utf-8"
    )
    options = ["--batches", "1", "2", "--refinement", "0.5", "--repeats", "1"]
    assert main(["batch_speed", *options, "--output", str(page)]) == 0
    assert "The GPU is skipped: there is no CUDA device" in capsys.readouterr().out
    text = page.read_text(encoding="utf-8")
    rows = [line.split("|")[1:6] for line in text.splitlines() if line.startswith("| cpu")]
    assert [row[1].strip() for row in rows] == ["1", "2"]
    # The first cut of a batch is the same in all of them.
    assert [row[4].strip() for row in rows] == ["0.0000 %", "0.0000 %"]
    assert text.startswith("before\n") and text.endswith("after\n")
    assert batch_speed.PLACE.put(
        (ROOT / "docs/results/speed.md").read_text(encoding="utf-8"), "", "speed.md"
    )
