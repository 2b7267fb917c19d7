"""Stations as diagrams: scenario, port contract, simulated and hardware station, and their runs."""
