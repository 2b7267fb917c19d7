"""Whatever stands in a file: it is read, or refused with an error that names file or field."""

import copy
import string

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sliceit_drake.configuration import ConfigurationError, dump_yaml
from sliceit_drake.diagrams.scenario import Scenario, load_scenario
from sliceit_drake.records.slice_record import read_table
from sliceit_drake.records.validation import check_table, load_record
from sliceit_drake.resources import resource_path

SETTINGS = settings(
    max_examples=60,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
SCENARIOS = sorted(resource_path("scenarios").glob("*.yaml"))
RECORD = resource_path("calibration/records/cucumber.csv")

junk = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(10**12), 10**12),
    st.floats(),
    st.text(max_size=8),
    st.lists(st.floats(), max_size=4),
    st.dictionaries(st.text(string.ascii_lowercase, max_size=5), st.floats(), max_size=2),
)


def places(tree, path=()):
    """Paths to everything in a tree of dicts and lists."""
    found = [path] if path else []
    items = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for key, value in items if isinstance(tree, dict | list) else ():
        found += places(value, (*path, key)) if isinstance(value, dict | list) else [(*path, key)]
    return found


def changed(tree, path, change, value):
    tree = copy.deepcopy(tree)
    at = tree
    for key in path[:-1]:
        at = at[key]
    if change == "replace":
        at[path[-1]] = value
    elif change == "delete":
        del at[path[-1]]
    elif isinstance(at, dict):
        at[str(path[-1]) + "x"] = at.pop(path[-1])
    else:
        at.append(value)
    return tree


class Tagged(yaml.SafeDumper):
    """Writes `!Name {...}`, which Drake's YAML has for the kinds of a field."""


class Loader(yaml.SafeLoader):
    """Reads it as a dict with the tag beside the fields."""


TAG = "_tag"
Loader.add_multi_constructor(
    "!", lambda loader, tag, node: {TAG: tag} | loader.construct_mapping(node, deep=True)
)


def represent(dumper, data):
    if TAG in data and isinstance(data[TAG], str):
        rest = {key: value for key, value in data.items() if key != TAG}
        return dumper.represent_mapping("!" + data[TAG], rest)
    return dumper.represent_mapping("tag:yaml.org,2002:map", data)


Tagged.add_representer(dict, represent)


def read_or_refused(file):
    """Reads a scenario; what is read can be written and read again."""
    try:
        scenario = load_scenario(file)
    except ConfigurationError as error:
        assert error.field or error.source, error
        assert len(str(error)) > 10
        return None
    assert isinstance(scenario, Scenario)
    dump_yaml(scenario)
    return scenario


@SETTINGS
@given(data=st.data())
def test_a_scenario_with_a_wrong_value_is_read_or_refused_by_name(data, tmp_path):
    tree = yaml.load(data.draw(st.sampled_from(SCENARIOS)).read_text(), Loader)
    for _ in range(data.draw(st.integers(1, 3))):
        path = data.draw(st.sampled_from(places(tree)))
        change = data.draw(st.sampled_from(["replace", "replace", "delete", "rename"]))
        tree = changed(tree, path, change, data.draw(junk))
        if not places(tree):
            break
    file = tmp_path / "scenario.yaml"
    file.write_text(yaml.dump(tree, Dumper=Tagged, allow_unicode=True), encoding="utf-8")
    read_or_refused(file)


def mangled(data, text):
    """Bytes of a text with some cut out, put in or doubled."""
    raw = bytearray(text.encode())
    for _ in range(data.draw(st.integers(1, 4))):
        a = data.draw(st.integers(0, len(raw)))
        b = min(len(raw), a + data.draw(st.integers(0, 40)))
        raw[a:b] = data.draw(
            st.one_of(st.binary(max_size=12), st.text(max_size=12).map(str.encode))
        )
    return bytes(raw)


@SETTINGS
@given(data=st.data())
def test_a_spoiled_scenario_file_is_read_or_refused_by_name(data, tmp_path):
    file = tmp_path / "scenario.yaml"
    file.write_bytes(mangled(data, data.draw(st.sampled_from(SCENARIOS)).read_text()))
    read_or_refused(file)


@SETTINGS
@given(data=st.data())
def test_a_spoiled_record_is_read_found_wrong_or_refused_by_name(data, tmp_path):
    table, facts = RECORD.read_text(), RECORD.with_suffix(".yaml").read_text()
    rows = table.splitlines(keepends=True)
    table = "".join(rows[:40])
    spoil_table = data.draw(st.booleans())
    (tmp_path / "a.csv").write_bytes(mangled(data, table) if spoil_table else table.encode())
    (tmp_path / "a.yaml").write_bytes(facts.encode() if spoil_table else mangled(data, facts))
    try:
        findings = check_table(read_table(tmp_path / "a"))
    except ConfigurationError as error:
        assert error.field or error.source, error
        return
    wrong = [finding for finding in findings if finding.severity == "error"]
    if wrong:
        with pytest.raises(ConfigurationError):
            load_record(tmp_path / "a")
    else:
        assert np.isfinite(load_record(tmp_path / "a").time).all()


@SETTINGS
@given(data=st.data())
def test_wrong_numbers_in_a_record_are_read_found_wrong_or_refused_by_name(data, tmp_path):
    rows = [row.split(",") for row in RECORD.read_text().splitlines()[:40]]
    for _ in range(data.draw(st.integers(1, 6))):
        row = data.draw(st.integers(1, len(rows) - 1))
        column = data.draw(st.integers(0, len(rows[0]) - 1))
        rows[row][column] = data.draw(
            st.one_of(st.floats().map(str), st.just(""), st.integers(-(10**9), 10**9).map(str))
        )
    (tmp_path / "a.csv").write_text("\n".join(",".join(row) for row in rows))
    (tmp_path / "a.yaml").write_text(RECORD.with_suffix(".yaml").read_text())
    for finding in check_table(read_table(tmp_path / "a")):
        assert finding.column or finding.lines, finding
