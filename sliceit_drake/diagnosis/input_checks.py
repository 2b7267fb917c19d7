"""Looks at the records of a diagnosis before anything is simulated.

Each record by itself was read and checked (`records.validation`). Here stands what only a diagnosis
asks: that the records belong together and to the model, and that they hold what it needs. What
cannot be used is an error with file, field and fix; what a reader must know is a remark.
"""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np
from scipy.ndimage import median_filter

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.cutting.foods.shapes import PlainShape
from sliceit_drake.prediction.placement import is_bare
from sliceit_drake.prediction.record_set import check_foods, check_same_slice, facts_file
from sliceit_drake.records.slice_record import SliceRecord
from sliceit_drake.records.spikes import without_spikes
from sliceit_drake.records.validation import check_record

__all__ = ["check_records", "without_lone_torques"]

BEGUN = 0.1
"""Fraction of the greatest force that the first rows may have before contact."""
CONTACT = 0.1
"""Fraction of the greatest force at which there is contact for certain."""
CUTTING = ("slice", "second_pass", "hold", "retract")
EARLY, LATE = 2e-3, 0.5
"""How far above the food contact may begin, metres, and how deep in it, of its height."""
NEAR_BOARD = 1e-3
"""Height over the board above which the food alone is met, metres."""
OVER_AIR = 2.0
"""Force over the greatest in the air at which a small one is of the food."""
LASTING = 9
"""Rows over more than half of which a force is there for certain."""
LEAST_ROWS = 40
"""Rows of a record from which noise can be told from a force."""
OFF_BOARD = 5e-3
"""Distance of a food from its board that is more than an error of measurement, metres."""
DROPPED = 1e-3
"""Fraction of missing rows that is said."""
LONG_GAP = 6.0
"""Rows from which on a gap is reported as one."""
SAME_SPEED, SAME_DRAW = 0.1, 0.1
"""Differences that cuts of one condition may have, relative and absolute."""
OBVIOUS = ("missing fact", "phases", "unknown name")
"""Warnings on facts that a diagnosis does not ask for; `sliceit records check` has them."""


def check_records(
    records: Sequence[SliceRecord], food: Food, other_food: bool = False
) -> list[str]:
    """Refuses records that do not belong together or to the model's food.

    Args:
        records: Of the diagnosis.
        food: Of the model.
        other_food: Whether records of a food of another name are meant.

    Returns:
        What a reader must know.

    Raises:
        ConfigurationError: Naming file, field and fix.
    """
    check_same_slice(records)
    fix = "Give the model of that food (--model {}; sliceit calibrate makes one)"
    check_foods(records, food.name, "model", fix, other_food)
    _check_phases(records)
    _check_channels(records)
    for record in records:
        _check_force(record)
        if not is_bare(record):
            _check_contact(record, food)
        _check_board(record, records)
    remarks = [
        *_conditions(records),
        _spikes(records),
        _dropped(records),
        _knives(records),
        _torques(records),
        *_warnings(records),
    ]
    return list(dict.fromkeys(remark for remark in remarks if remark))


def without_lone_torques(records: Sequence[SliceRecord]) -> list[SliceRecord]:
    """The records without torques, where some have none: all must have the same channels."""
    if all(r.torque is not None for r in records):
        return list(records)
    return [dc.replace(r, torque=None) for r in records]


def _torques(records: Sequence[SliceRecord]) -> str:
    lack = [r.name for r in records if r.torque is None]
    if not 0 < len(lack) < len(records):
        return ""
    return (
        f"{_some(lack)}: no torque, so that the torques of the other records are not used either."
        " Give torque_x..z and wrench.point for all."
    )


def _check_phases(records: Sequence[SliceRecord]) -> None:
    cut = [r for r in records if not is_bare(r)]
    if all(r.metadata.motion.phases and not r.phase(*CUTTING).any() for r in cut):
        raise ConfigurationError(
            "in none of the records is a phase labelled slice: nothing is cut",
            source=facts_file(cut[0]),
            field="motion.phases",
            fix="Add records of slices, and label the time in which the knife cuts as slice.",
        )


