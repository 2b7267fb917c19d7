"""Which experiment tells causes apart, and what a set of records can tell at all."""
