"""The program `sliceit`, as a user calls it."""

import argparse
import base64
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sliceit_drake.cli.main import main, make_parser

SMALL_FOOD = "{food: {shape: !Cylinder {rings: 3, layers: [0.0, 0.004, 0.012]}}}"


def write_mesh(path: Path, vertices: list, tetrahedra: list) -> Path:
    import meshio

    cells = [("tetra", np.array(tetrahedra))]
    meshio.write(path, meshio.Mesh(np.array(vertices, float), cells), file_format="vtk")
    return path


def test_simulate_writes_replay_figure_record_and_summary(tmp_path):
    options = ["--set", SMALL_FOOD, "--output", str(tmp_path)]
    assert main(["simulate", "cucumber_measured", *options]) == 0
    # A machine that cannot draw without a display writes no animation.
    names = {p.name for p in tmp_path.iterdir()} - {"slice.gif"}
    assert names == {"replay.html", "force.png", "record.csv", "summary.json", "scenario.yaml"}

    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["cut_progress"] > 0.99
    assert summary["measurement"]["rms_N"] < 3.0
    assert summary["measurement"]["simulated_peak_N"] == pytest.approx(
        summary["measurement"]["measured_peak_N"], rel=0.3
    )
    assert summary["discretization_error"]["relative_rms"] > 0.0
    header = (tmp_path / "record.csv").open().readline().strip().split(",")
    for column in ("time", "q_1", "knife_pose_p_z", "sensor_wrench_f_z", "stiffness_x"):
        assert column in header
    time = np.loadtxt(tmp_path / "record.csv", delimiter=",", skiprows=1, usecols=0)
    np.testing.assert_allclose(np.diff(time), 0.002, atol=1e-9)
    html = (tmp_path / "replay.html").read_text()
    scene = b"".join(base64.b64decode(d) for d in re.findall(r"base64,([A-Za-z0-9+/=]+)", html))
    assert all(f"food/minus/frame_{k:04d}".encode() in scene for k in (0, 50, 98))
    assert not re.search(r'<(script|link)[^>]*(src|href)="https?:', html)
    # What was simulated can be simulated again from what was written.
    assert (
        main(
            [
                "simulate",
                str(tmp_path / "scenario.yaml"),
                "--duration",
                "0.02",
                "--no-replay",
                "--output",
                str(tmp_path / "again"),
            ]
        )
        == 0
    )


def test_a_run_that_breaks_off_keeps_its_record_and_says_why(tmp_path, capsys):
    overrides = (
        "{food: {material: {youngs_modulus: 3.0e+3, toughness: 2000.0},"
        " shape: !Cylinder {rings: 2, layers: [0.0, 0.004, 0.012]}}}"
    )
    assert (
        main(
            [
                "simulate",
                "cucumber_measured",
                "--set",
                overrides,
                "--no-replay",
                "--output",
                str(tmp_path),
            ]
        )
        == 1
    )
    assert "Stopped early: at " in capsys.readouterr().out
    assert json.loads((tmp_path / "summary.json").read_text())["stopped"]
    assert len((tmp_path / "record.csv").read_text().splitlines()) > 10


