"""Studies of the calibration: coverage of its intervals, the paper's curves."""
