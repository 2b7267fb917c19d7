"""Benches whose reality the simulation does not have: other cutting laws, noises and effects."""
