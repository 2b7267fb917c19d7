"""Simulations on a cluster are those of one process."""

import numpy as np
import pytest
from example_slices import HEIGHT, short_press

from sliceit_drake.calibration.setup import CalibrationSetup, ParameterRange
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.food import Cylinder, Food
from sliceit_drake.diagnosis.causes.material import SkinToughness
from sliceit_drake.diagnosis.cluster import active, on_cluster
from sliceit_drake.diagnosis.prediction import ActiveCause, Point, SlicePredictor
from sliceit_drake.diagnosis.simulator import Runner
from sliceit_drake.diagnosis.slices import Meshing

distributed = pytest.importorskip("distributed")


def points() -> list[Point]:
    """Of two meshes, with other materials and another food."""
    finer = Meshing(refinement=1.0)
    skin = ActiveCause(SkinToughness(), {"toughness": 1.0, "thickness": 1.2e-3})
    return [
        Point(),
        Point({"material.toughness": 220.0}),
        Point(causes=(skin,)),
        Point(meshing=finer),
        Point({"material.friction": 0.2}, meshing=finer),
    ]


def predictor() -> SlicePredictor:
    setup = CalibrationSetup(
        food=Food(shape=Cylinder(HEIGHT, 0.06, 3, [0.0, 0.004, 0.012]), hold_distance=0.0119),
        parameters=[ParameterRange("material.toughness", 50.0, 1000.0)],
    )
    return SlicePredictor(setup, [short_press()], (Meshing(0.5), Meshing(1.0)), workers=1)


def test_slices_on_a_cluster_are_those_of_one_process(monkeypatch):
    alone = [row[0].wrench for row in predictor().predict(points())]
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address=None,
        worker_dashboard_address=None,
    ) as local:
        with on_cluster(local.scheduler_address):
            assert active()
            # Of this process alone: the workers are others.
            monkeypatch.setattr(Runner, "run", None)
            spread = predictor()
            seen: list[tuple[int, int]] = []
            rows = spread.predict(points(), lambda done, of: seen.append((done, of)))
    assert not active()
    assert seen[-1] == (5, 5) and spread.simulator.simulated == 5
    for one, (other,) in zip(alone, rows, strict=True):
        assert np.abs(one).max() > 0.1
        np.testing.assert_array_equal(one, other.wrench)


def test_a_scheduler_that_does_not_answer_is_named_with_what_to_do():
    with pytest.raises(ConfigurationError, match="tcp://127.0.0.1:9") as error:
        with on_cluster("tcp://127.0.0.1:9", patience=0.5):
            pass
    assert error.value.field == "--scheduler" and "dask scheduler" in error.value.fix
