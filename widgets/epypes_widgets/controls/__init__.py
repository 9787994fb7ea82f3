"""The controls of a runner, and how they stand on the page.

- ``scale``: the values along a slider
- ``control``: every control
- ``factory``: which control a hyperparameter gets
- ``column``: how they stand below each other
"""

from __future__ import annotations

from epypes_widgets.controls.column import Column, column
from epypes_widgets.controls.control import Control
from epypes_widgets.controls.factory import controls

__all__ = ["Column", "Control", "column", "controls"]
