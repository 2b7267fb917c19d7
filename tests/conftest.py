"""Fixtures that several test modules use, and the two tiers of the tests."""

import faulthandler
import os

import pytest

# As the programs: before numpy is imported, and for what tests start. Sums of several threads
# differ in their last bits from those of one.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


@pytest.fixture
def no_test_hangs():
    """Ends the process of a test that hangs: clients hold Python's lock while they wait."""
    faulthandler.dump_traceback_later(300.0, exit=True)
    yield
    faulthandler.cancel_dump_traceback_later()


def pytest_configure(config: pytest.Config) -> None:
    """Leaves the second tier to `-m second_tier`, and to who names a file or a test."""
    whole = config.args_source == pytest.Config.ArgsSource.TESTPATHS
    if whole and not config.option.markexpr:
        config.option.markexpr = "not second_tier"
