"""Fixtures that several test modules use."""

import faulthandler

import pytest


@pytest.fixture
def no_test_hangs():
    """Ends the process of a test that hangs: clients hold Python's lock while they wait."""
    faulthandler.dump_traceback_later(300.0, exit=True)
    yield
    faulthandler.cancel_dump_traceback_later()
