"""Running a robot: plan, board touch, move to the start, run and what it leaves."""
