"""A session at the bench: what a world cuts, as a sensor and the arm's encoders record it."""

import contextlib
import copy
import os
import pickle
import secrets
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import numpy as np

from sliceit_drake.configuration import ConfigurationError, load_yaml
from sliceit_drake.cutting.workers import worker_processes
from sliceit_drake.diagrams.outputs.record_facts import food_facts, knife_facts
from sliceit_drake.records.metadata import (
    PHASE_LABELS,
    FoodFacts,
    NominalMotion,
    Phase,
    SensorFacts,
    SliceMetadata,
    ToolFacts,
    WrenchFacts,
    slice_name,
)
from sliceit_drake.records.phases import nominal_motion
from sliceit_drake.records.slice_record import SliceRecord, write_record
from sliceit_drake.stand_in.curve_world import CurveWorld
from sliceit_drake.stand_in.effect import Effect, Series
from sliceit_drake.stand_in.effect_registry import make_effect
from sliceit_drake.stand_in.finite_element_world import FiniteElementSettings, FiniteElementWorld
from sliceit_drake.stand_in.protocol import Protocol, Specimen, scaled_food, schedule
from sliceit_drake.stand_in.sensor_model import measured
from sliceit_drake.stand_in.world import World

if TYPE_CHECKING:
    from distributed import Client

__all__ = ["WORLDS", "Session", "is_recorded", "keep_record", "record_session"]

WORLDS = ("finite_elements", "curves")

ORDER, WORLD, SENSOR = range(3)
"""Independent streams of random numbers."""
PROVENANCE = "Simulated bench, sliceit record. Not measured on a robot."


class Session:
    """The slices of a protocol in one world.

    Everything random follows from the seed, slice by slice: a slice's record does not depend on
    which others were made, and its noise not on the effects.

    Args:
        protocol: What is cut.
        effects: What is hidden.
        world: One of `WORLDS`.
        seed: Seed of order, variation, noise and what effects draw.
        settings: How finely the finite elements are computed.

    Attributes:
        specimens: The slices in the order in which they are cut.
    """

    def __init__(
        self,
        protocol: Protocol,
        effects: Sequence[Effect] = (),
        world: str = "finite_elements",
        seed: int = 0,
        settings: FiniteElementSettings | None = None,
    ) -> None:
        if world not in WORLDS:
            raise ConfigurationError(
                f"{world!r} is no world", field="--world", fix=f"Give one of {', '.join(WORLDS)}."
            )
        self.protocol, self.effects, self.seed = protocol, tuple(effects), seed
        self.world: World = (
            FiniteElementWorld(protocol, settings)
            if world == "finite_elements"
            else CurveWorld(protocol)
        )
        self.specimens = schedule(protocol, self._random(ORDER, 0))

    def __len__(self) -> int:
        return len(self.specimens)

    def _random(self, stream: int, index: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, stream, index])

    def series(self, index: int) -> tuple[Series, list[Effect]]:
        """One slice as the world has it, and the effects that saw it.

        Raises:
            CuttingError: The motion cannot be computed, or the cut broke down.
        """
        effects = copy.deepcopy(list(self.effects))
        series = self.world.cut(self.specimens[index], effects, self._random(WORLD, index))
        for effect in effects:
            effect.respond(series)
        return series, effects

    def record(self, index: int) -> SliceRecord:
        """One slice as it is recorded.

        Raises:
            CuttingError: The motion cannot be computed, or the cut broke down.
        """
        series, effects = self.series(index)
        protocol, specimen = self.protocol, self.specimens[index]
        in_knife = series.R.transpose(0, 2, 1)
        wrench = np.einsum("nij,nkj->nki", in_knife, series.wrench().reshape(-1, 2, 3))
        wrench = wrench.reshape(-1, 6)
        for effect in effects:
            wrench = effect.measure(series, wrench)
        rng = self._random(SENSOR, index)
        rows, readings = measured(wrench, series.period, protocol.sensor, rng)
        R_WF, p_WF = _food_pose(protocol)
        R_WK = R_WF @ series.R[rows]
        vectors = np.einsum("nij,nkj->nki", R_WK, readings.reshape(-1, 2, 3))
        turn = np.einsum("nij,nkj->nik", np.diff(series.R, axis=0), series.R[:-1])
        turn = np.concatenate([np.zeros((1, 3, 3)), turn]) / series.period
        w = np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], axis=1)
        return SliceRecord(
            metadata=_metadata(protocol, specimen, series),
            time=series.time[rows],
            position=p_WF + series.p[rows] @ R_WF.T,
            rotation=R_WK,
            velocity=series.v[rows] @ R_WF.T,
            angular_velocity=w[rows] @ R_WF.T,
            force=vectors[:, 1],
            torque=vectors[:, 0],
        )


