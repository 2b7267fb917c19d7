"""From a record to the simulated wrench beside it."""