BAD = {
    "unknown key": ("{food: {hieght: 0.03}}", ["food.hieght", "unknown field"]),
    "negative density": ("{food: {material: {density: -950}}}", ["food.material.density", "50"]),
    "not a number": ("{food: {material: {toughness: .nan}}}", ["toughness", "nan"]),
    "millimetres": (
        "{food: {shape: !Cylinder {diameter: 27}}}",
        ["food.shape.diameter", "27", "0.027"],
    ),
    "millipascal": ("{food: {material: {youngs_modulus: 2.6}}}", ["youngs_modulus", "Pa"]),
    "plane misses": ("{food: {cut_point: [0, 0.3, 0]}}", ["misses the food"]),
    "inside the food": ("{start: {clearance: -0.01}}", ["inside the food", "start.clearance"]),
    "step too large": (
        "{numerics: {mass_scaling: false, time_step: 0.001}}",
        ["numerics.time_step", "stability limit"],
    ),
    "step does not divide": ("{numerics: {time_step: 0.0003}}", ["numerics.time_step", "divide"]),
    "unreachable": ("{placement: {position: [1.5, -1.5]}}", ["scenario.placement", "cannot put"]),
    "missing mesh": ("{food: {shape: !MeshFile {path: none.msh}}}", ["none.msh"]),
    "unstable gains": (
        "{robot: {joint_control: {damping: [1e5, 1e5, 1e5, 1e5, 1e5, 1e5]}}}",
        ["robot.joint_control", "unstable"],
    ),
    "missing record": ("{measurement: {file: no/such.csv}}", ["no/such.csv"]),
    "wrong tag": ("{motion: {segments: [!Jump {}]}}", ["Jump"]),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_refused_by_name_with_exit_code_2(case, tmp_path, capsys):
    overrides, words = BAD[case]
    arguments = ["simulate", "cucumber_measured", "--set", overrides, "--no-replay"]
    arguments += ["--duration", "0.01"]
    assert main([*arguments, "--output", str(tmp_path / "out")]) == 2
    message = capsys.readouterr().err
    assert message.startswith("sliceit: ")
    for word in words:
        assert word in message
    assert "Traceback" not in message


def test_missing_scenario_is_refused_with_exit_code_2(capsys):
    assert main(["simulate", "scenarios/cucmber.yaml"]) == 2
    assert "scenarios/cucmber.yaml" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("vertices", "words"),
    [
        ([[0, 0, 0], [0.02, 0, 0], [0, 0, 0.02], [0, 0.02, 0]], ["inverted", "[0 1 2 3]"]),
        ([[0, 0, 0], [0.02, 0, 0], [0, 0.02, 0], [0.01, 0.01, 0]], ["degenerate", "[0 1 2 3]"]),
        ([[0, 0, 0], [20, 0, 0], [0, 20, 0], [0, 0, 20]], ["millimetres"]),
        ([[0, 0, 0], [0.02, 0, 0], [0, 0.02, 0], [0, 0, float("nan")]], ["vertex 3"]),
    ],
)
def test_bad_mesh_file_is_refused_with_exit_code_2(vertices, words, tmp_path, capsys):
    mesh = write_mesh(tmp_path / "food.vtk", vertices, [[0, 1, 2, 3]])
    overrides = f"{{food: {{shape: !MeshFile {{path: {mesh}}}}}}}"
    assert main(["simulate", "cucumber_measured", "--set", overrides, "--no-replay"]) == 2
    message = capsys.readouterr().err
    for word in words:
        assert word in message


def test_help_is_quick_and_lists_the_commands():
    shown = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "sliceit_drake.cli.main", "--help"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "simulate" in shown.stdout and "diagram" in shown.stdout
    for heavy in ("pydrake", "warp", "scipy", "matplotlib"):
        assert f"| {heavy}" not in shown.stderr


def subcommands(parser, name="sliceit"):
    """All commands and studies, by their full names."""
    found = {name: parser}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for key, nested in action.choices.items():
                found |= subcommands(nested, f"{name} {key}")
    return found


def test_each_command_is_listed_in_its_group_and_teaches():
    commands = subcommands(make_parser())
    shown = commands.pop("sliceit").format_help()
    listed = re.findall(r"^  ([a-z][a-z-]*) {2,}\S", shown, re.M)
    assert sorted(listed) == sorted(n.split()[1] for n in commands if n.count(" ") == 1)
    assert len(commands) > 12
    for name, parser in commands.items():
        text = parser.format_help()
        assert text.startswith(f"usage: {name} "), text[:80]
        assert parser.description and len(parser.description) > 30, name
        for action in parser._actions:
            nested = isinstance(action, argparse._SubParsersAction)
            assert action.help or nested, (name, action.option_strings or action.dest)


def test_diagram_writes_graphviz_and_ports(tmp_path, capsys):
    file = tmp_path / "cucumber.dot"
    assert main(["diagram", "--set", SMALL_FOOD, "--output", str(file)]) == 0
    text = file.read_text()
    for system in ("controller", "cutting", "sensor", "motion"):
        assert system in text
    assert main(["diagram", "--ports"]) == 0
    assert "| knife_pose | output | RigidTransform |" in capsys.readouterr().out
