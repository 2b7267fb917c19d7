"""The pages on the diagnosis give the numbers by which it decides."""

from pathlib import Path

import pytest

from sliceit_drake.diagnosis.evidence import linear, verdict
from sliceit_drake.diagnosis.experiments import next_experiment, proposal
from sliceit_drake.prediction import discrepancy

RULE = verdict.DecisionRule()
DELAY = linear.USUAL["sensor_delay", "delay"][0]
DOCS = Path(__file__).resolve().parent.parent / "docs"


@pytest.mark.parametrize(
    ("page", "words"),
    [
        ("explanation/diagnosis", f"The alarm of {100 * RULE.alarm:g} %"),
        ("explanation/diagnosis", f"is at least {RULE.size:g} of noise and own error together"),
        ("explanation/diagnosis", f"usual size ({1000 * DELAY:g} ms for the delay, half a cycle"),
        ("explanation/diagnosis", f"A delay has to be {RULE.size_usual:g}"),
        ("explanation/diagnosis", f"An effect of {RULE.size_instead:g} is enough where another"),
        ("explanation/diagnosis", f"gains at least {RULE.gain:g} for each record, twice"),
        ("explanation/diagnosis", f"as many times less is enough, down to {RULE.right:g}"),
        ("explanation/diagnosis", f"at least {RULE.beside:g} for each record beside others"),
        ("explanation/diagnosis", f"by {RULE.trend:g} of the noise or more is unknown"),
        ("explanation/diagnosis", f"shows in {100 * RULE.presence:g} % of the records"),
        ("explanation/diagnosis", f"to within {verdict.CLASS_ANGLE:g} degrees are named together"),
        ("explanation/diagnosis", f"that was found is {RULE.unknown:g} of the noise in contact"),
        (
            "explanation/diagnosis",
            f"a channel's size is {100 * discrepancy.USUAL_SHARE:g} % of the force, up or down by "
            f"a factor of $e^{{{discrepancy.PRIOR['channel']:g}}}$",
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
