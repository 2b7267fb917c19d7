"""Studies of station, control, servo and hardware path."""
