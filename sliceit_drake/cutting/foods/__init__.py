"""Foods: what a user says of one, its material and effects, and foods that were calibrated."""
