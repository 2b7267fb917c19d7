"""What a simulation gets wrong in measured slices, and what may cause it."""
