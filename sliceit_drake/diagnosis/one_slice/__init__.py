"""What a single record shows."""
