"""A real UR5e: limits, safety layer, the link through RTDE, and its Drake system."""
