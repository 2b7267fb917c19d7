"""Studies of trained policies."""
