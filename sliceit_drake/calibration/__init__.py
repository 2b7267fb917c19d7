"""Fitting of the simulation's parameters to records of slices."""
