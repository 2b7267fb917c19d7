"""DiSECt's reference case, cut here."""