def _check_channels(records: Sequence[SliceRecord]) -> None:
    kinds: dict[str, list[SliceRecord]] = {}
    for record in records:
        kinds.setdefault(record.force_columns[0], []).append(record)
    if len(kinds) > 1:
        column, few = min(kinds.items(), key=lambda kind: len(kind[1]))
        raise ConfigurationError(
            f"has {few[0].known_force}, unlike {len(records) - len(few)} of the {len(records)} "
            "records",
            source=few[0].source,
            field=column,
            fix="Give all records the same columns: force_x, force_y, force_z, or force_norm alone,"
            " or force_vertical alone; or diagnose the kinds apart.",
        )


def _check_force(record: SliceRecord) -> None:
    if len(record) < LEAST_ROWS:
        raise ConfigurationError(
            f"has {len(record)} rows, too few to tell a force from its noise",
            source=record.source,
            field="time",
            fix=f"Give at least {LEAST_ROWS} rows, at the sensor's own rate.",
        )
    if float(np.ptp(record.force_magnitude)) < 1e-9 and not record.is_of_air:
        raise ConfigurationError(
            "has a constant force: there is nothing to compare",
            source=record.source,
            field="force",
            fix="Check the sensor and its cable; record again.",
        )


def _check_board(record: SliceRecord, records: Sequence[SliceRecord]) -> None:
    """Refuses a board that is not where the food lies, its own or else that of the others."""
    facts = record.metadata
    known = [r.metadata.food.position for r in (record, *records) if not is_bare(r)]
    heights = [position[2] for position in known if position is not None]
    unknown = {"board_height", "food.position"} & set(facts.unknown)
    if facts.board_height is None or unknown or not heights:
        return
    above = heights[0] - facts.board_height
    if abs(above) > OFF_BOARD:
        raise ConfigurationError(
            f"is {facts.board_height:g} m, and the food, whose position is on the board, is at"
            f" {heights[0]:g} m: {1e3 * abs(above):.3g} mm {'above' if above > 0 else 'below'} it",
            source=facts_file(record),
            field="board_height",
            fix="Correct board_height or food.position; both are in the world frame, in metres.",
        )


def _spikes(records: Sequence[SliceRecord]) -> str:
    found = []
    for record in records:
        force = record.measured_force
        count = int((without_spikes(force)[1] > 0.0).any(1).sum())
        if count:
            found.append(f"{record.name} {count} of {len(record)}")
    if not found:
        return ""
    return (
        f"{_some(found)}: rows in which the force stands out from those before and after, as a"
        " sensor's or a bus's fault does. They count for little; check the cable if there are many."
    )


def _dropped(records: Sequence[SliceRecord]) -> str:
    found = []
    for record in records:
        steps = np.diff(record.time) / np.median(np.diff(record.time))
        # Longer gaps are findings of the record itself.
        missing = int((np.rint(steps[steps < LONG_GAP]) - 1.0).clip(0.0).sum())
        if missing > DROPPED * len(record):
            found.append(f"{record.name} {missing} of {len(record) + missing}")
    text = "rows are missing; what is there is used at its own times."
    return f"{_some(found)}: {text}" if found else ""


