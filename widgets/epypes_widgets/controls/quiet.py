"""Why do our sliders not answer the browser what it has just told them?

ipywidgets sends each value back, for other views of the same kernel; that message would arrive right before the picture
and hold it up. While a slider is dragged, the view of the panel tells where it is (``slide``), with its own messages.
"""

from __future__ import annotations

from typing import Any

import ipywidgets
import traitlets


class QuietIntSlider(ipywidgets.IntSlider):
    """A slider of whole numbers."""

    value = traitlets.CInt(0).tag(sync=True, echo_update=False)


class QuietFloatSlider(ipywidgets.FloatSlider):
    """A slider of numbers."""

    value = traitlets.CFloat(0.0).tag(sync=True, echo_update=False)


class QuietLogSlider(ipywidgets.FloatLogSlider):
    """A slider of exponents."""

    value = traitlets.CFloat(1.0).tag(sync=True, echo_update=False)


class QuietIntRange(ipywidgets.IntRangeSlider):
    """A slider of whole numbers with two ends."""

    value = traitlets.Tuple(traitlets.CInt(), traitlets.CInt()).tag(sync=True, echo_update=False)


class QuietFloatRange(ipywidgets.FloatRangeSlider):
    """A slider of numbers with two ends."""

    value = traitlets.Tuple(traitlets.CFloat(), traitlets.CFloat()).tag(sync=True, echo_update=False)


def slide(slider: Any, place: Any) -> None:
    """Take the place to which the browser has moved a slider, as if the slider itself had told it."""
    slider.set_state({"value": place})
