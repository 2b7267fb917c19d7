"""How near a station is to shaking in contact: its linear loop, and the check at its start."""
