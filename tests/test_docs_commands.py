"""What README and docs tell a reader to type can be typed.

Each command is read by the parser that would read it, and the files that it names are there. The
table says of each who runs it: this test, another one, CI, or nobody because it takes too long.
"""

import argparse
import functools
import glob
import os
import re
import shlex
import tomllib
from pathlib import Path

import pytest
from docs_commands import Command, commands_of, pages_of

from sliceit_drake.cli.main import main, make_parser
from sliceit_drake.cutting.mesh.tetrahedra import MeshError
from studies.registry import find_study, study_parser

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *pages_of(ROOT / "docs")]
COMMANDS = [command for page in PAGES for command in commands_of(page, ROOT)]

# Run below, in an empty folder; simulations for two coupling steps.
HERE = """
sliceit simulate
sliceit simulate cucumber_measured --set calibration=cucumber
sliceit simulate cucumber_measured --set food.held_sides=plus,food.hold_distance=0.02
sliceit simulate cucumber_measured --set "{controller: {mode: compliance, error_scale: 0.2, p_gains: [0.05, 0.05, 0.05, 1, 1, 1], stiffness: [5000, 5000, 5000, 100, 100, 100]}}"
sliceit simulate --set knife_name=nakiri
sliceit simulate cucumber_spring
sliceit simulate --set food.material.toughness=300
sliceit simulate --set calibration=potato,knife_name=nakiri
sliceit simulate carrot_sequence --set "{food: {shape: !Tapered {diameters: [0.018, 0.034], length: 0.10}}}"
sliceit simulate cucumber_measured --set "{food: {cut_normal: [0.2, 1.0, 0.1]}}"
sliceit simulate cucumber_measured --set "{food: {shape: !HalfCylinder {radius: 0.025, length: 0.10}}}"
sliceit simulate cucumber_measured --set "{food: {effects: {core: {rind: 0.006, toughness_ratio: 2.0, offset: [0.0, 0.004]}}}}"
sliceit calibrate --show cucumber
sliceit calibrate --show NAME
sliceit diagram --ports
python -c "from sliceit_drake.hardware.edge_kinematics import flange_pose; print(flange_pose([q1, q2, q3, q4, q5, q6])[11] - 0.21)"
"""  # noqa: E501

