"""Measures the project: studies and benchmarks, and the pages that quote them; not in the wheel."""
