"""Causes: at their null they change nothing, and each has the signature that it claims."""

import dataclasses as dc
import functools
import re
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from cause_bench import MASS, TURN, bench

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.diagnosis import registry
from sliceit_drake.diagnosis.cause import EXPERIMENTS, FAMILIES, Cause, CauseParameter
from sliceit_drake.diagnosis.causes import BUILT_IN
from sliceit_drake.diagnosis.causes.mounting import FoodSlip
from sliceit_drake.diagnosis.causes.robot import StickSlip, Vibration, _of_drives
from sliceit_drake.diagnosis.evidence.columns import RecordSensitivity, Sensitivities
from sliceit_drake.diagnosis.evidence.searches import unlike_others
from sliceit_drake.diagnosis.evidence.sensitivity import sensitivities
from sliceit_drake.diagnosis.prediction import ActiveCause, Point, SlicePredictor
from sliceit_drake.diagnosis.registry import all_causes, load_cause, open_causes
from sliceit_drake.prediction.record_target import Meshing

DOCS = Path(__file__).resolve().parent.parent / "docs/reference"
GRAVITY = 9.81
X, Y, Z = range(3)
MIDDLE = "share_medium"


@functools.cache
def found() -> Sensitivities:
    setup, records = bench()
    return sensitivities(setup, records, all_causes(), finer=None)


def record(condition: str) -> RecordSensitivity:
    (only,) = (r for r in found().records if r.condition == condition)
    return only


