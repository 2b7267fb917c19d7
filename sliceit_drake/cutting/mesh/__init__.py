"""Meshes: tetrahedra, their split by the cut, and the surfaces that are drawn."""
