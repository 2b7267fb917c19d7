"""Causes by name, and causes that a user wrote.

A user's cause is tried on a made-up slice, so that its mistakes show before any simulation.
"""

import contextlib
import traceback
from collections.abc import Iterator, Sequence
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.foods.food import Food, make_food_model
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import CuttingModel, Numerics
from sliceit_drake.diagnosis.cause import Cause, check_cause
from sliceit_drake.diagnosis.causes import BUILT_IN
from sliceit_drake.prediction.series import ForceSeries, SliceFacts
from sliceit_drake.resources import load_subclasses

__all__ = ["ENTRY_POINTS", "all_causes", "dry_run", "is_users", "load_cause", "open_causes"]

ENTRY_POINTS = "sliceit_drake.causes"
"""Group of entry points that name classes of causes."""
ROWS, PERIOD, HEIGHT = 200, 2e-3, 0.027
"""Rows of the made-up slice, their distance, s, and the height of its food, metres."""


def all_causes() -> list[Cause]:
    """The causes that come with the package, and those of installed packages.

    Raises:
        ConfigurationError: An installed cause is broken or incomplete, or a name is there twice.
    """
    causes = [kind() for kind in BUILT_IN]
    for point in entry_points(group=ENTRY_POINTS):
        try:
            cause = point.load()()
        except Exception as error:
            raise ConfigurationError(
                f"cannot be loaded: {type(error).__name__}: {error}",
                source=f"entry point {point.name} = {point.value}",
                field=ENTRY_POINTS,
                fix="Correct or uninstall the package that offers it.",
            ) from error
        check_cause(cause, f"entry point {point.name}")
        causes.append(cause)
    _check_names(causes)
    return causes


def open_causes(base: Sequence[str], extra: Sequence[Cause] = ()) -> list[Cause]:
    """All causes that are more than a shift of a free base parameter, and some of a user's.

    Raises:
        ConfigurationError: A name is there twice.
    """
    causes = [*all_causes(), *extra]
    _check_names(causes)
    return [c for c in causes if not c.absorbed(base)]


def is_users(cause: Cause) -> bool:
    """Whether a cause is a user's and not one of the package."""
    return type(cause) not in BUILT_IN


def _check_names(causes: Sequence[Cause]) -> None:
    names = [cause.name for cause in causes]
    for k, name in enumerate(names):
        if name in names[:k]:
            raise ConfigurationError(
                f"there are two causes {name!r}", field="cause", fix="Rename one."
            )


def load_cause(file: str | Path) -> Cause:
    """The cause in a user's file.

    Raises:
        ConfigurationError: There is no such file, it does not run or does not hold one cause, or
            that is incomplete or fails on a made-up slice.
    """
    file = Path(file)
    with _blamed(file, "cannot be read as Python"):
        kinds = load_subclasses(f"sliceit_cause_{file.stem}", file, Cause)
    if kinds is None:
        raise ConfigurationError(
            "there is no such file", source=str(file), field="--cause", fix="Check the path."
        )
    if len(kinds) != 1:
        raise ConfigurationError(
            f"holds {len(kinds)} causes",
            source=str(file),
            fix="Write one subclass of sliceit_drake.diagnosis.cause.Cause in it "
            "(docs/reference/causes.md).",
        )
    with _blamed(file, "cannot be made"):
        cause = kinds[0]()
    check_cause(cause, str(file))
    with _blamed(file, "fails on a made-up slice", ConfigurationError):
        dry_run(cause, str(file))
    return cause


@contextlib.contextmanager
def _blamed(file: Path, what: str, *passed: type[Exception]) -> Iterator[None]:
    """Turns errors in a user's file, but for some, into one with the line where it happened."""
    try:
        yield
    except passed:
        raise
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        lines = [f.lineno for f in frames if f.filename == str(file)]
        line = error.lineno if isinstance(error, SyntaxError) else lines[-1] if lines else None
        text = error.msg if isinstance(error, SyntaxError) else str(error)
        raise ConfigurationError(
            f"{what}: {type(error).__name__}: {text}",
            source=f"{file}, line {line}" if line else str(file),
            field="--cause",
            fix="Correct the file (docs/reference/causes.md has a complete example).",
        ) from error