# Run by another test, perhaps on a smaller food.
TESTED = {
    "tests/test_notebooks.py::test_1_a_diagram_by_hand_slices_and_prints_where_to_watch": [
        "python -m studies notebooks",
    ],
    "tests/test_readme.py::test_the_table_is_what_the_measured_slice_gives": [
        "sliceit simulate cucumber_measured",
        "sliceit simulate cucumber_measured --no-replay --no-animation",
    ],
    "tests/test_named_food.py::test_the_apple_is_cut_by_a_knife_that_is_higher_and_the_arm_"
    "reaches_its_start": ["sliceit simulate apple"],
    "tests/test_foods_page.py::test_what_the_pages_say_to_write_is_a_food_a_knife_and_a_setup": [
        "sliceit simulate --set knife_name=knife.yaml",
        "sliceit simulate radish.yaml",
    ],
    "tests/test_foods_page.py::test_tables_are_made_from_the_files_of_foods_and_knives": [
        "python -m studies foods_page --output docs/reference/foods.md",
    ],
    "tests/test_paraview.py::test_the_series_of_a_run_has_its_body_its_knife_and_its_forces": [
        "sliceit simulate --paraview vtu",
    ],
    "tests/test_paraview.py::test_a_run_is_exported_again_as_it_was": [
        "sliceit export output/cucumber",
    ],
    "tests/test_record_importers.py::test_the_page_makes_a_record_of_a_table_with_other_columns": [
        "sliceit records import force calibration/measured/sliceit_real_potato_force.csv"
        " --columns time_s F_ground_truth_N --name potato_1 --component norm --food potato"
        " --shape cylinder --size 0.04 0.08 0.04 --output records/potato",
        "sliceit records check records/potato",
    ],
    "tests/test_record_importers.py::test_the_program_imports_a_recording_and_says_what_is_wrong": [
        "sliceit records check FOLDER",
    ],
    "tests/test_stand_in.py::test_the_command_hides_an_effect_from_a_users_file_in_two_processes": [
        "sliceit record calibration/protocols/rich.yaml --effect skin:0.8 --seed 3"
        " --output records/a",
        "sliceit record --output records/a --seed 1",
        "sliceit record --effect brine.py:2.0 --output records/b",
        "sliceit record --seed 1 --effect bulk_relaxation:0.0399 --output RECORDS",
    ],
    "tests/test_cluster.py::test_records_of_a_cluster_are_those_of_one_process": [
        "sliceit record --output records/b --seed 1 --backend dask --scheduler tcp://10.0.0.5:8786",
    ],
    "tests/test_cluster.py::test_a_sweep_on_a_cluster_is_that_of_one_process": [
        "python -m studies hidden --output output/hidden --backend dask"
        " --scheduler tcp://10.0.0.5:8786",
    ],
    "tests/test_cluster.py::test_a_backend_without_its_scheduler_is_refused": [
        "sliceit diagnose ... --backend dask --scheduler tcp://HOST:8786",
        "sliceit diagnose records/monday --model cucumber --output output/a --backend dask"
        " --scheduler tcp://10.0.0.5:8786",
    ],
    "tests/test_database.py::test_two_workers_share_a_database_and_one_that_is_killed_goes_on": [
        "sliceit calibrate records/*.csv --food cucumber --output a"
        " --storage postgresql://sliceit@10.0.0.5/sliceit --seed 1",
    ],
    "tests/test_causes.py::test_a_cause_in_a_file_is_loaded_and_used": [
        "sliceit diagnose records/monday --model cucumber --output output/a --cause my_cause.py",
    ],
    "tests/test_hidden_effects_found.py::test_a_fresh_draw_of_effects_is_diagnosed_rightly": [
        "sliceit diagnose RECORDS_DIR --model cucumber --output DIR",
        "sliceit diagnose RECORDS --model FOOD --output DIR",
        "sliceit diagnose records/a --model cucumber --output a",
        "sliceit diagnose records/monday --model cucumber --output output/diagnosis",
    ],
    "tests/test_next_experiment.py::test_the_proposed_slices_find_what_was_hidden": [
        "sliceit diagnose records/monday --model cucumber --output output/a"
        " --next-experiment next.yaml",
        "sliceit diagnose old --model food.yaml --refinement 0.75 --output a"
        " --next-experiment next.yaml",
        "sliceit diagnose records/monday records/tuesday --model cucumber --output output/b",
        "sliceit diagnose --next-experiment FILE",
    ],
    "tests/test_next_experiment.py::test_station_and_stand_in_run_what_was_written": [
        "sliceit simulate next.yaml",
        "sliceit record next.yaml --replicates 3 --output records/tuesday",
    ],
    "tests/test_benches.py::test_the_table_has_rows_for_naming_nothing_the_top_and_the_oracle": [
        "python -m studies bench_score output/benches --output output/benches.md",
    ],
    "tests/test_hidden_effects_page.py::test_the_page_is_made_from_the_runs_and_says_how_they_"
    "were": [
        "python -m studies score docs/results/hidden_effects.jsonl --output docs/results",
        "python -m studies score output/hidden --output docs/results",
    ],
    "tests/test_learning_agent.py::test_a_training_that_was_stopped_goes_on_as_if_it_had_not": [
        "sliceit train --output DIR",
        "sliceit train --output policy",
        "sliceit train --output output/ours --seed 0",
        "sliceit train --output output/baseline --seed 0 --simulator spring",
        "sliceit train models/policies/correction.yaml --output output/corrected --seed 0",
        "sliceit train models/policies/correction.yaml --output output/corrected_spring_0 --seed 0"
        " --simulator spring",
        "sliceit train --output output/draws/cutting_0 --seed 0 --steps 15000"
        ' --set "{task: {agent: {draw_increment: 7.5e-3}}}"',
        "sliceit train --output output/draws/spring_0 --seed 0 --steps 15000 --simulator spring"
        ' --set "{task: {agent: {draw_increment: 7.5e-3}}}"',
    ],
    "tests/test_learning_comparison.py::test_a_pressing_policy_completes_a_slice_and_its_forces_"
    "are_those_of_food_and_board": [
        "sliceit evaluate output/ours output/baseline --output output/evaluation.jsonl",
        "sliceit evaluate output/draws/*_[0-2] --output docs/results/faster_draws.jsonl",
    ],
    "tests/test_learning_comparison.py::test_an_evaluation_goes_on_over_batches_of_processes_and_"
    "runs": [
        "sliceit evaluate models/policies/{cutting,spring}_[0-4]"
        " --output docs/results/slicing_evaluation.jsonl",
        "sliceit evaluate models/policies/{cutting,spring}_[0-4] --board-stiffness 3e3 3e5"
        " --output docs/results/slicing_evaluation.jsonl",
        "sliceit evaluate models/policies/{corrected,spring}_[0-4] output/corrected_spring_[0-4]"
        " --seed 11 --output docs/results/corrected_evaluation.jsonl",
        "sliceit evaluate models/policies/corrected_[0-4] --board-stiffness 3e3 3e5"
        " --output docs/results/corrected_evaluation.jsonl",
        "sliceit evaluate models/policies/{spring_0,spring_2,cutting_0,cutting_3} --world stand_in"
        " --foods cucumber --slices 8 --output FILE",
    ],
    "tests/test_foreign_law.py::test_policies_are_evaluated_by_it_and_finish": [
        "python -m studies foreign_law models/policies/{corrected,spring}_[0-4]"
        " output/corrected_spring_[0-4] --seed 11"
        " --output docs/results/corrected_evaluation.jsonl",
    ],
    "tests/test_learning_comparison.py::test_a_trained_policy_runs_in_a_scenario": [
        "sliceit simulate cucumber_agent",
    ],
    "tests/test_learning_comparison.py::test_the_study_writes_its_page_and_says_what_it_lacks": [
        "python -m studies slicing output/evaluation.jsonl --output output",
        "python -m studies slicing docs/results/slicing_evaluation.jsonl"
        " --policies models/policies/cutting_0 models/policies/spring_0 --output docs/results",
        "python -m studies slicing docs/results/corrected_evaluation.jsonl"
        " docs/results/slicing_evaluation.jsonl --ours corrected --output docs/results",
    ],
    "tests/test_motion_optimization.py::test_the_command_leaves_a_scenario_that_simulate_takes": [
        "sliceit optimize-motion scenarios/cucumber_measured.yaml --output FOLDER",
    ],
    "tests/test_hardware_end_to_end.py::test_a_robot_slices_over_the_network_as_the_simulation_"
    "does": [
        "sliceit hardware SCENARIO --host ADDRESS",
        "sliceit emulate SCENARIO",
        "sliceit emulate scenarios/cucumber_measured.yaml --pace 0.25",
        "sliceit hardware scenarios/cucumber_measured.yaml --host 127.0.0.1 --pace 0.25"
        " --robot hardware/emulated.yaml",
        "sliceit emulate scenarios/cucumber_measured.yaml --pace 0.2",
        "sliceit hardware scenarios/cucumber_measured.yaml --host 127.0.0.1 --pace 0.2"
        " --robot hardware/emulated.yaml",
    ],
    "tests/test_hardware_end_to_end.py::test_the_touch_finds_a_lifted_board_and_refuses_the_"
    "height_that_was_given": ["sliceit hardware SCENARIO --host ADDRESS --robot my.yaml --touch"],
    "tests/test_collect.py::test_a_protocol_on_one_emulated_robot_is_recorded_as_on_the_"
    "simulated_station": [
        "sliceit emulate scenarios/cucumber_measured.yaml --pace 0.1",
        "sliceit collect --emulator-pendant 30099",
        "sliceit collect calibration/protocols/rich.yaml --host 127.0.0.1 --pace 0.1"
        " --robot hardware/emulated.yaml --move-to-start --emulator-pendant 30099",
        "sliceit collect PROTOCOL --host ADDRESS --robot my.yaml --move-to-start --touch",
    ],
    "tests/test_commissioning.py::test_the_walk_ends_with_the_first_cut": [
        "sliceit hardware SCENARIO --host ADDRESS --robot my.yaml --commission",
    ],
    "tests/test_hardware_interrupted.py::test_a_program_that_runs_on_the_robot_is_not_replaced": [
        "sliceit hardware SCENARIO --host ADDRESS --robot my.yaml --dry-run",
    ],
    "tests/test_hardware_pace.py::test_it_runs_emulator_and_client_and_prints_and_writes_the_"
    "table": ["python -m studies hardware_pace --output docs/how_to/hardware.md"],
    "tests/test_architecture.py::test_the_picture_leaves_out_what_longer_paths_of_arrows_say": [
        "python -m studies architecture",
    ],
    "tests/test_benchmarks_page.py::test_the_page_is_what_its_command_makes": [
        "python -m studies aims",
    ],
    "tests/test_stale_results.py::test_each_file_shows_what_has_changed_since_it_was_committed": [
        "python -m studies stale",
    ],
    "tests/test_readme.py::test_every_page_of_a_study_is_rendered_from_its_stored_results": [
        "python -m studies pages",
    ],
}

