"""Steps that prepare a slice record, each written into its metadata as it is applied.

A comparison is fair only if the predicted force went through what the measured one went through:
`as_measured` applies the sensor's own filter and every filter step of a record to a prediction,
with the code that filtered the measurement.
"""

import copy
import dataclasses as dc
from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.records.metadata import ProcessingStep, SliceMetadata
from sliceit_drake.records.slice_record import SliceRecord
from sliceit_drake.records.spikes import without_spikes
from sliceit_drake.tables import interpolated

__all__ = [
    "MIN_AIR_ROWS",
    "apply_filters",
    "as_measured",
    "compensate_tool",
    "crop",
    "low_pass",
    "resample",
    "tare",
]

GRAVITY = 9.81
"""Along -Wz, m/s2."""
MIN_AIR_ROWS = 10
"""Fewest samples of the first air phase whose mean is a zero and whose scatter is the noise."""
ANTI_ALIASING = 0.35
"""Cutoff of the filter before a resampling to fewer rows, of the new rate: at the new Nyquist
frequency its two passes of order 4 leave 1/18."""


def tare(record: SliceRecord) -> SliceRecord:
    """Subtracts the mean wrench of the first air phase, as zeroing the sensor there would.

    The zero of a sensor is constant in the sensor, hence in K: there it is averaged, without
    spikes, and subtracted. Later air phases then show its drift.

    Raises:
        ConfigurationError: If the first air phase has not 10 rows, or only the norm of the force is
            known, from which an offset cannot be subtracted.
    """
    air = record.first_phase("air")
    if record.force_norm is not None or air.sum() < MIN_AIR_ROWS:
        raise ConfigurationError(
            f"has {record.known_force}"
            if record.force_norm is not None
            else f"has {air.sum()} rows in its first phase labelled air, expected {MIN_AIR_ROWS}",
            source=record.source,
            fix="Leave the step tare out, or give components and an air phase.",
        )
    if record.force_vertical is not None:
        vertical = without_spikes(record.force_vertical[:, None])[0][air]
        zero = float(vertical.mean())
        result = _with_step(record, "tare", {"force_vertical": zero})
        result.force_vertical = record.force_vertical - zero
        result.metadata.wrench.tared = "yes"
        return result
    result = _with_step(record, "tare", {}, "subtracted in K, about Ko")
    for name in ("force", "torque"):
        values = getattr(record, name)
        if values is not None:
            calm = without_spikes(values)[0][air]
            in_K = np.einsum("nji,nj->ni", record.rotation[air], calm).mean(axis=0)
            setattr(result, name, values - record.rotation @ in_K)
            numbers = {f"{name}_{a}": float(v) for a, v in zip("xyz", in_K, strict=True)}
            result.metadata.processing[-1].numbers.update(numbers)
    result.metadata.wrench.tared = "yes"
    return result


def compensate_tool(record: SliceRecord, *, cutoff: float | None = 20.0) -> SliceRecord:
    """Removes the weight and the inertia of the tool beyond the sensor, those that it measured.

    The tool obeys Newton and Euler: what the sensor measures is the environment's wrench plus the
    tool's weight minus its rate of momentum, with r from Ko to the centre of mass C:
    ``F = F_env + m g - m a_C`` and ``t = t_env + r x m g - (r x m a_C + d(I w)/dt)`` about Ko.
    Weight is removed if `metadata.wrench.includes` has gravity, inertia if it has inertia.

    A sensor that was zeroed with the tool on it has lost the weight that it had in that pose, so
    that a constant remains: apply `tare` afterwards.

    Args:
        cutoff: Velocities pass a zero-phase filter of this cutoff, Hz, before they are
            differentiated; None for no filter.

    Raises:
        ConfigurationError: If mass, centre of mass or a component of the force is not given.
    """
    tool, facts = record.metadata.tool, record.metadata.wrench
    if record.force is None or tool.mass is None or tool.center_of_mass is None:
        raise ConfigurationError(
            f"has {record.known_force}"
            if record.force is None
            else "tool.mass or tool.center_of_mass is not given",
            source=record.source,
            fix="Leave the step compensate_tool out, or give what is missing.",
        )
    numbers = {"gravity": GRAVITY} | ({} if cutoff is None else {"cutoff": cutoff})
    result = _with_step(record, "compensate_tool", numbers)
    R = record.rotation
    r = R @ np.array(tool.center_of_mass)
    force, torque = np.zeros_like(record.position), np.zeros_like(record.position)
    if "gravity" in facts.includes:
        weight = np.array([0.0, 0.0, -tool.mass * GRAVITY])
        force += weight
        torque += np.cross(r, weight)
    if "inertia" in facts.includes:
        v, w = record.velocity, record.angular_velocity
        if cutoff is not None:
            v, w = (_filtered(record.time, x, cutoff, 2, zero_phase=True) for x in (v, w))
        momentum = tool.mass * (v + np.cross(w, r))
        change = np.gradient(momentum, record.time, axis=0)
        force -= change
        torque -= np.cross(r, change)
        if tool.inertia is not None:
            Ixx, Iyy, Izz, Ixy, Ixz, Iyz = tool.inertia
            I_K = np.array([[Ixx, Ixy, Ixz], [Ixy, Iyy, Iyz], [Ixz, Iyz, Izz]])
            spin = np.einsum("nij,jk,nlk,nl->ni", R, I_K, R, w)
            torque -= np.gradient(spin, record.time, axis=0)
    result.force = record.force - force
    if record.torque is not None:
        result.torque = record.torque - torque
    kept = [part for part in facts.includes if part not in ("gravity", "inertia")]
    if "gravity" in facts.includes:
        result.metadata.wrench.tared = "no"
    result.metadata.wrench.includes = kept
    return result