def _food_pose(protocol: Protocol) -> tuple[np.ndarray, np.ndarray]:
    """X_WF."""
    c, s = np.cos(protocol.placement.yaw), np.sin(protocol.placement.yaw)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return R, np.array([*protocol.placement.position, protocol.board.height])


def _metadata(protocol: Protocol, specimen: Specimen, series: Series) -> SliceMetadata:
    """The facts that the person at the bench knows."""
    condition, sensor = specimen.condition, protocol.sensor
    food = FoodFacts(name="none")
    if not condition.without_food:
        cut, position = scaled_food(protocol.food, condition.width_scale), _food_pose(protocol)[1]
        food = food_facts(cut, condition.peeled, position, protocol.placement.yaw)
    metadata = SliceMetadata(
        name=slice_name(specimen.index),
        provenance=PROVENANCE,
        food=food,
        board_height=protocol.board.height,
        knife=knife_facts(protocol.knife),
        motion=_nominal_motion(series),
        wrench=WrenchFacts(tared="yes"),
        sensor=SensorFacts(
            name="wrist sensor",
            force_range=sensor.force_range,
            torque_range=sensor.torque_range,
            force_resolution=sensor.force_resolution,
            rate=sensor.rate,
            cutoff_frequency=sensor.cutoff_frequency or None,
            position=[0.0, 0.0, 0.0],
            rotation=[0.0, 0.0, 0.0],
        ),
        slice_index=specimen.index,
        knife_slices=protocol.knife_slices + specimen.index,
        condition=condition.label,
        unknown=["food.slice_thickness", "tool.inertia"],
    )
    if condition.weight > 0.0:
        metadata.tool = ToolFacts(mass=condition.weight, center_of_mass=[0.0, 0.0, 0.0])
        metadata.wrench.includes.append("gravity")
    else:
        metadata.unknown += ["tool.mass", "tool.center_of_mass"]
    return metadata


def _nominal_motion(series: Series) -> NominalMotion:
    labels = [label if label in PHASE_LABELS else "other" for label in series.phase]
    starts = [0, *(k for k in range(1, len(labels)) if labels[k] != labels[k - 1]), len(labels)]
    edges = np.concatenate([[series.time[0] - series.period], series.time])
    phases = [
        Phase(labels[a], float(edges[a]), float(edges[b]))
        for a, b in zip(starts[:-1], starts[1:], strict=True)
    ]
    slicing = np.array([label == "slice" for label in labels])
    return nominal_motion(phases, slicing, series.press, series.draw)


