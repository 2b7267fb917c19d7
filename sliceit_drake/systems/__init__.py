"""Drake systems of a slicing station, one a file."""
