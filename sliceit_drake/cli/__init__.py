"""The program `sliceit`: each command parses its arguments, calls its package, and prints."""
