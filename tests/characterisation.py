"""What the project computes today, as numbers and hashes: moves of code must not change them.

`python tests/characterisation.py` writes tests/data/characterisation.json anew. Do that only in a
commit that is meant to change numbers, and say there which and why.
"""

import copy
import dataclasses as dc
import hashlib
import json
import os
import platform
import sys
import tempfile
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import scipy.linalg

from sliceit_drake.calibration.calibrate import CalibrationOptions, calibrate
from sliceit_drake.calibration.setup import CalibrationSetup, ParameterRange
from sliceit_drake.cutting.batch import simulate_batch
from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood, load_calibrated_food
from sliceit_drake.cutting.foods.effects import Adhesion, Effects, Relaxation, Skin, ToughnessRate
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.gradient import SliceAdjoint
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, Motion, MotionPlan, Retract
from sliceit_drake.cutting.parameters import pull_back
from sliceit_drake.cutting.simulate import simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.diagnosis.diagnose import diagnose, setup_of_food
from sliceit_drake.diagnosis.one_slice.diagnose_slice import diagnose_slice, setup_of_slice
from sliceit_drake.diagrams.run import prepare_run
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.learning.environment import SlicingEnv
from sliceit_drake.learning.reward import TERMS
from sliceit_drake.learning.task import TaskConfig
from sliceit_drake.records.slice_record import SliceRecord
from sliceit_drake.records.validation import load_record
from sliceit_drake.resources import resource_path
from sliceit_drake.stand_in.effect_registry import make_effect
from sliceit_drake.stand_in.finite_element_world import FiniteElementSettings
from sliceit_drake.stand_in.protocol import load_protocol
from sliceit_drake.stand_in.session import Session

FILE = Path(__file__).parent / "data" / "characterisation.json"

SHAPE = Cylinder(rings=2, layers=[0.0, 4e-3, 12e-3])
WORLD = FiniteElementSettings(refinement=0.6, time_step=5e-4, travel=5e-4)
SCENARIOS = {
    "apple": 3.0,
    "carrot_sequence": 2.5,
    "cucumber": 3.0,
    "cucumber_measured": 10.0,
    "cucumber_agent": 2.0,
    "cucumber_end_slice": 10.0,
    "cucumber_policy": 10.0,
    "cucumber_sequence": 3.5,
    "cucumber_spring": 10.0,
    "potato_sequence": 2.0,
    "tomato_sequence": 2.0,
}
"""How much of each scenario is simulated at the most, s."""
DIAGNOSES = {
    "nothing": ("poor", ()),
    "skin": ("poor", ("skin:2.0",)),
    "sensor_gain": ("poor", ("sensor_gain:0.1",)),
    "rate": ("rich", ("rate_toughness:0.2",)),
    "unlisted": ("rich", ("magnetic_board",)),
}
"""Protocol and hidden effects of each; the sixth diagnosis is of a single measured slice."""


@dc.dataclass
class Facts:
    """What one part computes: numbers, and a hash of all that it computes, bit by bit."""

    numbers: dict[str, float]
    hash: str


def facts(numbers: dict[str, float], *everything: np.ndarray | str) -> Facts:
    """Facts of arrays and texts."""
    h = hashlib.sha256()
    for part in everything:
        if isinstance(part, str):
            h.update(part.encode())
        else:
            array = np.ascontiguousarray(part)
            h.update(repr((array.shape, array.dtype.str)).encode() + array.tobytes())
    return Facts({k: float(v) for k, v in numbers.items()}, h.hexdigest()[:16])


def scenario(name: str) -> Facts:
    """The record of a scenario."""
    loaded = load_scenario(resource_path(f"scenarios/{name}.yaml"))
    run = prepare_run(loaded)
    run.advance(min(SCENARIOS[name], run.motion.duration))
    assert run.stopped is None, run.stopped
    record = run.record()
    force = record.vector("food_wrench_f")
    return facts(
        {
            "columns": len(record.columns),
            "rows": len(record.values),
            "peak": np.linalg.norm(force, axis=1).max(),
            "mean_vertical": force[:, 2].mean(),
            "board_peak": record["board_wrench_f_z"].max(),
            "cut": record["cut_progress"].max(),
        },
        record.values,
    )


def records_of(protocol: str, effects: tuple[str, ...], world: str, seed: int) -> list[SliceRecord]:
    """Slices of the stand-in, two of each condition of the rich protocol."""
    loaded = load_protocol(str(resource_path(f"calibration/protocols/{protocol}.yaml")))
    for condition in loaded.conditions:
        condition.replicates = min(condition.replicates, 2 if protocol == "rich" else 4)
    session = Session(loaded, [make_effect(e) for e in effects], world, seed, WORLD)
    return [session.record(k) for k in range(len(session))]


