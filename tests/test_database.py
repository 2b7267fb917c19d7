"""A calibration's search on PostgreSQL, whose workers may be killed."""

import multiprocessing
import os
import signal
import socket
import time

import optuna
import pytest
from example_slices import HEIGHT, short_press

from sliceit_drake.calibration.prediction import Predictor
from sliceit_drake.calibration.search import open_study, search
from sliceit_drake.calibration.setup import CalibrationSetup, ParameterRange
from sliceit_drake.calibration.storage import keeps_answering, without_password
from sliceit_drake.cli.main import main
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.cutting.foods.shapes import Cylinder
from studies.scaling.local_database import NoServerError, find_server, local_database


@pytest.fixture(scope="module")
def database():
    pytest.importorskip("psycopg", reason="the extra `database` is not installed")
    try:
        with local_database() as url:
            place = ("127.0.0.1", int(url.split(":")[-1].split("/")[0]))
            yield url
    except NoServerError as reason:
        pytest.skip(str(reason))
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(place)


def predictor() -> Predictor:
    setup = CalibrationSetup(
        food=Food(shape=Cylinder(HEIGHT, 0.06, 3, [0.0, 0.004, 0.012]), hold_distance=0.0119),
        parameters=[
            ParameterRange("material.toughness", 50.0, 1000.0),
            ParameterRange("material.friction", 0.02, 1.0),
        ],
    )
    return Predictor(setup, [short_press()], workers=1)


def work(storage: str, seed: int, trials: int) -> None:
    search(predictor(), open_study(storage, "shared"), trials, seed)


def finished(study: optuna.Study) -> dict[int, int]:
    """Number of finished trials by the seed of the worker that made them."""
    counts: dict[int, int] = {}
    for trial in study.get_trials(deepcopy=False):
        assert trial.state == optuna.trial.TrialState.COMPLETE
        counts[trial.user_attrs["seed"]] = counts.get(trial.user_attrs["seed"], 0) + 1
    return counts


def wait_for(study: optuna.Study, seeds: set[int]) -> None:
    end = time.monotonic() + 120.0
    while time.monotonic() < end:
        if seeds <= set(finished(study)):
            return
        time.sleep(0.1)
    raise AssertionError(f"not all of {seeds} have finished a trial")


def test_two_workers_share_a_database_and_one_that_is_killed_goes_on(database):
    spawn = multiprocessing.get_context("spawn")
    # More than they can do before they are stopped. They begin together, on an empty database.
    workers = {s: spawn.Process(target=work, args=(database, s, 10_000)) for s in (1, 2)}
    try:
        for worker in workers.values():
            worker.start()
        study = open_study(database, "shared")
        wait_for(study, {1, 2})
    finally:
        for worker in workers.values():
            os.kill(worker.pid, signal.SIGKILL)
            worker.join()
    before = finished(study)
    assert set(before) == {1, 2}
    total = sum(before.values())
    work(database, 1, total + 8)
    after = finished(study)
    assert after[2] == before[2] and 8 <= after[1] - before[1] <= 11
    assert [t.number for t in study.trials] == list(range(sum(after.values())))
    # Each worker begins with the setup's values; nothing else was computed twice.
    places = [(t.params["material.toughness"], t.params["material.friction"]) for t in study.trials]
    assert len(set(places)) >= len(places) - 1


def test_a_search_on_a_database_is_that_on_a_journal_file(database, tmp_path):
    slices = predictor()
    on_file = search(slices, open_study(tmp_path / "trials.log", "alone"), 8, seed=3)
    in_database = search(slices, open_study(database, "alone"), 8, seed=3)
    assert in_database.units.tolist() == on_file.units.tolist()
    assert in_database.errors.tolist() == on_file.errors.tolist()


def test_a_database_that_stops_in_mid_search_is_named_with_what_to_do(database):
    with pytest.raises(ConfigurationError, match="stopped answering") as error, keeps_answering():
        study = open_study(database, "gone")
        study._storage._backend.engine.dispose()
        with study._storage._backend.engine.connect() as connection:
            connection.exec_driver_sql("SELECT pg_terminate_backend(pg_backend_pid())")
    assert error.value.field == "--storage" and "finished trials are kept" in error.value.fix


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("sliceit:", "sliceit:wrong"), "password authentication failed"),
        (("/postgres", "/nothing"), '"nothing" does not exist'),
        (("127.0.0.1:", "127.0.0.1:1"), "cannot be opened"),
        (("sliceit:", "sliceit:a@"), "cannot be opened"),
        (("postgresql://", "postgrsql://"), "cannot be opened"),
    ],
)
def test_a_wrong_url_is_refused_without_its_password(database, tmp_path, capsys, change, said):
    wrong = database.replace(*change, 1)
    secret = database.split(":")[2].split("@")[0]
    command = ["calibrate", "calibration/records/cucumber.csv", "--food", "cucumber"]
    assert main([*command, "--output", str(tmp_path), "--storage", wrong]) == 2
    printed = capsys.readouterr()
    assert "--storage" in printed.err and said in printed.err and "PGPASSWORD" in printed.err
    assert secret not in printed.err + printed.out
    assert "First fit" not in printed.out


def test_passwords_of_urls_are_not_kept_in_a_command():
    url = "postgresql://me:se:cr@et@host/db?sslmode=require&password=secret"
    hidden = "postgresql://me:***@host/db?sslmode=require&password=***"
    assert without_password(f"--storage={url}") == f"--storage={hidden}"
    assert without_password("postgresql://me@host/db a:b@c") == "postgresql://me@host/db a:b@c"


def test_a_machine_without_a_server_says_so(monkeypatch, tmp_path):
    monkeypatch.setattr("studies.scaling.local_database.PACKAGES", ("no_such_package",))
    monkeypatch.setattr("studies.scaling.local_database.DISTRIBUTION", tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(NoServerError, match="pgserver"):
        find_server()
