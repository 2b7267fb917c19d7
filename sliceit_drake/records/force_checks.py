"""Checks of the force in a slice record: units, sign, taring, saturation, a dead sensor."""

import dataclasses as dc

import numpy as np
from scipy.integrate import trapezoid

from sliceit_drake.records import slice_record as fmt
from sliceit_drake.records.findings import Findings, runs
from sliceit_drake.records.preprocessing import MIN_AIR_ROWS
from sliceit_drake.records.slice_record import SliceRecord, SliceTable
from sliceit_drake.records.spikes import without_spikes

__all__ = ["check_force", "flat_top"]

MIN_FORCE = 0.1
"""A slice whose force stays below this, N, is too light even for soft tofu: it is in kN."""
FINEST_NOISE = 1e-3
"""No sensor on a wrist is quieter, N: the finest have steps of 3 mN, a UR5e's scatters by 0.1 N. A
weak force from a sensor that good is one in kN."""
WEAK_FORCE = 1.0
"""Below this the noise is looked at, N."""
MIN_WORK = 1.0
"""Work over cut area below this, J/m2, is less than the toughness of any food, soft gels too."""
MOST_WORK = 2e4
"""Work over cut area above this, J/m2, is several times that of a carrot with all its friction."""
GREATEST_FORCE = 5000.0
"""A force above this, N, breaks any arm that holds a kitchen knife."""
FROZEN_TIME = 0.2
"""A sensor that shows exactly the same for this long while the knife cuts is stuck, s."""
OFFSET = 0.02
"""Fraction of the greatest force that an offset in the air may have."""
FLAT, FLAT_FAR = 5.0, 50.0
"""Rows at exactly the greatest value that tell a saturated sensor, near its range and far."""
DRIFT = 0.05
"""Fraction of the greatest force by which a sensor's zero may drift over the record."""
LEVEL, LONG = 0.02, 0.2
"""Fractions of the greatest force within which, and of the slice for which, it is level at the end
where the knife stands still or has left the food."""
ALONG = 0.2
"""Fraction of |F| |v| that the power must have at least for its sign to mean something."""


def check_force(table: SliceTable, record: SliceRecord, findings: Findings) -> None:
    """Adds to the findings what is wrong with the force, of a table and its record in W."""
    measured, record = record, _without_spikes(record)
    magnitude = record.force_magnitude
    name = record.force_columns[0]
    if np.ptp(measured.force_magnitude) == 0.0:
        if record.is_of_air:
            # A sensor that reads in coarse steps feels nothing there.
            return
        findings.add("constant", name, f"is {magnitude[0]:.6g} N in every row")
        return
    if measured.force_norm is not None and (measured.force_norm < 0.0).any():
        k = int(measured.force_norm.argmin())
        findings.add("negative norm", name, f"a norm is {measured.force_norm[k]:.4g} N", (k, k))
    air = record.first_phase("air")
    cut = record.cut_rows
    _check_tare(record, air, findings)
    if magnitude.max() > GREATEST_FORCE:
        k = int(magnitude.argmax())
        findings.add("force unit", name, f"the force reaches {magnitude[k]:.4g} N", (k, k))
    elif cut.any():
        _check_units(record, air, cut, name, findings)
        if not findings.has("kilonewtons"):
            _check_sign(table, record, air, cut, findings)
    _check_saturation(table, measured, findings)
    _check_frozen(table, cut, findings)
    if record.metadata.motion.phases and not findings.has("clipped", "frozen", "kilonewtons"):
        _check_end(record, air, record.first_phase("slice"), findings)


def _without_spikes(record: SliceRecord) -> SliceRecord:
    force = without_spikes(record.measured_force)[0]
    if record.force is not None:
        return dc.replace(record, force=force)
    if record.force_norm is not None:
        return dc.replace(record, force_norm=force[:, 0])
    return dc.replace(record, force_vertical=force[:, 0])


