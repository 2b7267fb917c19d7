"""Runs a robot: checks, plan, the operator's word, run, and what it leaves."""
