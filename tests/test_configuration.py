"""Configuration: units, ranges and YAML, and errors that say where and what to do."""

import ast
import dataclasses as dc
import itertools
import subprocess
import sys
import typing
from pathlib import Path

import numpy as np
import pytest

import sliceit_drake
from sliceit_drake.configuration import (
    ConfigurationError,
    choice,
    dump_yaml,
    load_yaml,
    quantity,
    unit_of,
    validate,
)


@dc.dataclass
class Board:
    height: float = quantity(0.05, "m", low=-1.0, high=2.0)
    """Height of the top surface."""
    spheres: int = quantity(7, "", low=1, high=50)
    """Number of contact spheres."""


@dc.dataclass
class Press:
    speed: float = quantity(0.02, "m/s", low=1e-4, high=1.0)
    """Speed of the press."""


@dc.dataclass
class Hold:
    duration: float = quantity(0.5, "s", low=0.0, high=60.0)
    """Time at rest."""


@dc.dataclass
class Station:
    board: Board = dc.field(default_factory=Board)
    spare_board: typing.Optional[Board] = None  # noqa: UP045 (the spelling in Drake's own files)
    motion: Press | Hold = dc.field(default_factory=Press)
    motions: list[Press | Hold] = dc.field(default_factory=list)
    foods: dict[str, Board] = dc.field(default_factory=dict)
    position: list[float] = quantity([0.0, 0.0, 0.2], "m", low=-1, high=1, size=3)
    """Place."""
    gains: np.ndarray = quantity(np.full(6, 0.1), "", low=0.0, high=10.0)
    """Gains."""
    tilt: float = quantity(0.0, "rad", low=-0.5, high=0.5)
    """Tilt of the knife."""
    mass: float | None = quantity(None, "kg", low=0.1, high=10.0)
    """Mass, if known."""
    shape: str = choice("box", ("box", "cylinder"))
    """Shape of the food."""
    name: str = ""
    closed: bool = False


@dc.dataclass
class Range:
    begin: float = quantity(0.0, "s", low=0.0)
    """Begin."""
    end: float = quantity(1.0, "s", low=0.0)
    """End."""

    def check(self, where: str) -> None:
        if self.end <= self.begin:
            raise ConfigurationError(
                f"{self.end} s is not after begin {self.begin} s",
                field=f"{where}.end",
                fix="Give a later time.",
            )


@dc.dataclass
class Plan:
    ranges: list[Range] = dc.field(default_factory=lambda: [Range()])


def write(folder: Path, text: str) -> Path:
    file = folder / "station.yaml"
    file.write_text(text, encoding="utf-8")
    return file


def test_a_file_sets_the_fields_that_it_names_and_leaves_the_others_at_their_defaults(tmp_path):
    file = write(
        tmp_path,
        """
        board: {height: 1e-2}
        spare_board: {spheres: 9}
        motion: !Hold {duration: 2}
        motions: [!Hold {duration: 1}, {speed: 0.1}, !Press {}]
        foods: {cucumber: {height: 0.027}}
        gains: [1, 2, 3, 4, 5, 6]
        mass: 1
        shape: cylinder
        """,
    )
    station = load_yaml(Station, file)
    assert station.board == Board(height=0.01, spheres=7)
    assert station.spare_board == Board(spheres=9)
    assert station.motion == Hold(duration=2.0)
    assert station.motions == [Hold(1.0), Press(0.1), Press(0.02)]
    assert station.foods == {"cucumber": Board(height=0.027)}
    np.testing.assert_array_equal(station.gains, [1, 2, 3, 4, 5, 6])
    assert (station.mass, station.shape, station.position) == (1.0, "cylinder", [0.0, 0.0, 0.2])


def test_overrides_win_over_the_file_and_the_file_over_the_defaults(tmp_path):
    file = write(tmp_path, "{tilt: 0.2, name: two}")
    defaults = Station(board=Board(height=0.5), tilt=0.3, name="none")
    station = load_yaml(Station, file, defaults=defaults, overrides_text="board: {spheres: 3}")
    assert (station.board.height, station.board.spheres) == (0.5, 3)
    assert (station.tilt, station.name) == (0.2, "two")
    assert (defaults.tilt, defaults.board.spheres) == (0.3, 7)
    assert load_yaml(Station, None, overrides_text="tilt: 0.4").tilt == 0.4
    assert load_yaml(Station, None, defaults=defaults) is not defaults