# Run by .ci/run, which installs what the tests need.
CI = """
python3 -m venv .venv
pip install -c constraints.txt -e '.[test]'
pytest -n 2
pytest -n 3 -m second_tier
sphinx-build -W -c docs . output/docs
"""

# Read by their parser and no further.
READ_ONLY = {
    "installs": """
        pip install -c constraints.txt --no-compile -e .
        pip install -c constraints.txt -e .
        pip install -c constraints.txt -e '.[docs]'
        pip install -c constraints.txt -e '.[learn]'
        pip install -c constraints.txt -e '.[notebooks]'
        pip install -e '.[learn]'
        pip install sliceit_drake
        pip install 'sliceit_drake[cluster]'
        pip install 'sliceit_drake[database]'
        pip install 'sliceit_drake[hardware]'
        pip install 'sliceit_drake[learn]'
        pip install 'sliceit_drake[ros]'
        """,
    "the reader's files, a display, a GPU or another program": """
        sliceit diagram --output station.svg
        sliceit doctor
        sliceit simulate --meshcat
        sliceit records import force slice.csv --output records
        sliceit records import force scale.csv --metadata facts.yaml --contact 0.4 --output records
        sliceit records import rosbag run_07.mcap --topics /wrench /tcp_pose --between 4.0 9.5 --metadata session.yaml --output records
        sliceit simulate --set food.material.toughness=300 --output output/softer
        sliceit simulate --set numerics.device=cuda:0
        """,  # noqa: E501
    "of another project; the tests start its scheduler and workers from Python": """
        dask scheduler
        dask worker tcp://HOST:8786
        dask worker tcp://10.0.0.5:8786 --nthreads 1 --nworkers -1
        """,
    "minutes, of which parts are tested": """
        sliceit simulate cucumber_sequence
        sliceit simulate tomato_sequence
        sliceit calibrate calibration/records/cucumber.csv --food cucumber --output output/cucumber_food
        sliceit simulate --set calibration=output/cucumber_food/food.yaml
        sliceit record radish.yaml --replicates 2 --seed 1 --output records/radish
        sliceit calibrate records/radish --food radish_setup.yaml --output output/radish_food
        sliceit simulate radish.yaml --set calibration=output/radish_food/food.yaml
        sliceit calibrate records/potato --output output/potato_food
        sliceit simulate --set calibration=output/potato_food/food.yaml
        sliceit calibrate RECORD... --food cucumber --output DIR
        sliceit calibrate RECORD... --food NAME --output DIR
        sliceit calibrate calibration/records/NAME.csv --food NAME --start NAME --output FOLDER --blocks 0 --per-point 60
        sliceit calibrate calibration/records/potato.csv --food potato --start potato --output DIR
        sliceit calibrate --food carrot --literature --output DIR
        sliceit record calibration/protocols/poor.yaml --effect skin --refinement 0.85 --seed 32 --output old
        sliceit record next.yaml --replicates 5 --effect skin --refinement 0.85 --seed 132 --output new
        """,  # noqa: E501
    "a study of minutes to hours, whose results stand in docs": """
        python -m studies adversarial --output docs/results/adversarial_curves.md
        python -m studies bands --laws slice_push bonds --draws 6
        python -m studies calibration --output FOLDER
        python -m studies calibration --polish cucumber tomato potato --steps 0 --starts 1 --blocks 0 --point-steps 0 --output FOLDER
        python -m studies control --output FOLDER
        python -m studies coverage --replicates 12 --output docs/results
        python -m studies disect --output docs/results
        python -m studies bench_misfit --draws 2 --output output/misfit.md
        python -m studies benches --output output/benches --commit HEAD --laws slice_push bonds
        python -m studies benches --part reporting --frozen COMMIT --commit COMMIT --output FOLDER --draws 12 --runs 6 --minutes 29
        python -m studies bench_score FOLDER --keep docs/results/benches_report.jsonl
        python -m studies bench_score docs/results/benches_report.jsonl
        python -m studies half_depth --output docs/figures/half_depth.png
        python -m studies hidden --output output/hidden --seed 1 --replicates 100
        python -m studies hidden --output output/hidden --seed 27 --replicates 100 --minutes 55
        python -m studies identifiability --output docs/results/identifiability.md --figure docs/results/figures/identifiability.png
        python -m studies random --count 200 --seed 1 --output docs/results
        python -m studies real --output docs/results
        python -m studies stepping --output FOLDER
        python -m studies stepping --foods tomato_sequence
        python -m studies verification --fit
        python -m studies verification --output docs/results/verification.md
        """,  # noqa: E501
    "measures times or draws figures, whose results stand in docs": """
        python -m studies batch_speed --repeats 1
        python -m studies batch_speed --repeats 3 --gradient --output docs/results/speed.md
        python -m studies calibration_times --foods potato
        python -m studies calibration_times --foods tomato cucumber
        python -m studies contact --output docs/results/contact.md
        python -m studies cutting_speed --json docs/results/benchmarks/cutting_speed.json
        python -m studies cutting_speed --repeats 3 --output docs/results/figures/cutting_speed.png --json docs/results/benchmarks/cutting_speed.json
        python -m studies diagnosis_speed --json docs/results/benchmarks/diagnosis_speed.json
        python -m studies effects_figure
        python -m studies emulator_figure
        python -m studies endurance --minutes 60 --output docs/results/endurance.md
        python -m studies faults --output docs/results
        python -m studies faster_draws docs/results/slicing_evaluation.jsonl docs/results/faster_draws.jsonl --output docs/results/learning.md
        python -m studies fronts --slices 2 --slices-file docs/results/learning_fronts.jsonl --output docs/results
        python -m studies first_run --json docs/results/benchmarks/first_run.json
        python -m studies foods_page --cut --output docs/reference/foods.md
        python -m studies foods_page --hold --output docs/reference/foods.md
        python -m studies learning_speed --output docs/results/learning.md --json docs/results/benchmarks/learning_speed.json
        python -m studies policy_and_motion models/policies/cutting_0 models/policies/corrected_0 --output docs/results/learning.md
        python -m studies safety_layer
        python -m studies scaling --output docs/results/scaling.md
        python -m studies scaling --trials 24 --slices 4 --tasks 500 --seconds 2 --output docs/results/scaling.md
        python -m studies slicing_ablations --folder output/ablations --output docs/results/learning.md
        python -m studies soak --minutes 60 --output docs/results/soak.md
        python -m studies soft_foods --output docs/results/soft_foods.md
        python -m studies split_step_limit
        python -m studies stand_in_figure
        python -m studies bench_figures
        python -m studies station_speed --repeat 20 --before docs/results/data/before/station_speed.json --json docs/results/benchmarks/station_speed.json --output docs/results/speed.md
        python -m studies station_speed --json docs/results/benchmarks/station_speed.json
        python -m studies tune_rule --generations 1 --output output/tune_rule.jsonl
        python -m studies unfinished_slices docs/results/slicing_evaluation.jsonl --output docs/results/learning.md
        """,  # noqa: E501
}