def _check_contact(record: SliceRecord, food: Food) -> None:
    """Refuses a record that begins in the food, or whose knife is not where its force is."""
    if not record.phase("slice").any():
        return
    force = without_spikes(record.force_magnitude[:, None])[0][:, 0]
    if record.force_norm is None:
        clean, _ = without_spikes(record.measured_force)
        force = np.linalg.norm(clean - clean[:3].mean(axis=0), axis=1)
    peak = float(force.max())
    facts = record.metadata
    if record.force_norm is not None and force[:3].mean() > BEGUN * peak:
        raise ConfigurationError(
            f"begins with {force[:3].mean():.3g} N, {100 * force[:3].mean() / peak:.0f} % of its"
            " greatest force: the knife is in the food already, or the sensor was not tared",
            source=record.source,
            field="force_norm",
            fix="Record from before the first contact, with the sensor tared.",
        )
    unknown = {"p_WK_z", "food.position"} & set(facts.unknown)
    height = _height(record, food)
    if unknown or facts.food.position is None or height is None:
        return
    cut = record.phase("slice")
    above = record.position[:, 2] - (facts.food.position[2] + height)
    if above[cut].min() > 0.0:
        raise ConfigurationError(
            f"the knife stays {1e3 * above[cut].min():.3g} mm or more above the food",
            source=record.source,
            field="p_WK_z",
            fix="Correct food.position or the heights; both are in the world frame, in metres.",
        )
    air = record.phase("air")
    if air.any() and float(force[air].max()) > CONTACT * peak:
        # Weight, vibration or a sensor's zero: where contact begins does not show in the force.
        return
    # One row over it is noise, which has more rows over the food than in the air.
    lasting = median_filter(force, LASTING)
    touches = cut & (lasting > CONTACT * peak)
    begins = float(above[np.argmax(touches)])
    if begins < -LATE * height:
        # A draw may meet a tenth of what the board then pushes back with.
        over_board = cut & (above > NEAR_BOARD - height)
        in_air = lasting[~cut & (above > EARLY)].max(initial=0.0)
        least = max(CONTACT * lasting[over_board].max(initial=0.0), OVER_AIR * in_air)
        meets = over_board & (lasting > least)
        if meets.any():
            begins = float(above[np.argmax(meets)])
    if touches.any() and not EARLY >= begins >= -LATE * height:
        where = f"{1e3 * abs(begins):.1f} mm {'above' if begins > 0 else 'below'}"
        raise ConfigurationError(
            f"the force begins {where} the top of the food, which is {1e3 * height:.0f} mm high",
            source=record.source,
            field="p_WK_z",
            fix="Correct food.position, food.size or the knife's pose on the tool; list p_WK_z"
            " under unknown if only changes of the height are known.",
        )


def _height(record: SliceRecord, food: Food) -> float | None:
    """Height of the food over its origin, metres, where it is known without a mesh."""
    size = record.metadata.food.size
    if size is not None:
        return size[2]
    return food.shape.extent[2] if isinstance(food.shape, PlainShape) else None


def _conditions(records: Sequence[SliceRecord]) -> list[str]:
    unnamed = [r.name for r in records if not r.metadata.condition]
    out = []
    if unnamed:
        out.append(
            f"{_some(unnamed)}: no condition given, so that each counts as a cut of its own. Give"
            " slices that were nominally the same the same `condition`."
        )
    first: dict[str, SliceRecord] = {}
    for record in records:
        label, motion = record.metadata.condition, record.metadata.motion
        if not label:
            continue
        other = first.setdefault(label, record)
        was = other.metadata.motion
        if motion.speed is not None and was.speed is not None:
            differs = abs(motion.speed - was.speed) > SAME_SPEED * was.speed
            draws = (motion.draw_ratio or 0.0), (was.draw_ratio or 0.0)
            if differs or abs(draws[0] - draws[1]) > SAME_DRAW:
                raise ConfigurationError(
                    f"is {label!r}, as that of {facts_file(other)}, which was cut at"
                    f" {was.speed:g} m/s with a draw of {draws[1]:g}, not {motion.speed:g} m/s with"
                    f" {draws[0]:g}",
                    source=facts_file(record),
                    field="condition",
                    fix="Give different cuts different conditions: what replicates do not share is"
                    " taken for noise.",
                )
    return out


def _knives(records: Sequence[SliceRecord]) -> str:
    kinds: dict[str, list[str]] = {}
    for record in records:
        kinds.setdefault(repr(record.metadata.knife), []).append(record.name)
    if len(kinds) < 2:
        return ""
    return (
        f"{_some(min(kinds.values(), key=len))}: another knife than in the other records. Each is"
        " simulated with its own measures, but bluntness and dulling are taken for the same."
        " Diagnose each knife apart if these are in question."
    )


def _warnings(records: Sequence[SliceRecord]) -> list[str]:
    """What the check of each record warns of, one line a kind."""
    found: dict[str, tuple[list[str], str]] = {}
    for record in records:
        for finding in check_record(record):
            if finding.severity == "warning" and finding.kind not in OBVIOUS:
                names, _ = found.setdefault(
                    finding.kind, ([], f"{finding.problem.rstrip('.')}. {finding.fix}")
                )
                if record.name not in names:
                    names.append(record.name)
    return [f"{_some(names)}: {kind}: {text}" for kind, (names, text) in found.items()]


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more