def test_a_merged_anchor_may_be_overridden(tmp_path):
    text = "_base: &base {height: 0.3, spheres: 2}\nboard: {<<: *base, spheres: 4}\n"
    assert load_yaml(Station, write(tmp_path, text)).board == Board(height=0.3, spheres=4)


def test_a_written_configuration_reads_back_to_the_same_values(tmp_path):
    station = Station(
        board=Board(height=0.123456789012345),
        motion=Hold(3.0),
        motions=[Hold(1.0), Press(0.5)],
        foods={"tomato": Board(spheres=5)},
        gains=np.arange(6.0),
        mass=0.5,
    )
    file = tmp_path / "out.yaml"
    text = dump_yaml(station, file)
    assert file.read_text(encoding="utf-8") == text
    loaded = load_yaml(Station, file)
    np.testing.assert_array_equal(loaded.gains, station.gains)
    loaded.gains = station.gains
    assert loaded == station


def test_only_what_differs_from_the_defaults_is_written_when_they_are_given():
    text = dump_yaml(Board(height=0.2), defaults=Board())
    assert text == "height: 0.2\n"


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("board: {hieght: 1}", 1, 'station.board.hieght: unknown field.*mean "height"'),
        ("zzz: 1", 1, "station.zzz: unknown field of Station.*Known: board"),
        ("name: a\nboard: 3", 2, "station.board: expected named fields. Fields: height, spheres"),
        ("board:", 1, "station.board: expected named fields"),
        ("board: {height: tall}", 1, "station.board.height: is 'tall'. Give a number"),
        ("board: {height: [1]}", 1, "station.board.height: is a list"),
        ("board: {spheres: 1.5}", 1, "station.board.spheres: is '1.5'. Give a whole number"),
        ("position: 1", 1, "station.position: expected a list"),
        ("position: [0, 0, x]", 1, r"station.position\[2\]: is 'x'"),
        ("position: [0, 0]", 1, "station.position: has 2 values. Give 3 values"),
        ("gains: [0, 0, -1]", 1, r"station.gains\[2\]: -1 is not within \[0, 10\]"),
        ("gains: 7", 1, "station.gains: expected a list"),
        ("closed: maybe", 1, "station.closed: is 'maybe'. Give true or false"),
        ("name: 3", 1, "station.name: is '3'. Give text"),
        ("shape: cylindre", 1, 'station.shape: .*box, cylinder. Did you mean "cylinder"'),
        ("motion: !Hodl {}", 1, 'station.motion: unknown tag !Hodl. Did you mean "!Hold"'),
        ("motion: !Hold 3", 1, "station.motion: expected named fields"),
        ("motion: {duration: 3}", 1, "unknown field of Press.*Without a tag.*!Press, !Hold"),
        ("motions:\n- !Hold {}\n- !Press {sped: 1}", 3, r"station.motions\[1\].sped: .*speed"),
        ("foods:\n  a: {x: 1}", 2, "station.foods.a.x: unknown field"),
        ("foods: 3", 1, "station.foods: expected named entries"),
        ("board: !Hold {}", 1, "station.board: the tag !Hold has no meaning here"),
        ("tilt: 1\nboard: {}\ntilt: 2", 3, "tilt is given twice"),
        ("board: {height: .nan}", 1, "station.board.height: is nan. Give a number in m"),
        ("board: {height: .inf}", 1, "station.board.height: is inf"),
        ("\n\nboard: {height: 27}", 3, "27 m is not within .*Is it in mm. Write 0.027"),
        ("tilt: 20", 1, "20 rad is not within .*Is it in degrees. Write 0.349066"),
        ("mass: 300", 1, "300 kg is not within .*Is it in g. Write 0.3"),
        ("motion: {speed: -1}", 1, "station.motion.speed: -1 m/s is not within"),
        ("mass: 0", 1, "station.mass: 0 kg is not within"),
        ("board: {height: 1", 1, "not valid YAML"),
        ("board:\n\theight: 1", 2, "not valid YAML"),
    ],
)
def test_an_error_names_file_line_field_and_fix(tmp_path, text, line, message):
    file = write(tmp_path, text)
    with pytest.raises(ConfigurationError, match=message) as caught:
        load_yaml(Station, file)
    assert str(caught.value).startswith(f"{file}, line {line}: ")
    assert caught.value.fix


