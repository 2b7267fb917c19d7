"""Reality stand-in: worlds with hidden effects that make slice records (docs/stand_in.md).

Calibration and diagnosis never import it: what it hides is theirs to find.
"""
