"""Robotic slicing simulated in Drake: robot, compliance control and finite-element cutting."""
