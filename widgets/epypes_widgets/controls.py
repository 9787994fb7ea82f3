"""What moves a hyperparameter, or shows it where nothing can?"""

from __future__ import annotations

import enum
import math
import numbers
import reprlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import ipywidgets
import traitlets

from epypes.graph import CompGraph
from epypes.hints import Param
from epypes.run.tokens import is_same_value
from epypes_widgets.ranges import Range, allows, described

_WIDE: Final = {"width": "100%"}
_STYLE: Final = {"description_width": "112px"}


class OddSlider(ipywidgets.IntSlider):
    """A slider of odd integers that takes the next odd one when an even one is typed into it."""

    @traitlets.validate("value")  # type: ignore[untyped-decorator]
    def _validate_value(self, proposal: Any) -> int:
        # The base class only clamps. A value changed here goes back to the front end, which shows it.
        value = int(proposal["value"]) | 1
        return int(min(max(value, self.min), self.max))


@dataclass(frozen=True, slots=True)
class Control:
    """A hyperparameter on screen.

    Attributes
    ----------
    name
        The token.
    param
        The values it may take; None if it is only shown.
    widget
        What is seen.
    trait
        The name of the widget's trait that changes when it is moved.
    read
        Returns the value that the widget is at.
    place
        Moves the widget to a value that has been checked.
    """

    name: str
    param: Param | None
    widget: ipywidgets.Widget
    trait: str
    read: Callable[[], Any]
    place: Callable[[Any], None]

    def write(self, value: Any) -> None:
        """Move to a value.

        Raises
        ------
        ValueError
            The value is outside of the range; the control stays where it is.
        """
        if self.param is not None and not allows(self.param, value):
            raise ValueError(
                f"{self.name!r} can't be {value!r:.60}: its range is {described(self.param)}. "
                "Give tune() a wider hint for it.",
            )
        self.place(value)

    def on_change(self, callback: Callable[[str, Any], None]) -> None:
        """Call ``callback(name, value)`` when it was moved, on whichever thread the front end is answered on.

        A widget that was only shown, and has snapped to its steps, was not moved.
        """
        told = [self.read()]

        def moved(change: object) -> None:
            value = self.read()
            if value is not told[0] and not is_same_value(told[0], value):
                told[0] = value
                callback(self.name, value)

        self.widget.observe(moved, names=self.trait)


def control(name: str, value: Any, param: Range) -> Control:
    """Return the control that fits a range: slider, logarithmic slider, drop-down, checkbox or a label."""
    if not isinstance(param, Param):
        return _label(name, value)
    if param.choices is not None:
        both = len(param.choices) == 2 and all(isinstance(choice, bool) for choice in param.choices)
        return _checkbox(name, value, param) if both else _dropdown(name, value, param)
    if param.log:
        return _log_slider(name, value, param)
    if _is_integer(value) and all(end is None or _is_whole(end) for end in (param.low, param.high, param.step)):
        return _int_slider(name, value, param)
    return _float_slider(name, value, param)


def grouped(cg: CompGraph, controls: Mapping[str, Control]) -> tuple[ipywidgets.Widget, dict[str, Any]]:
    """Return the controls in a column, under the name of the function that takes them first, and the headings."""
    headings: dict[str, Any] = {}
    rows: list[ipywidgets.Widget] = []
    left = dict(controls)
    for function, inputs in cg.digraph.inputs.items():
        own = [left.pop(token) for token in dict.fromkeys(inputs) if token in left]
        if own:
            headings[function] = ipywidgets.Label(function)
            headings[function].add_class("epypes-function")
            rows += [headings[function], *(entry.widget for entry in own)]
    column = ipywidgets.VBox(rows)
    column.add_class("epypes-controls")
    return column, headings


class _Snapping:
    """A slider that shows the nearest step, while the value that it was given counts to the last bit.

    The front end snaps a slider to its steps as soon as it is shown, and reports that like a move of the hand. So the
    first position within half a step of the given value means that value; any other is the hand's.
    """

    def __init__(self, slider: Any, value: Any, step: float, kind: Callable[[Any], Any]) -> None:
        self._slider, self._exact, self._step, self._kind = slider, value, step, kind
        self._snapped: float | None = None

    def read(self) -> Any:
        position = self._slider.value
        if position == self._exact:
            return self._exact
        distance = abs(self._scaled(position) - self._scaled(self._exact))
        if self._snapped is None and distance <= self._step / 2 * (1 + 1e-9):
            self._snapped = position
        return self._exact if position == self._snapped else self._kind(position)

    def place(self, new: Any) -> None:
        self._exact, self._snapped = new, None
        self._stretch(self._scaled(new))
        self._slider.value = new

    def _scaled(self, value: Any) -> float:
        return float(value)

    def _stretch(self, place: Any) -> None:
        """Only the soft range is offered at first; code may go to the ends of the hard one."""
        self._slider.min, self._slider.max = min(self._slider.min, place), max(self._slider.max, place)


