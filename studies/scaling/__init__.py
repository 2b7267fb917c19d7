"""Studies of many machines: databases and clusters."""
