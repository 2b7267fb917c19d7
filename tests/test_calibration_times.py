"""The study of a calibration's time: which commands it types, and what it counts."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from studies.calibration import times


def test_foods_without_a_record_come_from_published_levels():
    record = "calibration/records/potato.csv"
    assert times.command_for("potato") == ["calibrate", record, "--food", "potato"]
    assert times.command_for("apple") == ["calibrate", "--food", "apple", "--literature"]


def test_the_processor_time_is_that_of_the_command_and_not_of_who_waits(monkeypatch):
    run = subprocess.run

    def busy(command, **options):
        folder = Path(command[-1])
        (folder / "calibration.json").write_text(json.dumps({"rms_N": 0.5}))
        work = "import time\nwhile time.process_time() < 0.5: pass\ntime.sleep(0.5)"
        (folder / "first_fit.png").touch()
        run([sys.executable, "-c", work], **options)

    monkeypatch.setattr(subprocess, "run", busy)
    found = times.typed(["calibrate"])
    assert found.processor == pytest.approx(0.5, abs=0.3)
    assert found.wall > found.processor + 0.4
    assert found.rms == 0.5 and 0.0 <= found.first < found.wall - 0.9