# Files that a reader has, by the pages that say so.
READERS = {
    "scale.csv": "docs/how_to/tasks.md: the reader's measurement",
    "slice.csv": "docs/how_to/tasks.md: the reader's measurement",
    "facts.yaml": "docs/how_to/tasks.md: the reader's measurement",
    "session.yaml": "docs/how_to/tasks.md: the reader's measurement",
    "run_07.mcap": "docs/how_to/tasks.md: the reader's measurement",
    "records/monday": "the reader's records",
    "records/*.csv": "the reader's records",
    "records/radish": "docs/tutorials/food_of_your_own.md, where the radish is recorded",
    "my.yaml": "docs/how_to/hardware.md: the reader's robot",
    "my_cause.py": "docs/reference/causes.md, where it is shown",
    "brine.py": "docs/explanation/stand_in.md, where it is shown",
    "radish.yaml": "docs/tutorials/food_of_your_own.md, where it is shown",
    "radish_setup.yaml": "docs/tutorials/food_of_your_own.md, where it is shown",
    "food.yaml": "docs/how_to/next_experiment.md, where it is said how to write it",
    "output/cucumber": "`sliceit simulate` without --output",
}
WRITES = ("--output", "--folder", "--figure", "--json", "--next-experiment")
PLACEHOLDER = re.compile(r"[A-Z_]{3,}|.*/NAME\.\w+|\w+://.*")


