"""The hidden-effect study: effects are hidden in records and diagnosed; diagnoses are judged."""
