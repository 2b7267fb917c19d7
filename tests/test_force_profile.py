"""The measured force profiles load, agree with what is published of them, and bad ones do not."""

from pathlib import Path

import numpy as np
import pytest

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.records.force_profile import load_force_profile
from studies.simulated_profiles import load_simulated_profile

MEASURED = Path(__file__).resolve().parent.parent / "calibration" / "measured"


# RMS errors of the authors' two simulators against the measurement, N, and durations, s.
@pytest.mark.parametrize(
    ("food", "finite_elements", "spring", "duration"),
    [("cucumber", 0.76, 3.39, 1.3), ("tomato", 2.71, 13.97, 2.4), ("potato", 3.67, 7.62, 2.0)],
)
def test_a_measured_profile_has_the_published_errors_and_duration(
    food, finite_elements, spring, duration
):
    profile = load_simulated_profile(MEASURED / f"sliceit_real_{food}_force.csv")

    def rms(name):
        return np.sqrt(np.mean((profile.references[name] - profile.force) ** 2))

    assert rms("DiSECt") == pytest.approx(finite_elements, abs=0.02)
    assert rms("spring") == pytest.approx(spring, abs=0.02)
    assert profile.time[-1] == pytest.approx(duration, abs=0.01)
    assert profile.time.shape == profile.force.shape == profile.is_read.shape


def test_points_interpolated_over_a_gap_of_the_drawn_curve_are_told_apart():
    profile = load_force_profile(MEASURED / "sliceit_real_cucumber_force.csv")
    # The drawn curve begins with the end of a gap.
    np.testing.assert_array_equal(profile.is_read[:4], [False, True, True, True])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("\n0.01,", "\n0.001,", "time_s: row 3 has 0.001 after 0.005. Sort the rows"),
        ("\n0.01,0.180", "\n0.01,nan", "csv, line 4: F_ground_truth_N: is 'nan'"),
        ("\n0.01,0.180", "\n0.01,-inf", "csv, line 4: F_ground_truth_N: is '-inf'"),
        ("\n0.01,0.180", "\n0.01,0;18", "csv, line 4: F_ground_truth_N: is '0;18'"),
        (
            "F_ground_truth_N",
            "F_ground_truth",
            'no column "F_ground_truth_N".*Rename "F_ground_truth"',
        ),
        ("0.182,0\n", "0.182,0.5\n", "gt_from_drawn_dash: row 1 has 0.5. Write 1 where"),
    ],
)
def test_a_bad_profile_is_refused_with_file_column_row_and_fix(tmp_path, old, new, message):
    text = (MEASURED / "sliceit_real_cucumber_force.csv").read_text(encoding="utf-8")
    assert old in text
    file = tmp_path / "profile.csv"
    file.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ConfigurationError, match=message) as caught:
        load_force_profile(file)
    assert str(caught.value).startswith(str(file))


def test_a_profile_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="carrot.csv: the table cannot be read"):
        load_force_profile(tmp_path / "carrot.csv")