class Refused(Exception):
    """What a parser says of a command."""


@pytest.fixture
def parsers_raise(monkeypatch):
    def error(parser, message):
        raise Refused(message)

    monkeypatch.setattr(argparse.ArgumentParser, "error", error)


def lines(text: str) -> list[str]:
    return [line.strip() for line in text.splitlines() if line.strip()]


def table() -> list[str]:
    listed = [command for commands in TESTED.values() for command in commands]
    for text in (HERE, CI, *READ_ONLY.values()):
        listed += lines(text)
    return listed


def key(command: Command) -> str:
    return command.text.replace(".venv/bin/", "")


@functools.cache
def whole_parser() -> argparse.ArgumentParser:
    return make_parser()


def nested_parser(words: list[str]) -> tuple[argparse.ArgumentParser, list[str]]:
    """Parser of a command of `sliceit`, and the arguments that are left for it."""
    parser = whole_parser()
    while True:
        nested = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
        if not nested or not words or words[0] not in nested[0].choices:
            return parser, words
        parser, words = nested[0].choices[words[0]], words[1:]


def is_name(command: Command) -> bool:
    """Whether it only names a command or its options, asks for its help, or runs tests by name."""
    words = command.words
    if "pytest" in [Path(w).name for w in words[:2]] and any(
        word.endswith(".py") for word in words
    ):
        return True
    if words[:3] == ["python", "-m", "studies"]:
        rest = words[4:]
    elif words[0] == "sliceit":
        rest = nested_parser(words[1:])[1]
    else:
        return False
    return rest == ["--help"] or not (command.typed or any(w[:2] != "--" for w in rest))