@pytest.mark.parametrize("text", ["", "# nothing\n", "[1, 2]", "just text"])
def test_a_file_without_fields_is_refused(tmp_path, text):
    with pytest.raises(ConfigurationError, match="the file holds no fields"):
        load_yaml(Station, write(tmp_path, text))


def test_a_missing_file_suggests_what_exists(tmp_path):
    write(tmp_path, "")
    with pytest.raises(ConfigurationError, match='does not exist. Did you mean "station.yaml"'):
        load_yaml(Station, tmp_path / "sation.yaml")
    with pytest.raises(ConfigurationError, match="There is no folder .*nowhere either"):
        load_yaml(Station, tmp_path / "nowhere" / "a.yaml")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigurationError, match="has no YAML files"):
        load_yaml(Station, tmp_path / "empty" / "a.yaml")
    with pytest.raises(ConfigurationError, match="the file cannot be read"):
        load_yaml(Station, tmp_path)


def test_an_error_in_the_overrides_is_not_blamed_on_the_file(tmp_path):
    file = write(tmp_path, "tilt: 0.1")
    with pytest.raises(ConfigurationError, match="^overrides, line 1: station.tilt: 9 rad"):
        load_yaml(Station, file, overrides_text="tilt: 9")
    with pytest.raises(ConfigurationError, match="^overrides, line 1: station.tlt: unknown"):
        load_yaml(Station, file, overrides_text="tlt: 9")


def test_rules_between_fields_are_checked_with_the_path_of_their_owner():
    validate(Plan(), "plan")
    with pytest.raises(ConfigurationError, match=r"^plan.ranges\[1\].end: 1.0 s is not after"):
        validate(Plan([Range(), Range(begin=2.0)]), "plan")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tilt": "0.1"}, "station.tilt: is '0.1'. Give a number in rad"),
        ({"tilt": True}, "station.tilt: is True"),
        ({"tilt": None}, "station.tilt: is None. Give a value"),
        ({"board": None}, "station.board: is None. Give a value"),
        ({"tilt": np.float64("nan")}, "station.tilt: is nan"),
        ({"board": Board(spheres=2.5)}, "station.board.spheres: is 2.5. Give a whole number"),
        ({"gains": np.array([0.0, np.inf])}, r"station.gains\[1\]: is inf"),
        ({"foods": {"a": Board(height=3)}}, "station.foods.a.height: 3 m"),
        ({"spare_board": Board(height=3)}, "station.spare_board.height: 3 m"),
    ],
)
def test_a_configuration_built_in_python_is_checked_too(change, message):
    with pytest.raises(ConfigurationError, match=message):
        validate(dc.replace(Station(), **change), "station")


def test_a_contradictory_declaration_is_refused_when_it_is_made():
    with pytest.raises(ValueError, match="default: 3 m is not at most 2 m"):
        quantity(3.0, "m", high=2.0)
    with pytest.raises(ValueError, match="'cone' is not in"):
        choice("cone", ("box",))


def test_every_declared_field_of_the_package_says_what_it_means():
    package = Path(sliceit_drake.__file__).parent
    undocumented = [
        f"{file}:{node.lineno}"
        for file in sorted(package.rglob("*.py"))
        for cls in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(cls, ast.ClassDef)
        for node, following in itertools.pairwise([*cls.body, ast.Pass()])
        if isinstance(node, ast.AnnAssign)
        and ast.unparse(node.value or node).startswith(("quantity(", "choice("))
        and not (isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant))
    ]
    assert not undocumented


def test_the_unit_of_a_field_and_of_an_element_of_one_is_found_by_its_path():
    @dc.dataclass
    class Station:
        boards: list[Board] = dc.field(default_factory=lambda: [Board()])
        offset: list[float] = quantity([0.0, 0.0], "m", low=-0.1, high=0.1, size=2)

    station = Station()
    paths = ("boards.0.height", "offset", "offset.1", "boards.0.spheres", "boards")
    assert [unit_of(station, path) for path in paths] == ["m", "m", "m", "", ""]


def test_a_list_default_is_not_shared_between_instances():
    first, second = Station(), Station()
    first.position[0] = 9.0
    first.gains[0] = 9.0
    assert second.position[0] == 0.0
    assert second.gains[0] == 0.1


def test_the_module_loads_without_drake_and_yaml():
    code = (
        "import sys, sliceit_drake.configuration\n"
        "assert not {'pydrake', 'yaml', 'warp', 'torch'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
