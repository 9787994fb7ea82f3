"""How does one slider with two ends keep two numbers in order?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import ipywidgets

from epypes.display.previews.short import short_repr
from epypes_widgets.controls.control import Control
from epypes_widgets.controls.kinds import is_same
from epypes_widgets.controls.look import Look
from epypes_widgets.controls.quiet import QuietFloatRange, QuietIntRange
from epypes_widgets.controls.scale import Scale
from epypes_widgets.controls.sliders import Snap

_Two = tuple[Any, Any]


class _Pair:
    """A slider with two handles; the lower value never exceeds the upper one."""

    def __init__(self, slider: Any, scales: tuple[Scale, Scale], values: _Two) -> None:
        self._slider, self._scales, self._values = slider, scales, values
        self._snaps = tuple(Snap(scale, value, slider.step) for scale, value in zip(scales, values, strict=True))
        self._places: tuple[float, float] = slider.value
        self._settle(values, slider.value)

    def read(self) -> dict[str, Any]:
        places = self._slider.value
        if places != self._places:
            meant = tuple(snap.read(place) for snap, place in zip(self._snaps, places, strict=True))
            self._places, self._values = places, self._ordered((meant[0], meant[1]))
        return self._named(self._values)

    def checked(self, values: Mapping[str, Any]) -> dict[str, Any]:
        found = {scale.name: scale.checked(values[scale.name]) for scale in self._scales if scale.name in values}
        low, high = {**self.read(), **found}.values()
        if low > high:
            raise ValueError(self._out_of_order(found, low, high))
        return found

    def place(self, values: Mapping[str, Any]) -> None:
        low, high = {**self.read(), **values}.values()
        for scale, value in zip(self._scales, (low, high), strict=True):
            self._slider.min, self._slider.max = scale.grown(self._slider.min, self._slider.max, value)
        places = self._scales[0].place(low), self._scales[1].place(high)
        # First: a hand that moves the slider at this very moment, on another thread, means places of its own.
        self._settle((low, high), places)
        self._slider.value = places

    def _settle(self, values: _Two, places: tuple[float, float]) -> None:
        self._values, self._places = values, places
        for snap, value, place in zip(self._snaps, values, places, strict=True):
            snap.put(value, place)

    def _named(self, values: _Two) -> dict[str, Any]:
        return {scale.name: value for scale, value in zip(self._scales, values, strict=True)}

    def _ordered(self, new: _Two) -> _Two:
        """Return values in order: what was moved gives way to what was not.

        The handles are always in order. Their values need not be: each has a range, a type and exact values of its own.
        """
        (low, high), (low_before, high_before) = new, self._values
        if low <= high:
            return new
        if is_same(high, high_before):
            low = self._scales[0].meant(high)
            return (low, high) if low <= high else (low_before, high)
        high = self._scales[1].meant(low)
        if low <= high:
            return low, high
        return (low, high_before) if low <= high_before else self._values

    def _out_of_order(self, given: Mapping[str, Any], low: Any, high: Any) -> str:
        below, above = (scale.name for scale in self._scales)
        if below in given:
            said = f"{below!r} can't be {short_repr(low)}: it is never above {above!r}, which is {short_repr(high)}."
            return f"{said} Set {above!r} first, or both at once."
        said = f"{above!r} can't be {short_repr(high)}: it is never below {below!r}, which is {short_repr(low)}."
        return f"{said} Set {below!r} first, or both at once."


def pair(low: Scale, high: Scale, values: _Two, first: _Two, look: Look, tip: str) -> Control:
    """Return one slider for two hyperparameters, over the ranges of both."""
    scales = (low, high)
    names = (low.name, high.name)
    integer = low.integer and high.integer
    kind = QuietIntRange if integer else QuietFloatRange
    widget = kind(
        value=(low.place(values[0]), high.place(values[1])),
        min=min(low.low, high.low),
        max=max(low.high, high.high),
        step=min(low.step, high.step),
        readout=False,
        continuous_update=False,
        **look.words(names, tip, ipywidgets.widgets.widget_int.SliderStyle),
    )
    mechanism = _Pair(widget, scales, values)
    return Control(
        names, "range", (low.param, high.param), widget, mechanism,
        first=first, integer=integer, steps=(low.step, high.step),
    )  # fmt: skip