def test_the_table_has_each_command_of_the_docs_once_and_no_other():
    listed, found = table(), {key(c): c for c in COMMANDS if not is_name(c)}
    assert len(listed) == len(set(listed))
    missing = [f"{c.page}:{c.line}: {text}" for text, c in found.items() if text not in listed]
    assert not missing, f"say in {Path(__file__).name} who runs\n" + "\n".join(missing)
    named = {key(c) for c in COMMANDS}
    assert not [text for text in listed if text not in named], "in the table, but on no page"


@pytest.mark.parametrize("test", sorted(TESTED))
def test_tests_of_the_table_exist(test):
    file, _, name = test.partition("::")
    assert f"def {name}(" in (ROOT / file).read_text() if name else (ROOT / file).exists()


@pytest.mark.parametrize("page", sorted({c.page for c in COMMANDS}))
def test_commands_of_a_page_are_read_and_the_files_they_name_are_there(page, parsers_raise):
    made: set[str] = set()
    for command in (c for c in COMMANDS if c.page == page):
        where = f"{page}:{command.line}: {command.text}"
        words = [w for w in command.words if not re.fullmatch(r"[A-Z_]+=\S+", w)]
        program = Path(words[0]).name
        try:
            if program == "sliceit":
                read_sliceit(words[1:], command.typed)
            elif program == "pip":
                read_pip(words[1:])
            elif program == "pytest":
                read_pytest(words[1:])
            elif words[1:3] == ["-m", "studies"]:
                read_study(words[3:], command.typed)
            else:
                assert program in ("python", "python3", "dask", "sphinx-build"), where
        except Refused as error:
            pytest.fail(f"{where}: {error}")
        if program == "sphinx-build":
            continue  # CI runs it as it stands.
        outputs = {after for word, after in zip(words, words[1:], strict=False) if word in WRITES}
        for word in words[1:]:
            if is_file(word) and word not in outputs:
                name = word.partition(":")[0]
                there = name in READERS or name in made or name in ("docs", ".")
                assert there or glob.glob(str(ROOT / name)), f"{where}: there is no {name}"
        made |= outputs


