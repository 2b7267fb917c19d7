"""Studies of the diagnosis on measured slices, and what it costs."""
