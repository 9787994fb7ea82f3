"""How does a slider move one number?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import ipywidgets

from epypes_widgets.controls.control import Control
from epypes_widgets.controls.look import Look
from epypes_widgets.controls.quiet import QuietFloatSlider, QuietIntSlider, QuietLogSlider
from epypes_widgets.controls.scale import Scale, exponent


class Snap:
    """A place on a slider, and the value that was put there, which counts to the last bit.

    The front end snaps a slider to its steps as soon as it is shown and reports that like a move of the hand. So the
    first place within half a step of the given value means that value; any other is the hand's.
    """

    def __init__(self, scale: Scale, value: Any, step: float) -> None:
        self._scale, self._exact, self._step = scale, value, step
        self._placed: float | None = None
        self._snapped: float | None = None

    def put(self, value: Any, place: float) -> None:
        """Take a value, and the place at which the slider stands for it."""
        self._exact, self._placed, self._snapped = value, place, None

    def read(self, place: float) -> Any:
        """Return the value that is meant by a place."""
        if place == self._placed:
            return self._exact
        distance = abs(self._scale.along(place) - self._scale.along(self._exact))
        if self._snapped is None and distance <= self._step / 2 * (1 + 1e-9):
            self._snapped = place
        return self._exact if place == self._snapped else self._scale.meant(place)


class _Single:
    """A slider with one handle."""

    def __init__(self, slider: Any, scale: Scale, value: Any) -> None:
        self._slider, self._scale = slider, scale
        self._snap = Snap(scale, value, scale.step)
        self._snap.put(value, slider.value)

    def read(self) -> dict[str, Any]:
        return {self._scale.name: self._snap.read(self._slider.value)}

    def checked(self, values: Mapping[str, Any]) -> dict[str, Any]:
        return {name: self._scale.checked(value) for name, value in values.items()}

    def place(self, values: Mapping[str, Any]) -> None:
        for value in values.values():
            # Only the soft range is offered at first; code may go to the ends of the hard one.
            self._slider.min, self._slider.max = self._scale.grown(self._slider.min, self._slider.max, value)
            # First: a hand that moves the slider at this very moment, on another thread, means a place of its own.
            self._snap.put(value, self._accepted(value))
            self._slider.value = self._scale.place(value)

    def _accepted(self, value: Any) -> float:
        """Return where the slider will stand for a value: one of exponents clamps to what its ends come to."""
        place = self._scale.place(value)
        if not self._scale.param.log:
            return place
        return float(min(max(place, 10.0**self._slider.min), 10.0**self._slider.max))


def slider(scale: Scale, value: Any, first: Any, look: Look, tip: str) -> Control:
    """Return a slider of whole numbers, of floats, or of exponents."""
    words = look.words((scale.name,), tip, ipywidgets.widgets.widget_int.SliderStyle)
    common = {"step": scale.step, "readout": False, "continuous_update": False, **words}
    widget: Any
    if scale.param.log:
        low, high = exponent(min(scale.low, value)), exponent(max(scale.high, value))
        widget = QuietLogSlider(value=float(value), base=10, min=low, max=high, **common)
    else:
        kind = QuietIntSlider if scale.integer else QuietFloatSlider
        widget = kind(value=scale.place(value), min=scale.low, max=scale.high, **common)
    mechanism = _Single(widget, scale, value)
    name = "log" if scale.param.log else "slider"
    return Control(
        (scale.name,), name, (scale.param,), widget, mechanism,
        first=(first,), integer=scale.integer, steps=(scale.step,),
    )  # fmt: skip