def low_pass(
    record: SliceRecord, cutoff: float, *, order: int = 2, zero_phase: bool = True
) -> SliceRecord:
    """Filters force and torque with a Butterworth filter.

    Args:
        cutoff: Hz, where one pass has lost 3 dB.
        order: Order of one pass.
        zero_phase: Filter forward and backward, without delay and with twice the attenuation;
            otherwise forward alone, as a sensor does.

    Raises:
        ConfigurationError: If the cutoff is not below half the rate.
    """
    numbers = {"cutoff": cutoff, "order": float(order), "zero_phase": float(zero_phase)}
    result = _with_step(record, "low_pass", numbers)
    return _map_wrench(result, lambda x: _filtered(record.time, x, cutoff, order, zero_phase))


def resample(record: SliceRecord, rate: float) -> SliceRecord:
    """Puts a record on uniform times, from its first time on.

    Force and torque pass an anti-aliasing filter (Butterworth, order 4, zero phase, 0.35 `rate`) if
    the rate falls. All is then interpolated linearly, orientations along the shortest turn.

    Args:
        rate: Rows a second, Hz.

    Raises:
        ConfigurationError: If the rate is not positive.
    """
    if not rate > 0.0:
        raise ConfigurationError(f"{rate} Hz is no rate", field="rate", fix="Give Hz > 0.")
    numbers = {"rate": rate, "start": float(record.time[0]), "end": float(record.time[-1])}
    result = _with_step(record, "resample", numbers)
    time = _grid(**numbers)

    def at(values: np.ndarray) -> np.ndarray:
        return interpolated(time, record.time, values)

    result = _map_wrench(result, lambda values: _resampled(record.time, values, **numbers))
    result.time = time
    result.position, result.velocity = at(record.position), at(record.velocity)
    result.angular_velocity = at(record.angular_velocity)
    inside = np.clip(time, record.time[0], record.time[-1])
    turn = Slerp(record.time, Rotation.from_matrix(record.rotation))
    result.rotation = turn(inside).as_matrix()
    if record.joints is not None:
        result.joints = at(record.joints)
    return result


def crop(record: SliceRecord, start: float, end: float) -> SliceRecord:
    """Keeps the rows with start <= time <= end, s.

    Raises:
        ConfigurationError: If fewer than two rows remain.
    """
    result = record.between(start, end)
    if len(result) < 2:
        raise ConfigurationError(
            f"{len(result)} rows lie between {start:g} and {end:g} s",
            source=record.source,
            fix=f"The record has {record.time[0]:g} to {record.time[-1]:g} s.",
        )
    result.metadata.processing.append(ProcessingStep("crop", {"start": start, "end": end}))
    return result


