"""The steps of Adam."""

import numpy as np
import pytest

from sliceit_drake.calibration.refine import Adam


def test_a_steady_gradient_gives_unit_steps_against_it():
    gradient, adam = np.array([3.0, -0.02, 1e-7, 0.0]), Adam.of(4)
    for step in range(50):
        found = adam.descent(gradient, step, 1e-9)
        assert found == pytest.approx([-1.0, 1.0, -1.0, 0.0], rel=0.02, abs=1e-12)


def test_a_gradient_that_ends_is_forgotten_at_the_rates_of_the_paper():
    adam = Adam.of(1)
    adam.descent(np.array([2.0]), 0, 0.0)
    found = adam.descent(np.array([0.0]), 1, 0.0)
    mean = 0.1 * 2.0 * 0.9 / (1.0 - 0.9**2)
    square = 0.001 * 4.0 * 0.999 / (1.0 - 0.999**2)
    assert found == pytest.approx([-mean / np.sqrt(square)], rel=1e-12)
