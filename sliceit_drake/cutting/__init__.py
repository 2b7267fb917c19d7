"""Cutting physics: finite elements, cut surface, knife and board. Imports numpy, scipy and warp only."""