def apply_filters(
    processing: Sequence[ProcessingStep], time: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Repeats the steps low_pass, resample and crop on another series, such as a prediction.

    Args:
        processing: `metadata.processing` of the measured record.
        time: Increasing times of the series [n], s, on the record's clock.
        values: The series [n] or [n, k].

    Returns:
        Times and series after the steps. If `time` holds the times of the record before its steps,
        these are the times of the record.

    Raises:
        ConfigurationError: If the series does not cover a resampled stretch.
    """
    for step in processing:
        n = step.numbers
        if step.name == "low_pass":
            values = _filtered(time, values, n["cutoff"], int(n["order"]), n["zero_phase"] != 0.0)
        elif step.name == "resample":
            grid = _grid(**n)
            slack = 1.0 / n["rate"]
            if time[0] > grid[0] + slack or time[-1] < grid[-1] - slack:
                raise ConfigurationError(
                    f"the series has {time[0]:.4g} to {time[-1]:.4g} s, the record was resampled"
                    f" over {grid[0]:.4g} to {grid[-1]:.4g} s",
                    fix="Predict the whole record.",
                )
            values, time = _resampled(time, values, **n), grid
        elif step.name == "crop":
            keep = (time >= n["start"]) & (time <= n["end"])
            time, values = time[keep], values[keep]
    return time, values


def as_measured(
    metadata: SliceMetadata, time: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A true series as the record would show it: the sensor's filter, then the record's steps.

    Args:
        metadata: The measured record's. `sensor.cutoff_frequency` is a causal filter of order 1.
        time: Increasing times [n], s, on the record's clock.
        values: The series [n] or [n, k].

    Returns:
        Times and series, as `apply_filters`.
    """
    cutoff = metadata.sensor.cutoff_frequency
    if cutoff is not None:
        values = _filtered(time, values, cutoff, 1, zero_phase=False)
    return apply_filters(metadata.processing, time, values)


def _with_step(
    record: SliceRecord, name: str, numbers: dict[str, float], note: str = ""
) -> SliceRecord:
    metadata = copy.deepcopy(record.metadata)
    metadata.processing.append(ProcessingStep(name, dict(numbers), note))
    return dc.replace(record, metadata=metadata)


def _map_wrench(record: SliceRecord, change: Callable[[np.ndarray], np.ndarray]) -> SliceRecord:
    """Changes force and torque in place, whatever of them is there."""
    for name in ("force", "torque", "force_norm", "force_vertical"):
        values = getattr(record, name)
        if values is not None:
            setattr(record, name, change(values))
    return record


def _grid(rate: float, start: float, end: float) -> np.ndarray:
    return start + np.arange(int(np.floor((end - start) * rate + 1e-6)) + 1) / rate


def _resampled(
    time: np.ndarray, values: np.ndarray, rate: float, start: float, end: float
) -> np.ndarray:
    period = float(np.median(np.diff(time)))
    if ANTI_ALIASING * rate < 0.5 / period and rate * period < 0.999:
        values = _filtered(time, values, ANTI_ALIASING * rate, 4, zero_phase=True)
    return interpolated(_grid(rate, start, end), time, values)


def _filtered(
    time: np.ndarray, values: np.ndarray, cutoff: float, order: int, zero_phase: bool
) -> np.ndarray:
    """A Butterworth filter along the rows, which starts as if the first value had always been."""
    # Slow to load, and needed only here.
    from scipy.signal import butter, sosfilt, sosfilt_zi, sosfiltfilt

    period = float(np.median(np.diff(time)))
    if not 0.0 < cutoff < 0.5 / period:
        raise ConfigurationError(
            f"{cutoff:g} Hz is not between 0 and half the rate, {0.5 / period:g} Hz",
            field="cutoff",
            fix="Give a lower cutoff, or leave the filter out.",
        )
    is_uniform = bool(np.abs(np.diff(time) - period).max() < 0.01 * period)
    if not is_uniform:
        uniform = _grid(1.0 / period, float(time[0]), float(time[-1]) + period)
        on_grid = interpolated(uniform, time, values)
        filtered = _filtered(uniform, on_grid, cutoff, order, zero_phase)
        return interpolated(time, uniform, filtered)
    sections = butter(order, cutoff, fs=1.0 / period, output="sos")
    if zero_phase:
        # As long as the filter remembers, so that the ends do not ring.
        pad = min(len(values) - 1, int(np.ceil(order / (cutoff * period))))
        return sosfiltfilt(sections, values, axis=0, padlen=pad)
    steady = sosfilt_zi(sections)
    state = np.multiply.outer(steady, values[0])
    return sosfilt(sections, values, axis=0, zi=state)[0]
