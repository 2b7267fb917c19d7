"""The pages on the diagnosis give the numbers by which it decides."""

from pathlib import Path

import pytest

from sliceit_drake.diagnosis.evidence import verdict
from sliceit_drake.diagnosis.experiments import next_experiment, proposal

DOCS = Path(__file__).resolve().parent.parent / "docs"


@pytest.mark.parametrize(
    ("page", "words"),
    [
        ("explanation/diagnosis", f"The alarm of {100 * verdict.ALARM:g} %"),
        (
            "explanation/diagnosis",
            f"its effect must be {verdict.MIN_SIZE:g} of the noise in contact",
        ),
        ("explanation/diagnosis", f"must show in {100 * verdict.PRESENCE:g} % of the records"),
        (
            "explanation/diagnosis",
            f"the effect that was found to within {verdict.CLASS_ANGLE:g} degrees",
        ),
        (
            "explanation/diagnosis",
            f"their gain is less than {100 * verdict.CLASS_GAIN:g} % below the largest",
        ),
        (
            "explanation/diagnosis",
            f"of one condition, the limits are {verdict.ONE_CONDITION_ANGLE:g} degrees "
            f"and {100 * verdict.ONE_CONDITION_GAIN:g} %",
        ),
        (
            "explanation/diagnosis",
            f"subtracts what remains where nothing is wrong ({verdict.TOLERATED:g} of the noise)",
        ),
        (
            "explanation/diagnosis",
            f"less than {100 * verdict.EXPLAINED:g} %, the verdict is unknown",
        ),
        (
            "explanation/diagnosis",
            f"at least {100 * verdict.SECOND_SHARE:g} % of the sum of squares",
        ),
        (
            "explanation/diagnosis",
            f"at least {100 * verdict.OF_THE_REST:g} % of what the first leaves",
        ),
        (
            "explanation/diagnosis",
            f"at least {100 * verdict.SECOND_GAIN:g} % of all that can be gained",
        ),
        ("explanation/diagnosis", f"its effect is {verdict.MIN_MISFIT:g} of the noise or more"),
        (
            "explanation/diagnosis",
            f"at least {verdict.MISFIT_FACTOR:g} times what it gains where nothing",
        ),
        (
            "explanation/diagnosis",
            f"condition, the last two limits are {verdict.ONE_CONDITION_MISFIT:g} of the noise "
            f"and {verdict.ONE_CONDITION_FACTOR:g} times",
        ),
        (
            "explanation/diagnosis",
            f"if the interval ends below {100 * verdict.MIN_REMOVED:g} % and",
        ),
        (
            "how_to/next_experiment",
            f"at least {100 * (1.0 - next_experiment.ALIKE_GAIN):g} % as much and lie within "
            f"{verdict.CLASS_ANGLE + proposal.MARGIN:g} degrees",
        ),
    ],
)
def test_the_page_gives_the_number_that_is_used(page, words):
    text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
    assert words in " ".join(text.split())