def _known_offset(record: SliceRecord, air: np.ndarray) -> np.ndarray | None:
    """What to subtract so that food and board alone are left, of the measured columns.

    None if an offset may be there that cannot be told.
    """
    nothing = np.zeros(len(record.force_columns))
    if record.force_norm is not None:
        return nothing
    if air.sum() >= MIN_AIR_ROWS:
        return record.measured_force[air].mean(axis=0)
    facts = record.metadata.wrench
    return nothing if facts.tared == "yes" and "gravity" not in facts.includes else None


def _check_tare(record: SliceRecord, air: np.ndarray, findings: Findings) -> None:
    facts = record.metadata.wrench
    if air.sum() < MIN_AIR_ROWS:
        text = f"the first phase labelled air has not {MIN_AIR_ROWS} rows: the sensor's zero and"
        findings.fact("no air phase", "motion.phases", f"{text} noise are unknown")
        return
    if record.phase("air").all():
        return  # Such a record is there to show zero and drift; no force makes them large or small.
    force = record.measured_force[air]
    mean, scatter = force.mean(axis=0), force.std(axis=0)
    peak = float(record.force_magnitude.max())
    # A norm of noise is not zero in the mean; ten rows of a filtered sensor are one reading.
    is_norm = record.force_norm is not None
    allowed = 3.0 * scatter if is_norm else 5.0 * scatter / np.sqrt(air.sum() / 10.0)
    allowed = np.maximum(allowed, OFFSET * peak)
    axis = int((np.abs(mean) - allowed).argmax())
    weighs_tool = "gravity" in facts.includes and facts.tared != "yes"
    if abs(mean[axis]) > allowed[axis] and not weighs_tool:
        name = record.force_columns[axis]
        text = f"the force in the air is {mean[axis]:.3g} N in the mean, with a scatter of"
        text += f" {scatter[axis]:.2g} N; wrench.tared is {facts.tared}"
        fix = "Give its components, or the vertical one: no zero can be taken off a norm."
        findings.add("no tare", name, text, _ends(air), fix if is_norm else None)
    _check_drift(record, air, findings)


def _check_drift(record: SliceRecord, air: np.ndarray, findings: Findings) -> None:
    """A zero that moves in the air goes on moving in the food."""
    time, force = record.time[air], record.measured_force[air]
    moved = time - time.mean()
    slope = moved @ force / (moved @ moved)
    left = force - force.mean(axis=0) - np.outer(moved, slope)
    # Of a filtered sensor ten rows are one reading.
    spread = left.std(axis=0) * np.sqrt(10.0 / (moved @ moved))
    lasting = float(record.time[-1] - time.mean())
    shift = np.abs(slope) * lasting
    axis = int(shift.argmax())
    peak = float(record.force_magnitude.max())
    if shift[axis] > DRIFT * peak and abs(slope[axis]) > 5.0 * spread[axis]:
        text = f"the force in the air changes by {slope[axis]:.2g} N/s: {shift[axis]:.2g} N by the"
        text += " last row, if it goes on"
        findings.add("drift", record.force_columns[axis], text, _ends(air))


def _check_units(
    record: SliceRecord, air: np.ndarray, cut: np.ndarray, name: str, findings: Findings
) -> None:
    offset = _known_offset(record, air)
    if offset is None:
        return
    magnitude = np.linalg.norm(record.measured_force - offset, axis=1)
    peak = float(np.percentile(magnitude[cut], 95.0))
    problem = ""
    if peak < MIN_FORCE:
        problem = f"the force while slicing stays below {peak:.3g} N, expected at least"
        problem += f" {MIN_FORCE:g} N"
    elif peak < WEAK_FORCE and 1e-6 < (noise := _noise(record, air)) < FINEST_NOISE:
        problem = f"the force while slicing stays below {peak:.3g} N, and its noise in the air is"
        problem += f" {noise:.1g} N, less than any such sensor has"
    elif (area := _section_area(record)) is not None:
        v, _ = fmt.velocities(record.time, record.position, record.rotation)
        speed = np.linalg.norm(v, axis=1)
        work = trapezoid(np.where(cut, magnitude * speed, 0.0), record.time)
        if work < MIN_WORK * area:
            problem = f"the work of slicing is {work / area:.2g} J per m2 of cut, expected at least"
            problem += f" {MIN_WORK:g} J/m2"
        elif work > MOST_WORK * area:
            text = f"the work of slicing is {work / area:.2g} J per m2 of cut, expected at most"
            findings.add("great work", name, f"{text} {MOST_WORK:g} J/m2", _ends(cut))
    if problem:
        findings.add("kilonewtons", name, problem, _ends(cut))