def dry_run(cause: Cause, source: str = "") -> None:
    """Calls the hooks of a complete cause at its nulls and at its size.

    Raises:
        ConfigurationError: A hook gives what cannot be used, or changes something at the nulls.
        Exception: Whatever a hook raises.
    """
    facts = SliceFacts("rehearsal", "press", height=HEIGHT, width=HEIGHT, speed=0.02)
    nulls = cause.nulls(cause.scan.values[0] if cause.scan else None)
    full = nulls | {p.name: p.null + p.step for p in cause.parameters}

    def refuse(hook: str, problem: str, fix: str) -> ConfigurationError:
        return ConfigurationError(
            problem, source=source, field=f"{type(cause).__name__}.{hook}", fix=fix
        )

    adds = "Multiply all that it adds by a parameter whose null is 0."
    series = _made_up_slice()
    before = series.wrench.copy()
    for values, name in ((nulls, "nulls"), (full, "size")):
        out = cause.wrench(series, values, facts)
        if not np.array_equal(series.wrench, before):
            fix = "Begin with out = series.wrench.copy(), change out and return it."
            raise refuse("wrench", "changes series.wrench itself", fix)
        if np.shape(out) != before.shape:
            problem = f"gives an array {list(np.shape(out))}, expected {list(before.shape)}"
            fix = "Return moments and forces of all rows [N, 6]."
            raise refuse("wrench", problem, fix)
        if not np.isfinite(out).all():
            fix = "Mind divisions by a speed or depth of zero."
            raise refuse("wrench", f"is not finite at its {name}", fix)
        if values is nulls and not np.allclose(out, before, rtol=0.0, atol=1e-9):
            raise refuse("wrench", "changes the force at its nulls", adds)
    t = np.concatenate([[series.time[0] - PERIOD], series.time])
    R, p = (np.concatenate([v[:1], v]) for v in (series.R, series.p))
    for values in (nulls, full):
        moved = cause.motion(R.copy(), p.copy(), t, values, facts, series.wrench[:, 3:])
        shapes, expected = ([list(np.shape(v)) for v in pair] for pair in (moved, (R, p)))
        if shapes != expected:
            fix = "Return R [N + 1, 3, 3] and p [N + 1, 3]."
            raise refuse("motion", f"gives arrays {shapes}, expected {expected}", fix)
        if values is nulls and not (np.allclose(moved[0], R) and np.allclose(moved[1], p)):
            raise refuse("motion", "changes the motion at its nulls", adds)
    if cause.changes_model:
        food = Food(shape=Cylinder(HEIGHT, 0.06, 2, [0.0, 0.004, 0.012]), hold_distance=0.0119)
        model = make_food_model(food, Knife(), Numerics(time_step=1e-3))
        for values in (nulls, full):
            if not isinstance(cause.model(model, values, facts), CuttingModel):
                raise refuse("model", "gives no CuttingModel", "Return one.")


def _made_up_slice() -> ForceSeries:
    """A press into food, a stop and a withdrawal, with a force that goes with the depth."""
    time = PERIOD * np.arange(1, ROWS + 1)
    turn = 0.6 * time[-1]
    depth = 0.1 * np.minimum(time, turn) - 0.005 - 0.1 * np.maximum(time - 0.7 * time[-1], 0.0)
    v = np.zeros((ROWS, 3))
    v[:, 2] = -np.gradient(depth, PERIOD)
    p = np.zeros((ROWS, 3))
    p[:, 2] = HEIGHT - depth
    names = ("edge", "normal", "friction", "board", "weight")
    parts = {name: np.zeros((ROWS, 6)) for name in names}
    parts["edge"][:, 5] = 500.0 * np.clip(depth, 0.0, None)
    parts["friction"][:, 5] = -50.0 * np.sign(v[:, 2]) * np.clip(depth, 0.0, None)
    return ForceSeries(
        time=time,
        R=np.broadcast_to(np.diag([1.0, -1.0, -1.0]), (ROWS, 3, 3)).copy(),
        p=p,
        v=v,
        w=np.zeros((ROWS, 3)),
        parts=parts,
        depth=depth,
        in_contact=depth > 0.0,
        wrench=np.asarray(sum(parts.values())),
    )
