"""Diagnosis: what the simulation gets wrong in measured slices, and why.

`causes` are the fault hypotheses, `evidence` what records say of them, `experiments` what to cut
next, `one_slice` what a single record shows; `result` and `report` hold and show what was found.
"""

from typing import TYPE_CHECKING

from sliceit_drake.lazy_names import lazy_names

if TYPE_CHECKING:
    from sliceit_drake.diagnosis.cause import CauseParameter as CauseParameter
    from sliceit_drake.diagnosis.cause import Scan as Scan
    from sliceit_drake.diagnosis.diagnose import setup_of_food as setup_of_food
    from sliceit_drake.diagnosis.one_slice.diagnose_slice import diagnose_slice as diagnose_slice
    from sliceit_drake.diagnosis.registry import load_cause as load_cause
else:
    __getattr__, __dir__ = lazy_names(__name__)