def _ends(mask: np.ndarray) -> tuple[int, int]:
    """Indices of the first and the last True."""
    rows = np.flatnonzero(mask)
    return int(rows[0]), int(rows[-1])


def _noise(record: SliceRecord, air: np.ndarray) -> float:
    """Standard deviation in the air of the noisiest component, N, after drift; 0 if not known."""
    if air.sum() < MIN_AIR_ROWS:
        return 0.0
    return float(np.diff(record.measured_force[air], axis=0).std(axis=0).max() / np.sqrt(2.0))


def _section_area(record: SliceRecord) -> float | None:
    """Area of the cut through the middle of the food, m2, if its size is known."""
    food = record.metadata.food
    if food.size is None or food.shape == "unknown":
        return None
    return food.size[0] * food.size[2] * (1.0 if food.shape == "box" else 0.25 * np.pi)


def _check_sign(
    table: SliceTable, record: SliceRecord, air: np.ndarray, cut: np.ndarray, findings: Findings
) -> None:
    """Food and board take work from the knife, so that the power of their force is negative."""
    offset = _known_offset(record, air)
    if record.force_norm is not None or offset is None:
        return
    force = record.measured_force - offset
    v, _ = fmt.velocities(record.time, record.position, record.rotation)
    if record.force is None:
        v = v[:, 2:]
    power = np.einsum("ij,ij->i", force, v)
    most = np.linalg.norm(force, axis=1) * np.linalg.norm(v, axis=1)
    work = trapezoid(np.where(cut, power, 0.0), record.time)
    scale = trapezoid(np.where(cut, most, 0.0), record.time)
    if scale <= 0.0:
        return
    # What the file says, not what the record has become by it.
    facts = table.metadata.wrench
    axis = int(np.abs(force[cut]).mean(axis=0).argmax())
    if work > ALONG * scale:
        other = "on_knife" if facts.sign == "by_knife" else "by_knife"
        text = f"the force on the knife drives it: work of {work:+.3g} J while slicing, expected"
        fix = f'Write wrench.sign: {other}, or correct wrench.frame ("{facts.frame}").'
        findings.add(
            "flipped sign", record.force_columns[axis], f"{text} negative", _ends(cut), fix
        )
    elif work > -ALONG * scale:
        text = f"the force is across the knife's motion: its work while slicing is {work:+.3g} J of"
        text += f" {scale:.3g} J, were it along it"
        fix = f'Check wrench.frame ("{facts.frame}"), and the placement of the knife on the tool.'
        findings.add("frame", record.force_columns[axis], text, _ends(cut), fix)


def _check_saturation(table: SliceTable, record: SliceRecord, findings: Findings) -> None:
    """Values at the sensor's range, or exactly the same greatest value for several rows."""
    sensor = record.metadata.sensor
    for names, limit in (
        (fmt.FORCE, sensor.force_range),
        ((fmt.FORCE_VERTICAL,), sensor.force_range),
        (fmt.TORQUE, sensor.torque_range),
    ):
        if not table.has(names):
            continue
        for name, values in _in_sensor_axes(table, record, names):
            at = np.abs(values) >= 0.995 * (np.inf if limit is None else limit)
            if at.any():
                text = f"{int(at.sum())} rows are at the sensor's range, {limit:g}"
                _report_clipping(findings, name, text, at)
            else:
                # After taring a sensor saturates at another value than its range; one that does so
                # far from it, an amplifier or a wrong range, must do so for longer to be believed.
                near = limit is None or np.abs(values).max() > 0.3 * limit
                _check_flat_top(name, values, findings, FLAT if near else FLAT_FAR)
    if record.force_norm is not None:
        _check_flat_top(fmt.FORCE_NORM, record.force_norm, findings)


