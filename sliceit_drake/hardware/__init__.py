"""A real UR5e: limits, safety layer, checks, the link through RTDE and the system that reads it."""
