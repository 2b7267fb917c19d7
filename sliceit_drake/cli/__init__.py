"""The program `sliceit`."""