def _in_sensor_axes(
    table: SliceTable, record: SliceRecord, names: tuple[str, ...]
) -> list[tuple[str, np.ndarray]]:
    """Components in the axes in which the sensor saturates, where they are known."""
    R_KS = fmt.sensor_rotation(table.metadata)
    if names == fmt.FORCE and record.force is not None and R_KS is not None:
        R_SW = (record.rotation @ R_KS).transpose(0, 2, 1)
        values = (R_SW @ record.force[:, :, None])[:, :, 0]
        return [(f"{name} (in S)", values[:, i]) for i, name in enumerate(names)]
    return [(name, table.columns[name]) for name in names]


def flat_top(values: np.ndarray, least: float = FLAT) -> np.ndarray:
    """Rows [n] at exactly the greatest or least value, where more of them follow each other than
    the signal [n] usually repeats: the sensor is at its limit."""
    starts = np.concatenate([[0], np.flatnonzero(np.diff(values) != 0.0) + 1])
    lengths = np.diff(np.concatenate([starts, [len(values)]]))
    out = np.zeros(len(values), bool)
    for extreme in (values.max(), values.min()):
        is_extreme = values[starts] == extreme
        if abs(extreme) < 0.5 * np.abs(values).max() or is_extreme.all():
            continue
        # A slow sensor in a fast table, or a coarse one, repeats values all the time.
        usual = 3.0 * np.percentile(lengths[~is_extreme], 95.0)
        if lengths[is_extreme].max() >= max(least, usual):
            out |= values == extreme
    return out


def _check_flat_top(name: str, values: np.ndarray, findings: Findings, least: float = FLAT) -> None:
    at = flat_top(values, least)
    for extreme in np.unique(values[at])[::-1]:
        same = values == extreme
        first, last = max(runs(same), key=lambda run: run[1] - run[0])
        text = f"{last - first + 1} rows in a row are exactly {extreme:.6g}, as of a sensor at its"
        _report_clipping(findings, name, f"{text} limit", same)


def _report_clipping(findings: Findings, name: str, text: str, at: np.ndarray) -> None:
    rows = max(runs(at), key=lambda run: run[1] - run[0])
    findings.add("clipped", name, text, rows)


def _check_frozen(table: SliceTable, cut: np.ndarray, findings: Findings) -> None:
    names = next(n for n in (fmt.FORCE, ("force_norm",), ("force_vertical",)) if table.has(n))
    same = (np.diff(table.stack(names), axis=0) == 0.0).all(axis=1) & cut[1:] & cut[:-1]
    time = table.columns[fmt.TIME]
    for first, last in runs(same):
        if time[last + 1] - time[first] > FROZEN_TIME and not findings.has("clipped"):
            text = (
                f"the sensor shows the same for {time[last + 1] - time[first]:.2g} s of the slice"
            )
            findings.add("frozen", names[0], text, (first, last + 1))
            return


def _check_end(record: SliceRecord, air: np.ndarray, cut: np.ndarray, findings: Findings) -> None:
    """A force that is level at the end of the slice: the knife stood, or had left the food."""
    rows = np.flatnonzero(cut)
    if len(rows) < 2 * MIN_AIR_ROWS:
        return
    force = record.measured_force[rows]
    force = force[:, [np.ptp(force, axis=0).argmax()]]
    around = np.median(force[-max(MIN_AIR_ROWS, len(rows) // 20) :])
    least = max(LEVEL * np.ptp(force), 5.0 * _noise(record, air))
    away = np.flatnonzero(np.abs(force[:, 0] - around) > least)
    if away.size == 0:
        return
    first = int(away[-1]) + 1
    time = record.time[rows]
    if first < len(rows) and time[-1] - time[first] > LONG * (time[-1] - time[0]):
        text = f"the force is level at {around:.3g} N from {time[first]:.4g} s to the end of the"
        fix = f"Did the knife stand, or leave the food? End the slice at {time[first]:.4g} s."
        name = record.force_columns[0]
        findings.add("level end", name, f"{text} slice", (rows[first], rows[-1]), fix)
