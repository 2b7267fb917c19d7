"""What a single record shows of each cause, which is no diagnosis: slices vary."""