def is_file(word: str) -> bool:
    known = re.fullmatch(r"[\w./*-]+\.(yaml|py|jsonl|csv|md|txt)(:[\d.]+)?", word)
    return not PLACEHOLDER.fullmatch(word) and bool(
        known or re.fullmatch(r"[\w*.]+/[\w/*.]+", word)
    )


def read_sliceit(words: list[str], typed: bool) -> None:
    parser, rest = nested_parser(words)
    read(parser, rest, whole_parser(), words, typed)


def read_study(words: list[str], typed: bool) -> None:
    if words:
        study = find_study(words[0])
        if study is None:
            raise Refused(f"there is no study {words[0]}")
        parser = study_parser(study)
        read(parser, words[1:], parser, words[1:], typed)


def read(
    parser: argparse.ArgumentParser,
    rest: list[str],
    whole: argparse.ArgumentParser,
    words: list[str],
    typed: bool,
) -> None:
    """Reads `words` by the whole parser; `rest` are those that are left for the nested one."""
    options = parser._option_string_actions
    unknown = [w for w in rest if w.startswith("--") and w not in options]
    if unknown:
        raise Refused(f"{parser.prog} has no {unknown[0]}")
    try:
        whole.parse_args(words)
    except SystemExit as end:
        assert end.code == 0  # --help.
    except Refused as error:
        # A sentence may leave out what is not its subject.
        if typed or not re.search("arguments are required|expected one argument", str(error)):
            raise


def read_pip(words: list[str]) -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    for extra in re.findall(r"(?:\.|sliceit_drake)\[(\w+)\]", " ".join(words)):
        if extra not in extras:
            raise Refused(f"pyproject.toml has no extra {extra}")


def read_pytest(words: list[str]) -> None:
    """Each word after -k is in the name of a test of each file."""
    wanted = words[words.index("-k") + 1].split(" or ") if "-k" in words else []
    texts = [(ROOT / word).read_text() for word in words if word.endswith(".py")]
    names = [name for text in texts for name in re.findall(r"^def (test_\w+)", text, re.M)]
    for part in wanted:
        if not any(part in name for name in names):
            raise Refused(f"no test has {part} in its name")


@pytest.mark.parametrize("text", lines(HERE))
def test_it_runs(text, tmp_path, monkeypatch, capsys):
    def not_here(*_):
        raise MeshError("another cut, on a coarser mesh")

    monkeypatch.setattr(
        "sliceit_drake.diagrams.prepared_food.estimate_discretization_error", not_here
    )
    monkeypatch.chdir(tmp_path)
    program, *words = shlex.split(text.replace("NAME", "potato"))
    if program == "python":
        home = re.sub(r"q\d", "0.1", words[1])
        exec(home, {})
        assert -2.0 < float(capsys.readouterr().out) < 2.0
        return
    if words[0] == "simulate":
        words += ["--duration", "0.004", "--no-replay"]
    assert main(words) == 0
    assert capsys.readouterr().out
    assert (words[0] == "simulate") == bool(os.listdir(tmp_path))
