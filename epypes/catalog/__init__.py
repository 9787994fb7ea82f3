"""The values that parameters of OpenCV's and scikit-image's functions take.

- ``lookup``: the table in ``opencv.toml`` and ``skimage.toml``, looked up by function, as an object, and by name
- ``calls``: the entries of the library functions that a user's function passes its parameter to
- ``ranges``: the range of a hyperparameter of a graph

Nothing here imports these libraries: a caller that uses their functions has imported them.
"""

from epypes.catalog.calls import parameter_names, uses
from epypes.catalog.lookup import CatalogEntry, entry_of, fits, table, usual
from epypes.catalog.ranges import plain, range_of, reason_against, with_odd

__all__ = [
    "CatalogEntry",
    "entry_of",
    "fits",
    "parameter_names",
    "plain",
    "range_of",
    "reason_against",
    "table",
    "uses",
    "usual",
    "with_odd",
]  # fmt: skip
