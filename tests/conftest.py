"""Fixtures that several test modules use, and the two tiers of the tests."""

import faulthandler

import pytest


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
