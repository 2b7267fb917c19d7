"""What to cut next so that causes part, and what a set of records could tell at all."""
