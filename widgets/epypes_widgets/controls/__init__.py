"""Which controls does a runner get, and how do they stand on the page?

- ``kinds``: of which type are the values
- ``scale``: where on a slider is a value, and which value is a place
- ``control``: what every control can do
- ``sliders``, ``pair``, ``choices``, ``text``, ``roi``, ``shown``: one family each
- ``look``: what all of them share
- ``build``: which one does a hyperparameter get
- ``column``: how they stand below each other
"""

from __future__ import annotations

from epypes_widgets.controls.build import controls
from epypes_widgets.controls.column import Column, column
from epypes_widgets.controls.control import Control

__all__ = ["Column", "Control", "column", "controls"]
