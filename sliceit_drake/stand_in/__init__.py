"""Worlds with hidden effects that make slice records (docs/explanation/stand_in.md).

Calibration and diagnosis never import it: what it hides is theirs to find.
"""

from typing import TYPE_CHECKING

from sliceit_drake.lazy_names import lazy_names

if TYPE_CHECKING:
    from sliceit_drake.stand_in.effect import Effect as Effect
    from sliceit_drake.stand_in.finite_element_world import (
        FiniteElementSettings as FiniteElementSettings,
    )
    from sliceit_drake.stand_in.protocol import Condition as Condition
    from sliceit_drake.stand_in.protocol import Protocol as Protocol
    from sliceit_drake.stand_in.session import record_session as record_session
else:
    __getattr__, __dir__ = lazy_names(__name__)