def stand_in(world: str) -> Facts:
    """Records of a world with hidden effects."""
    effects = ("skin:1.0", "sensor_drift:0.05", "dulling_edge") if world != "curves" else ()
    records = records_of("poor", effects, world, 11)
    tables = [
        np.column_stack([r.time, r.position, r.rotation.reshape(-1, 9), r.force, r.torque])
        for r in records
    ]
    return facts(
        {f"peak_{k}": np.abs(t[:, 13:16]).max() for k, t in enumerate(tables)},
        *tables,
        *(repr(r.metadata) for r in records),
    )


def bench_setup() -> CalibrationSetup:
    """Calibration setup of a coarse food."""
    return CalibrationSetup(
        food=Food(
            shape=SHAPE, material=Material(youngs_modulus=1.6e6, toughness=300.0, friction=0.1)
        ),
        numerics=Numerics(time_step=1e-3),
        parameters=[
            ParameterRange("material.toughness", 100.0, 1000.0),
            ParameterRange("material.youngs_modulus", 2e5, 5e6),
            ParameterRange("material.friction", 0.02, 1.0),
        ],
    )


def calibration() -> Facts:
    """A short calibration of a press and withdrawal that the stand-in cut."""
    protocol = load_protocol(str(resource_path("calibration/protocols/poor.yaml")))
    protocol.food = copy.deepcopy(bench_setup().food)
    protocol.food.material.toughness = 420.0
    protocol.conditions[0].motion = MotionPlan(
        [
            Hold(duration=0.1, label="air"),
            ConstantSpeed(distance=0.021, speed=0.1, acceleration=5.0, label="slice"),
            Retract(distance=0.01, speed=0.1, acceleration=5.0),
        ]
    )
    session = Session(protocol, seed=3, settings=WORLD)
    records = [session.record(k) for k in range(2)]
    options = CalibrationOptions(trials=8, steps=6, starts=1, seed=1, blocks=2)
    with tempfile.TemporaryDirectory() as folder:
        result = calibrate(bench_setup(), records, Path(folder), options)
    numbers = result.predictor.values(result.unit)
    errors = [result.rms, result.search_rms, result.refined_rms, *result.blocks]
    return facts(
        numbers | {"rms": result.rms},
        repr((sorted(numbers.items()), errors, result.posterior)),
        *(p.predicted for p in result.predictions),
    )


def diagnosis(name: str) -> Facts:
    """What a diagnosis says, in full."""
    protocol, effects = DIAGNOSES[name]
    loaded = load_protocol(str(resource_path(f"calibration/protocols/{protocol}.yaml")))
    food = CalibratedFood(food=copy.deepcopy(loaded.food), knife=loaded.knife)
    records = records_of(protocol, effects, "finite_elements", 5)
    with tempfile.TemporaryDirectory() as folder:
        result = diagnose(
            setup_of_food(food, 0.4), records, cache=Path(folder), replicates=60, workers=2
        )
    said = result.facts()
    numbers = {"misfit": said["misfit_over_noise"], "p_value": said["p_value"]}
    numbers |= {f"gain:{e['cause']}": e["gain"] for e in said["evidence"][:5] if e["gain"]}
    return facts(numbers, json.dumps(said, sort_keys=True))


def one_slice() -> Facts:
    """What is said of the paper's cucumber."""
    record = load_record(resource_path("calibration/records/cucumber.csv"))
    food = load_calibrated_food("cucumber")
    result = diagnose_slice(setup_of_slice(food, 0.4), record, replicates=40, workers=2)
    with tempfile.TemporaryDirectory() as folder:
        result.save(Path(folder))
        said = (Path(folder) / "diagnosis.json").read_text(encoding="utf-8")
    numbers = {f"p_value:{c.name}": c.p_value for c in result.evidence.causes[:6]}
    return facts(numbers | {"rms": result.error(result.fit.held_out)}, said)


def effects_food() -> Food:
    """With effects in every kernel."""
    return Food(
        shape=SHAPE,
        material=Material(friction=0.1, static_friction=0.2, stribeck_velocity=0.1, strength=1e5),
        effects=Effects(
            toughness_rate=ToughnessRate(0.1),
            relaxation=Relaxation([0.2], [0.05]),
            skin=Skin(0.5),
            adhesion=Adhesion(300.0, 3000.0, 0.6),
        ),
    )


def slices() -> Facts:
    """A slice alone, and a batch of two, on a prescribed motion."""
    model = make_food_model(effects_food(), Knife(), Numerics(time_step=5e-4))
    plan = MotionPlan([ConstantSpeed(distance=0.024, speed=0.1), Retract(distance=0.01, speed=0.1)])
    motion = Motion(plan, start_pose(model, clearance=1e-3))
    alone = simulate_slice(CuttingSolver(model, 2e-3), motion)
    together = simulate_batch([model, model], [motion, motion], 2e-3)
    return facts(
        {"peak": np.abs(alone.food_wrench[:, 5]).max(), "batch": together[1].food_wrench.sum()},
        alone.food_wrench,
        alone.board_wrench,
        *(part for cut in together for part in (cut.food_wrench, cut.board_wrench, cut.cut)),
    )


