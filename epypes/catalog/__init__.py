"""The values that parameters of OpenCV's and scikit-image's functions take.

- ``table``: the entries by function and parameter, read from ``opencv.toml`` and ``skimage.toml`` on first use
- ``lookup``: the entry of a function's parameter, found by object; the usual values of a parameter's name
- ``calls``: the entries of the library functions that a user's function passes its parameter to
- ``ranges``: the range of a hyperparameter of a graph

Nothing here imports these libraries: a caller that uses their functions has imported them.
"""

from epypes.catalog.calls import Use, parameter_names, uses
from epypes.catalog.lookup import entry_of, usual
from epypes.catalog.ranges import plain, range_of
from epypes.catalog.table import CatalogEntry, table

__all__ = ["CatalogEntry", "Use", "entry_of", "parameter_names", "plain", "range_of", "table", "uses", "usual"]