def change(condition: str, name: str, parameter: str = "", scan: float | None = None) -> np.ndarray:
    """What a cause or base parameter changes in a record [m, c]; its first parameter by default,
    at the middle of its scan."""
    s = found()
    kind = "cause" if name in s.causes else "base"
    if scan is None and kind == "cause":
        scans = s.scans(name)
        scan = scans[len(scans) // 2]
    columns = s.index(kind, name, scan)
    (k,) = [k for k in columns if parameter in ("", s.columns[k].parameter)][:1]
    return record(condition).columns[:, :, k].astype(float)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def within(condition: str, low: float, high: float, phase: str = "slice") -> np.ndarray:
    """Rows of a phase between two fractions of the food's height."""
    r = record(condition)
    share = r.depth / 0.027
    return (r.phase == phase) & (share > low) & (share < high)


def settled_hold(condition: str) -> tuple[np.ndarray, np.ndarray]:
    """Rows at the beginning and at the end of the hold half way, without where it still settles."""
    r = record(condition)
    held = np.flatnonzero(r.phase == "hold")
    return held[20:30], held[-10:]


SIMULATED = [kind() for kind in BUILT_IN]


def test_a_cause_at_its_null_changes_nothing():
    setup, records = bench()
    chosen = [r for r in records if r.metadata.condition in ("fast", "board")]
    predictor = SlicePredictor(setup, chosen)
    base = predictor.predict([Point()])[0]
    assert all(series is not None and np.abs(series.wrench).max() > 1.0 for series in base)
    for cause in SIMULATED:
        values = cause.nulls()
        if cause.scan is not None:
            values[cause.scan.name] = cause.scan.values[0]
        rows = predictor.predict([Point(causes=(ActiveCause(cause, values),))])[0]
        for series, before in zip(rows, base, strict=True):
            assert np.array_equal(series.wrench, before.wrench), cause.name


def test_each_cause_says_what_it_is():
    for cause in SIMULATED:
        assert cause.family in FAMILIES and cause.experiment in EXPERIMENTS, cause.name
        assert cause.signature and cause.__doc__, cause.name


def test_the_docs_list_each_cause_and_leave_out_no_row():
    listed = re.findall(r"^\| (\d+) \| `(\w+)` \|", (DOCS / "causes.md").read_text(), re.MULTILINE)
    assert {name for _, name in listed} == {kind.name for kind in BUILT_IN}
    # 3 is that of the discretisation's columns; 6 is the toughness, a base parameter.
    assert {int(row) for row, _ in listed} == set(range(1, 22)) - {3, 6}


def test_a_free_base_parameter_takes_the_place_of_its_cause():
    names = {cause.name for cause in open_causes(["effects.skin.toughness"])}
    assert "skin" not in names and "bluntness" in names


def test_only_a_viscoelastic_bulk_decays_in_a_hold():
    first, last = settled_hold("fast")
    decay = {
        name: abs(change("fast", name)[first, Z].mean() - change("fast", name)[last, Z].mean())
        for name in found().causes
    }
    del decay["viscoelasticity"]
    force = change("fast", "viscoelasticity", MIDDLE)[:, Z]
    relaxed = force[first].mean() - force[last].mean()
    assert force[last].mean() < -0.1
    assert relaxed > 0.05
    # What a sensor adds by time is no force of the food.
    del decay["sensor_zero"]
    assert all(value < 0.2 * relaxed for value in decay.values()), decay


def test_a_rate_of_the_toughness_goes_with_the_speed_and_ceases_when_the_edge_stops():
    slow, fast = (change(c, "toughness_rate")[:, Z] for c in ("slow", "fast"))
    assert slow[within("slow", 0.3, 0.48)].mean() < -0.1
    assert fast[within("fast", 0.3, 0.48)].mean() > 0.1
    first, _ = settled_hold("fast")
    # At rest R is less for an exponent above zero; below, the edge asks for no more than at rest.
    assert fast[first].mean() < -0.5


def test_friction_and_adhesion_flip_their_sign_on_withdrawal():
    # The withdrawal is faster than the press, so that less is left of the friction at rest.
    for name, out in (
        ("material.friction", -0.02),
        ("adhesion", -0.02),
        ("static_friction", -1e-3),
    ):
        force = change("fast", name)[:, Z]
        assert force[within("fast", 0.3, 0.48)].mean() > 0.01, name
        assert force[within("fast", 0.2, 0.8, "retract")].mean() < out, name
    # Toughness asks for nothing on the way out.
    toughness = change("fast", "material.toughness")[:, Z]
    out = within("fast", 0.2, 0.8, "retract")
    assert abs(toughness[out].mean()) < 0.1 * toughness[within("fast", 0.3, 0.48)].mean()


def test_the_viscous_part_of_adhesion_grows_with_the_speed_and_the_other_does_not():
    def ratio(parameter: str) -> float:
        slow, fast = (
            change(c, "adhesion", parameter)[within(c, 0.2, 0.48), Z].mean()
            for c in ("slow", "fast")
        )
        return float(fast / slow)

    assert ratio("stress") == pytest.approx(1.0, abs=0.35)
    assert ratio("viscosity") > 2.0


def test_friction_at_rest_matters_less_the_faster_the_knife():
    slow, fast = (
        change(c, "static_friction")[within(c, 0.2, 0.48), Z].mean() for c in ("slow", "fast")
    )
    assert slow > 2.0 * fast > 0.0


def test_a_skin_shows_at_entry_and_exit_and_not_where_it_was_peeled():
    force = change("fast", "skin")[:, Z]
    # Two rings of elements: the skin is as thick as half of one.
    middle = force[within("fast", 0.4, 0.5)].mean()
    assert force[within("fast", 0.05, 0.2)].mean() > 1.4 * middle > 0.1
    assert force[within("fast", 0.8, 0.95)].mean() > 1.4 * middle
    assert not change("peeled", "skin").any()


def test_a_blunt_edge_shows_at_entry_alone_and_less_in_a_draw():
    force = change("fast", "bluntness", scan=2e-3)[:, Z]
    assert force[within("fast", 0.0, 0.12)].max() > 5.0 * rms(force[within("fast", 0.6, 0.95)])
    drawn = change("draw", "bluntness", scan=2e-3)[:, Z]
    assert drawn[within("draw", 0.0, 0.12)].max() < 0.7 * force[within("fast", 0.0, 0.12)].max()


def test_dulling_begins_with_nothing_and_grows_with_the_slices():
    (slow,) = (r for r in bench()[1] if r.metadata.condition == "slow")
    assert slow.metadata.knife_slices == 0
    assert not change("slow", "dulling").any()
    entry = within("fast", 0.0, 0.12)
    peak = [change("fast", "dulling", scan=s)[entry, Z].max() for s in (0.5, 1.0)]
    later = [change("peeled", "dulling", scan=s)[entry, Z].max() for s in (0.5, 1.0)]
    # After one and after two slices.
    assert later[1] / peak[1] == pytest.approx(2.0, rel=0.15)
    assert later[0] / peak[0] == pytest.approx(np.sqrt(2.0), rel=0.15)


def test_the_slice_push_law_shows_in_a_draw_alone():
    assert rms(change("fast", "slice_push_law")) < 1e-3
    cutting = within("draw", 0.2, 0.8)
    assert change("draw", "slice_push_law")[cutting, Z].mean() < -0.1
    # The pull is along the edge alone.
    pull = change("draw", "slice_push_law", "pull")
    assert np.abs(pull[cutting, X]).mean() > 0.2
    assert rms(pull[:, [Y, Z]]) < 1e-3


def test_a_section_that_is_wider_below_asks_for_more_there_at_any_speed():
    for condition in ("slow", "fast"):
        force = change(condition, "section_shape", "taper")[:, Z]
        upper, lower = within(condition, 0.1, 0.35), within(condition, 0.65, 0.9)
        assert force[upper].mean() < -0.05 < 0.05 < force[lower].mean()


def test_a_weak_core_shows_in_the_middle():
    force = change("fast", "core", scan=0.5)[:, Z]
    assert force[within("fast", 0.4, 0.48)].mean() < -0.5
    assert abs(force[within("fast", 0.0, 0.06)].mean()) < 0.1


def test_a_board_shows_where_it_is_touched():
    touched = record("fast").depth > 0.027
    stiffer = change("fast", "board_stiffness", "share")
    assert stiffer[touched, Z].max() > 0.5
    assert rms(stiffer[record("fast").depth < 0.026]) < 1e-6
    higher = change("fast", "board_height")[:, Z]
    assert higher[touched].max() > 2.0


def test_an_arm_that_gives_halves_the_force_of_a_board_that_is_as_stiff():
    setup, _ = bench()
    board = record("board")
    held = slice(-20, None)
    compliance = 1e-5
    expected = board.predicted[held, Z] / (1.0 + compliance * setup.board.stiffness)
    after = board.predicted[held, Z] + change("board", "arm_compliance")[held, Z]
    assert board.predicted[held, Z].mean() > 3.0
    assert after == pytest.approx(expected, rel=0.01)


def test_an_arm_that_gives_takes_from_a_force_that_rises():
    force = change("fast", "arm_compliance")[:, Z]
    assert force[within("fast", 0.02, 0.2)].mean() < -0.025


def test_an_arm_that_creeps_takes_from_the_force_of_the_board_with_time():
    lost = change("board", "arm_compliance", "creep")[:, Z]
    held = np.flatnonzero(record("board").predicted[:, Z] > 3.0)
    assert lost[held[-1]] < 2.0 * lost[held[len(held) // 3]] < 0.0


def test_a_holder_that_gives_shows_along_the_edge_of_a_draw():
    assert rms(change("draw", "holder_compliance")[:, X]) > 0.05
    assert rms(change("fast", "holder_compliance")) < 0.01


def with_residual(condition: str, added: np.ndarray) -> RecordSensitivity:
    """A record in which nothing is wrong but what is added to all forces [m], and noise."""
    r = record(condition)
    rest = 0.02 * np.random.default_rng(0).normal(size=r.predicted.shape)
    rest[:, :3] += added[:, None]
    return dc.replace(r, measured=r.predicted + rest)


def acting(cause: Cause, condition: str, **values: float) -> np.ndarray:
    """What a cause adds to a record [m, c]."""
    setup, records = bench()
    chosen = [r for r in records if r.metadata.condition == condition]
    predictor = SlicePredictor(setup, chosen, [Meshing()])
    active = ActiveCause(cause, cause.nulls() | values)
    (without,), (with_it,) = predictor.predict([Point(), Point(causes=(active,))])
    (target,) = predictor.targets
    assert without is not None and with_it is not None
    both = target.compare(np.stack([without.wrench, with_it.wrench], axis=2))
    return np.asarray(both[:, :, 1] - both[:, :, 0])


def test_a_slip_is_found_where_the_force_jumps_and_fades_from_there():
    r = record("fast")
    moment = float(r.time[within("fast", 0.3, 0.35)][0])
    since = r.time - moment
    jump = np.where(since > 0.0, 0.4 * np.exp(-np.clip(since, 0.0, None) / 0.05), 0.0)
    slip = FoodSlip().adapted([with_residual("fast", jump)])
    knock = acting(slip, "fast", knock_y=1.0, fading=0.05)[:, Y]
    assert r.time[np.argmax(knock > 0.5)] == pytest.approx(moment, abs=0.012)
    assert not knock[r.time < moment - 0.02].any()
    assert knock.max() > 0.7
    assert abs(knock[r.time > moment + 0.4]).max() < 0.01


def test_what_repeats_is_no_slip():
    r = record("fast")
    since = r.time - float(r.time[within("fast", 0.3, 0.35)][0])
    jump = np.where(since > 0.0, 0.4 * np.exp(-np.clip(since, 0.0, None) / 0.05), 0.0)
    alike = [dc.replace(with_residual("fast", jump), name=f"slice {k}") for k in range(3)]
    assert all(not rest[:, :3].any() for rest in unlike_others(alike))
    one = [*alike[:2], with_residual("fast", np.zeros(len(jump)))]
    assert unlike_others(one)[2][:, Z] == pytest.approx(-jump, abs=1e-9)


def test_a_gain_scales_everything_a_known_weight_too():
    for condition in ("fast", "weight"):
        predicted = record(condition).predicted
        assert change(condition, "sensor_gain") == pytest.approx(0.08 * predicted, abs=1e-5)
    held = record("weight").phase == "weight"
    assert record("weight").predicted[held, Z].min() == pytest.approx(-MASS * GRAVITY, abs=0.05)


def test_a_zero_is_there_in_the_air_and_turns_with_the_tool():
    offset = change("weight", "sensor_zero", "bias_z")
    assert offset[0, Z] == pytest.approx(-0.3, abs=0.01)
    assert offset[-1, Z] == pytest.approx(-0.3 * np.cos(TURN), abs=0.01)
    drift = change("fast", "sensor_zero", "drift_z")[:, Z]
    assert drift[-1] == pytest.approx(-0.03 * np.ptp(record("fast").time), rel=0.02)


def test_a_turned_sensor_shows_the_press_sideways():
    force = record("fast").predicted[:, Z]
    sideways = change("fast", "sensor_tilt", "about_x")[:, Y]
    assert sideways == pytest.approx(-np.sin(0.06) * force, abs=0.02)


def test_a_delay_takes_its_time_times_the_rate():
    r = record("fast")
    smooth = within("fast", 0.05, 0.3)
    rate = np.gradient(r.predicted[:, Z], r.time)[smooth]
    late = change("fast", "sensor_delay", scan=4.0)[smooth, Z]
    assert (late @ rate) / (rate @ rate) == pytest.approx(-0.01, rel=0.3)


def test_a_tool_that_nobody_weighed_shows_when_it_turns():
    weight = change("weight", "tool_weight", "mass")
    assert not weight[0].any()
    mass = 0.15
    turned = weight[-1]
    # What was there at the start was taken off, in the axes of the sensor.
    assert turned[Y] == pytest.approx(-mass * GRAVITY * np.sin(TURN), abs=0.02)
    assert turned[Z] == pytest.approx(mass * GRAVITY * (np.cos(TURN) - 1.0), abs=0.02)


def test_a_vibration_is_found_at_its_frequency_and_gone_at_rest():
    r = record("slow")
    wave = 0.1 * np.sin(2.0 * np.pi * 17.3 * r.time) * (np.gradient(r.path, r.time) > 2e-3)
    vibration = Vibration().adapted([with_residual("slow", wave)])
    assert vibration.scan is not None
    frequency = vibration.scan.values[0]
    assert frequency == pytest.approx(17.3, abs=0.1)
    own = acting(vibration, "slow", sine_z=1.0, frequency=frequency)[:, Z]
    assert rms(own[r.phase == "hold"][30:-5]) < 0.03
    moving = within("slow", 0.1, 0.5)
    spectrum = np.abs(np.fft.rfft(own[moving] * np.hanning(moving.sum()), 4096))
    at = np.fft.rfftfreq(4096, r.time[1] - r.time[0])[spectrum.argmax()]
    assert at == pytest.approx(17.3, rel=0.05)


def test_a_hum_that_goes_with_the_speed_is_found_in_each_condition_and_the_mains_is_none():
    frequencies = {"slow": 12.0, "fast": 21.0}
    records = []
    for condition, frequency in frequencies.items():
        r = record(condition)
        moving = np.gradient(r.path, r.time) > 2e-3
        hum = 0.3 * np.sin(2.0 * np.pi * frequency * r.time) * moving
        mains = np.sin(2.0 * np.pi * 33.0 * r.time)
        records.append(with_residual(condition, hum + mains))
    vibration = Vibration().adapted(records)
    assert vibration.scan is not None
    assert all(abs(f - 33.0) > 1.0 for f in vibration.scan.values)
    mean = vibration.scan.values[-1]
    assert mean == pytest.approx(16.5, abs=0.2)
    for condition, frequency in frequencies.items():
        own = acting(vibration, condition, sine_z=1.0, frequency=mean)[:, Z]
        moving = within(condition, 0.1, 0.5)
        spectrum = np.abs(np.fft.rfft(own[moving] * np.hanning(moving.sum()), 4096))
        at = np.fft.rfftfreq(4096, np.diff(record(condition).time)[0])[spectrum.argmax()]
        assert at == pytest.approx(frequency, rel=0.05)


def test_the_mains_are_no_vibration_where_a_short_motion_tells_their_frequency_badly():
    time = np.arange(0.0, 8.0, 0.008)
    moves = (time > 3.0) & (time < 3.5)
    path = 0.05 * np.cumsum(moves) * 0.008
    noise = np.random.default_rng(0).normal(size=(len(time), 3))
    found = {}
    for name, at_rest in (("mains", 1.0), ("drives", 0.0)):
        wave = np.sin(2.0 * np.pi * 33.4 * time) * np.where(moves, 1.0, at_rest)
        hums = SimpleNamespace(
            time=time, path=path, residual=0.4 * noise + wave[:, None], forces=[0, 1, 2]
        )
        found[name] = _of_drives([hums], [hums], 3.0, 60.0)
        # A cut that never rests is compared with what others do at rest.
        parts = {"time": time[moves], "path": path[moves], "residual": hums.residual[moves]}
        cut = SimpleNamespace(**parts, forces=hums.forces)
        found[f"{name} in a cut"] = _of_drives([cut], [cut, hums], 3.0, 60.0)
    for name in ("mains", "mains in a cut"):
        assert all(abs(f - 33.4) > 3.0 for f in found[name])
    assert found["drives in a cut"][0] == pytest.approx(33.4, abs=1.0)
    assert found["drives"][0] == pytest.approx(33.4, abs=1.0)


def test_stick_slip_is_found_at_its_pitch_and_not_there_in_the_air():
    pitch = 1.3e-3
    records = []
    for condition in ("slow", "fast"):
        r = record(condition)
        cutting = r.in_contact & (r.depth > 0.0)
        tooth = np.mod(r.path / pitch, 1.0) - 0.5
        records.append(with_residual(condition, np.where(cutting, 0.3 * tooth, 0.0)))
    stick_slip = StickSlip().adapted(records)
    assert stick_slip.scan is not None
    assert stick_slip.scan.values[0] == pytest.approx(pitch, rel=0.03)
    for condition, speed in (("slow", 0.012), ("fast", 0.04)):
        wave = acting(stick_slip, condition, sine_1=1.0, pitch=pitch)[:, Z]
        moving = within(condition, 0.55, 0.95)
        r = record(condition)
        padded = np.fft.rfft(wave[moving] * np.hanning(moving.sum()), 4096)
        frequency = np.fft.rfftfreq(4096, r.time[1] - r.time[0])[np.abs(padded).argmax()]
        assert frequency == pytest.approx(speed / pitch, rel=0.1), condition
        assert rms(wave[r.depth < -1e-3]) < 1e-6


def example() -> str:
    """The example of the documentation."""
    (code,) = re.findall(r"```python\n(.*?)```", (DOCS / "causes.md").read_text(), re.DOTALL)[:1]
    return code


def test_a_cause_in_a_file_is_loaded_and_used(tmp_path):
    file = tmp_path / "my_cause.py"
    file.write_text(example())
    cause = load_cause(file)
    setup, records = bench()
    chosen = [r for r in records if r.metadata.condition == "fast"]
    s = sensitivities(setup, chosen, [cause], finer=None)
    (k,) = s.index("cause", cause.name)
    (r,) = s.records
    out = (r.phase == "retract") & (r.depth > 2e-3) & (r.depth < 0.02)
    assert r.columns[out, Z, k].mean() < -0.05
    assert abs(r.columns[r.phase == "slice", Z, k].mean()) < 1e-3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ('family = "cosmic"', "family: is 'cosmic'"),
        ('experiment = "pray"', "experiment: is 'pray'"),
        ("parameters = ()", "parameters: is empty"),
        ('name = "two words"', "name: is 'two words'"),
    ],
)
def test_an_incomplete_cause_is_refused_with_its_attribute(tmp_path, change, message):
    attribute = change.split(" =")[0]
    file = tmp_path / "my_cause.py"
    text = re.sub(rf"^    {attribute} = .*$", f"    {change}", example(), flags=re.MULTILINE)
    file.write_text(text)
    with pytest.raises(ConfigurationError, match=re.escape(message)) as error:
        load_cause(file)
    assert str(file) in str(error.value)


def test_a_file_without_a_cause_is_refused(tmp_path):
    (tmp_path / "empty.py").write_text("x = 1\n")
    with pytest.raises(ConfigurationError, match="holds 0 causes"):
        load_cause(tmp_path / "empty.py")
    with pytest.raises(ConfigurationError, match="no such file"):
        load_cause(tmp_path / "absent.py")


class Installed(Cause):
    """A cause of an installed package."""

    name = "installed"
    family = "sensor"
    parameters = (CauseParameter("size", "N", 1.0),)
    signature = "any"
    experiment = "air"


class Skin(Installed):
    """One with a name that is taken."""

    name = "skin"


def test_causes_of_installed_packages_are_found(monkeypatch):
    def points(kind: str) -> list[EntryPoint]:
        return [EntryPoint(kind, f"{__name__}:{kind}", registry.ENTRY_POINTS)]

    monkeypatch.setattr(registry, "entry_points", lambda group: points("Installed"))
    assert all_causes()[-1].name == "installed"
    monkeypatch.setattr(registry, "entry_points", lambda group: points("Skin"))
    with pytest.raises(ConfigurationError, match="two causes 'skin'"):
        all_causes()