def record_session(
    protocol: Protocol,
    output: FilePath,
    effects: Sequence[str] = (),
    world: str = "finite_elements",
    seed: int | None = None,
    workers: int = 1,
    settings: FiniteElementSettings | None = None,
    progress: Callable[[int, int], None] | None = None,
    client: "Client | None" = None,
) -> list[FilePath]:
    """Writes the records of a protocol, one by one as they are done; goes on with what is there.

    Names and metadata tell neither world nor effects nor seed.

    Args:
        protocol: What is cut.
        output: Folder of the records.
        effects: What is hidden, as `effect_registry.make_effect` takes it.
        world: One of `WORLDS`.
        seed: None for one that nobody knows; needed to go on.
        workers: Number of processes.
        settings: How finely the finite elements are computed.
        progress: Called with the number of records that are there, and that of all.
        client: Client of a Dask cluster that cuts the slices, in place of processes; the files are
            written here, and are the same.

    Returns:
        The CSV files, by slice.

    Raises:
        ConfigurationError: An input is wrong, or the folder holds records of another session.
        CuttingError: A motion cannot be computed, or a cut broke down.
    """
    output.mkdir(parents=True, exist_ok=True)
    there = sorted(output.glob("*.yaml"))
    if there and seed is None:
        raise ConfigurationError(
            f"there are {len(there)} records already",
            source=str(output),
            fix="Give another folder, or the --seed of these to go on.",
        )
    hidden = [make_effect(text) for text in effects]
    seed = secrets.randbits(62) if seed is None else seed
    session = Session(protocol, hidden, world, seed, settings)
    left = [k for k in range(len(session)) if not is_recorded(session.specimens[k], output)]
    done = len(session) - len(left)
    if progress is not None:
        progress(done, len(session))
    content = pickle.dumps((protocol, tuple(effects), world, seed, settings))
    for files in _computed(content, left, workers, client):
        keep_record(files, output)
        done += 1
        if progress is not None:
            progress(done, len(session))
    return [output / f"{slice_name(k)}.csv" for k in range(len(session))]


def is_recorded(specimen: Specimen, folder: FilePath) -> bool:
    """Whether a folder has the record of a slice.

    Raises:
        ConfigurationError: It has that of another session.
    """
    file, label = folder / f"{slice_name(specimen.index)}.yaml", specimen.condition.label
    if not file.exists():
        return False
    found = load_yaml(SliceMetadata, file)
    if found.condition != label:
        raise ConfigurationError(
            f"is a slice of {found.condition!r}; this protocol and seed have {label!r} there",
            source=str(file),
            fix="Give another folder, or the protocol and --seed that the folder was begun with.",
        )
    return True


def keep_record(files: Mapping[str, bytes], output: FilePath) -> None:
    """Writes the two files of a record.

    They go to `output` at the end, the table first: a killed run must not leave half a record.
    """
    with tempfile.TemporaryDirectory(dir=output, prefix=".writing_") as folder:
        for name, content in files.items():
            (FilePath(folder) / name).write_bytes(content)
        for name in sorted(files):
            os.replace(FilePath(folder) / name, output / name)


def _computed(
    content: bytes, left: Sequence[int], workers: int, client: "Client | None"
) -> Iterator[dict[str, bytes]]:
    """The files of the slices that are left, each as it is done here, in processes or a cluster."""
    if client is None and min(workers, len(left)) < 2:
        for index in left:
            yield _record_files(content, index)
        return
    with contextlib.ExitStack() as stack:
        if client is None:
            pool = stack.enter_context(worker_processes(workers))
        else:
            pool = client.get_executor(pure=False)
            stack.callback(pool.shutdown, wait=False)
        for future in as_completed([pool.submit(_record_files, content, k) for k in left]):
            yield future.result()


_SESSIONS = threading.local()


def _record_files(content: bytes, index: int) -> dict[str, bytes]:
    """The files of a slice; the thread that computes it keeps the session.

    A record takes longer to turn into text than to send: whoever collects them only writes.
    """
    known: tuple[bytes, Session] | None = getattr(_SESSIONS, "known", None)
    if known is None or known[0] != content:
        protocol, effects, world, seed, settings = pickle.loads(content)
        # Effects travel by name: one from a user's file is in no module that can be imported.
        hidden = [make_effect(text) for text in effects]
        known = _SESSIONS.known = (content, Session(protocol, hidden, world, seed, settings))
    with tempfile.TemporaryDirectory() as folder:
        made = write_record(known[1].record(index), FilePath(folder) / slice_name(index))
        return {f.name: f.read_bytes() for f in (made, made.with_suffix(".yaml"))}