def gradient() -> Facts:
    """Gradient of a mean force by parameters and by the knife's path."""
    model = make_food_model(effects_food(), Knife(), Numerics(time_step=5e-4, precision="float64"))
    k = np.arange(61)
    p = np.array([0.0, 0.0, model.top + 1e-4]) + np.stack([1e-4 * k, 0 * k, -4.2e-4 * k], axis=1)
    adjoint = SliceAdjoint(model, 2e-3)
    run = adjoint.run(np.tile(np.diag([1.0, -1.0, -1.0]), (61, 1, 1)), p)
    weights = np.zeros_like(run.wrenches)
    weights[:, 3:] = [0.3, 0.1, 1.0]
    back = adjoint.gradient(run, weights)
    names = [
        "material.toughness",
        "material.youngs_modulus",
        "material.friction",
        "effects.skin.toughness",
    ]
    by_name = pull_back(model, back, names)
    return facts(
        {n: float(v) for n, v in by_name.items()},
        run.wrenches,
        back.position,
        *(np.asarray(v) for v in by_name.values()),
    )


def environment(simulator: str) -> Facts:
    """Thirty decisions of an agent that acts by chance."""
    env = SlicingEnv(TaskConfig(simulator=simulator, foods=["cucumber"], refinement=0.5))
    observation, _ = env.reset(seed=4)
    rng, seen, terms = np.random.default_rng(5), [observation], []
    for _ in range(30):
        action = np.clip([0.2, 0.1, 1.0, 0.3, 0.4, 1.0] + rng.uniform(-0.5, 0.5, 6), -1.0, 1.0)
        observation, reward, terminated, truncated, info = env.step(action)
        seen.append(observation)
        terms.append([reward, info["force"], *(info["reward_terms"][t] for t in TERMS)])
        if terminated or truncated:
            break
    return facts(
        {"decisions": len(terms), "return": sum(t[0] for t in terms), "force": terms[-1][1]},
        np.array(seen),
        np.array(terms),
    )


PARTS: dict[str, Callable[[], Facts]] = {
    **{f"scenario:{name}": lambda name=name: scenario(name) for name in SCENARIOS},
    **{f"stand_in:{w}": lambda w=w: stand_in(w) for w in ("finite_elements", "curves")},
    "slices": slices,
    "gradient": gradient,
    "calibration": calibration,
    **{f"diagnosis:{name}": lambda name=name: diagnosis(name) for name in DIAGNOSES},
    "diagnosis:one_slice": one_slice,
    "environment:spring": lambda: environment("spring"),
    "environment:cutting": lambda: environment("cutting"),
}


def machine() -> str:
    """What the last bits of a computation depend on: versions, and how this processor's libraries
    round. They choose their code by more than a processor's features (its caches, its cores), so
    that it is measured: on products, decompositions, functions and a simulated press."""
    names = ("drake", "numpy", "scipy", "warp-lang", "optuna", "onnxruntime")
    versions = [platform.python_version(), *(version(name) for name in names)]
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((400, 300)), rng.standard_normal((400, 3))
    model = make_food_model(effects_food(), Knife(), Numerics(time_step=5e-4))
    plan = MotionPlan([ConstantSpeed(distance=4e-3, speed=0.1)])
    press = simulate_slice(CuttingSolver(model, 2e-3), Motion(plan, start_pose(model, 1e-3)))
    bits = (
        a.T @ a,
        a.astype(np.float32).T @ a.astype(np.float32),
        scipy.linalg.lstsq(a, b)[0],
        scipy.linalg.cho_solve(scipy.linalg.cho_factor(a.T @ a), a.T @ b),
        np.linalg.eigh(a.T @ a)[0],
        np.linalg.svd(a)[1],
        np.exp(a) + np.log(np.abs(a)) + np.sin(a) + np.abs(a) ** 0.3,
        a.sum(axis=0),
        press.food_wrench,
    )
    return facts({}, repr(versions), *bits).hash


if __name__ == "__main__":
    import time

    wanted = sys.argv[1:] or list(PARTS)
    stored = json.loads(FILE.read_text(encoding="utf-8")) if FILE.exists() else {"parts": {}}
    for part in wanted:
        begin = time.perf_counter()
        stored["parts"][part] = {"machine": machine(), **dc.asdict(PARTS[part]())}
        print(f"{part}: {time.perf_counter() - begin:.1f} s", flush=True)
        FILE.write_text(json.dumps(stored, indent=1) + "\n", encoding="utf-8")
