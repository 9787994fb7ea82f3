"""Which values do the functions of OpenCV and scikit-image take?

- ``opencv_filters``, ``opencv_features``, ``skimage``: the table, by function and parameter; data only
- ``lookup``: what it says of a function
- ``calls``: what a user's function hands to such a function
- ``names``: what a name alone says

Nothing here imports these libraries: who uses their functions has imported them.
"""

from epypes.catalog.calls import Use, uses
from epypes.catalog.entry import Entry
from epypes.catalog.lookup import TABLE, entry_of
from epypes.catalog.names import usual
from epypes.catalog.signatures import parameter_names

__all__ = ["TABLE", "Entry", "Use", "entry_of", "parameter_names", "uses", "usual"]
