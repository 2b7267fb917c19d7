"""Records of slices: formats, validation and importers. Imports numpy and scipy only."""
