"""Records of slices: formats, validation and importers. Imports numpy and scipy only."""

from typing import TYPE_CHECKING

from sliceit_drake.lazy_names import lazy_names

if TYPE_CHECKING:
    from sliceit_drake.records import preprocessing as preprocessing
    from sliceit_drake.records.slice_record import write_record as write_record
    from sliceit_drake.records.validation import check_record as check_record
    from sliceit_drake.records.validation import load_record as load_record
else:
    __getattr__, __dir__ = lazy_names(__name__)