class _IntSnapping(_Snapping):
    def place(self, new: Any) -> None:
        if new != int(new):
            raise ValueError(f"This takes whole numbers, not {new!r}.")
        super().place(int(new))

    def _stretch(self, place: Any) -> None:
        super()._stretch(int(place))


class _LogSnapping(_Snapping):
    def _scaled(self, value: Any) -> float:
        return math.log10(value)


def _without_noise(value: float) -> float:
    """Return what a hand on a slider means: 0.3, where adding up steps gives 0.30000000000000004."""
    return float(f"{value:.12g}")


def _int_slider(name: str, value: Any, param: Param) -> Control:
    low, high = (int(end) for end in _shown_ends(param, value))
    step = int(param.step or 1)
    if param.odd:
        low, high = low + (low % 2 == 0), high - (high % 2 == 0)
        step += step % 2
    slider = (OddSlider if param.odd else ipywidgets.IntSlider)(
        value=int(value), min=low, max=high, step=step, continuous_update=True, **_labelled(name, param)
    )
    snapping = _IntSnapping(slider, int(value), step, int)
    return Control(name, param, slider, "value", snapping.read, snapping.place)


def _float_slider(name: str, value: Any, param: Param) -> Control:
    low, high = _shown_ends(param, value)
    step = param.step or _nice_step(high - low)
    slider = ipywidgets.FloatSlider(
        value=float(value),
        min=low,
        max=high,
        step=step,
        readout_format=f".{max(0, -math.floor(math.log10(step)))}f",
        continuous_update=True,
        **_labelled(name, param),
    )
    snapping = _Snapping(slider, value, step, _without_noise)
    return Control(name, param, slider, "value", snapping.read, snapping.place)


def _log_slider(name: str, value: Any, param: Param) -> Control:
    low, high = _shown_ends(param, value)
    step = max(math.log10(high / low) / 200, 1e-3)
    slider = ipywidgets.FloatLogSlider(
        value=float(value),
        base=10,
        min=math.log10(low),
        max=math.log10(high),
        step=step,
        readout_format=".3g",
        continuous_update=True,
        **_labelled(name, param),
    )
    snapping = _LogSnapping(slider, value, step, round if _is_integer(value) else _without_noise)
    return Control(name, param, slider, "value", snapping.read, snapping.place)


def _dropdown(name: str, value: Any, param: Param) -> Control:
    choices = param.choices or ()
    # By index: ipywidgets takes a choice of None for "nothing chosen", and 1 for True.
    names = param.labels or [choice.name if isinstance(choice, enum.Enum) else str(choice) for choice in choices]
    box = ipywidgets.Dropdown(options=names, index=choices.index(value), **_labelled(name, param))

    def place(new: Any) -> None:
        box.index = choices.index(new)

    return Control(name, param, box, "index", lambda: choices[box.index], place)


def _checkbox(name: str, value: Any, param: Param) -> Control:
    box = ipywidgets.Checkbox(value=bool(value), **_labelled(name, param))

    def place(new: Any) -> None:
        box.value = bool(new)

    return Control(name, param, box, "value", lambda: box.value, place)


def _label(name: str, value: Any) -> Control:
    label = ipywidgets.Label(value=reprlib.repr(value), **_labelled(name, None))
    label.add_class("epypes-read-only")
    shown = [value]

    def place(new: Any) -> None:
        shown[0] = new
        label.value = reprlib.repr(new)

    return Control(name, None, label, "value", lambda: shown[0], place)


def _labelled(name: str, param: Param | None) -> dict[str, Any]:
    unit = f" [{param.unit}]" if param is not None and param.unit else ""
    said = f"{name}{unit}: {described(param)}" if param is not None else f"{name}: shown only"
    return {"description": f"{name}{unit}", "tooltip": said, "layout": dict(_WIDE), "style": dict(_STYLE)}


def _shown_ends(param: Param, value: Any) -> tuple[float, float]:
    low, high = param.soft or (param.low, param.high)
    if low is None or high is None:
        raise ValueError(f"A slider needs a range with two ends, not {described(param)}.")
    return min(low, value), max(high, value)


def _nice_step(span: float) -> float:
    """Return a power of ten that divides a span in 100 to 1,000 steps."""
    return float(10.0 ** math.floor(math.log10(span / 100))) if span > 0 else 0.1


def _is_integer(value: Any) -> bool:
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def _is_whole(number: Any) -> bool:
    # 0.0 is a float on purpose: whoever writes (0.0, 1.0) means the values between.
    return isinstance(number, numbers.Integral)
