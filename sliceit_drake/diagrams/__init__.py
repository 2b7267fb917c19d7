"""Stations as diagrams: scenarios, the port contract, the simulated and the hardware station."""
