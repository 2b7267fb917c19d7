"""What the simulation gets wrong in measured slices, and why.

A user calls `diagnose.diagnose`, or `one_slice.diagnose_slice` for a single record. `causes` are
the fault hypotheses, `evidence` what records say of them, `experiments` what to cut next,
`one_slice` what a single record shows; `result` and `report` hold and show what was found.
"""
