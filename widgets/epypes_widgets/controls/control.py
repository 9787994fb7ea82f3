"""Controls: one or two hyperparameters and the ipywidgets widget that moves or shows them.

A control keeps a value to the last bit, and in its type: the widget shows the nearest that it can. Moved numbers and
texts of NumPy keep their type, since code that runs on ``uint8`` would do something else on ``int``.
"""

from __future__ import annotations

import enum
import html
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final

import ipywidgets
from ipywidgets.widgets.widget_bool import CheckboxStyle
from ipywidgets.widgets.widget_int import SliderStyle
from ipywidgets.widgets.widget_string import HTMLStyle, TextStyle

from epypes.display.previews.short import short_repr
from epypes.errors import InvalidValue, UnknownName
from epypes.graph import CompGraph, inside_of
from epypes.hints import Param, Roi, Text
from epypes_widgets.controls.ranges import Range, allows, ranges
from epypes_widgets.controls.scale import Scale, exponent, refused, same_type, scale_of
from epypes_widgets.controls.tooltips import tooltip
from epypes_widgets.values import is_same, is_truth, numpy_type, sendable

if TYPE_CHECKING:
    from epypes_widgets.session import Tunable

# A longer text is a document, not a parameter: it would travel with every message about its box.
_MAX_TEXT: Final = 2_000
_DESCRIPTION_WIDTH: Final = "42%"


class _Quiet(ipywidgets.Widget):
    """A slider that does not send its value back to the front end.

    ipywidgets does, for other views of the same kernel. That message would arrive right before the picture.
    """

    def trait_metadata(self, traitname: str, key: str, default: Any = None) -> Any:
        return False if key == "echo_update" else super().trait_metadata(traitname, key, default)


class _IntSlider(_Quiet, ipywidgets.IntSlider): ...


class _FloatSlider(_Quiet, ipywidgets.FloatSlider): ...


class _LogSlider(_Quiet, ipywidgets.FloatLogSlider): ...


class _IntRange(_Quiet, ipywidgets.IntRangeSlider): ...


class _FloatRange(_Quiet, ipywidgets.FloatRangeSlider): ...


class Appearance:
    """The layout and the styles of the controls of a panel: one of each, since each is a model in the browser."""

    def __init__(self, cg: CompGraph) -> None:
        self._cg, self._layout = cg, ipywidgets.Layout(width="100%")
        self._styles: dict[type, Any] = {}

    def of(self, names: tuple[str, ...], tooltip: str, style: type) -> dict[str, Any]:
        """Return what the constructor of a widget is given: name, tooltip, layout and style."""
        if style not in self._styles:
            self._styles[style] = style(description_width=_DESCRIPTION_WIDTH)
        text = {"description": " .. ".join(map(self._label, names)), "tooltip": tooltip}
        return {**text, "layout": self._layout, "style": self._styles[style]}

    def _label(self, name: str) -> str:
        """Return a name as it stands in its folder, which is that of a pipeline for what is inside."""
        if inside_of(self._cg, name)[0] is self._cg:
            return name
        prefixes = [f"{function}__" for function in self._cg.functions if name.startswith(f"{function}__")]
        return name.removeprefix(prefixes[0]) if prefixes else name


class Control:
    """One or two hyperparameters on screen; its methods may be called from any thread.

    A subclass connects the values by token with its widget.

    Attributes
    ----------
    names
        The tokens: one, or two for a range pair, the lower one first.
    params
        The values that each may take; None for anything.
    widget
        What is seen.
    first
        The values that the hyperparameters had when they were made.
    kind
        ``"slider"``, ``"range"``, ``"log"``, ``"choice"``, ``"check"``, ``"text"``, ``"roi"``, or ``"shown"`` for what
        can't be moved on screen.
    integer
        Whether all values are whole numbers.
    steps
        The distances between two values; None where there is none. On a logarithmic slider of exponents of ten.
    tip
        What is known of its hyperparameters, a line each.
    """

    integer = False
    steps: tuple[float | None, ...] = ()
    tip = ""
    # The trait of the widget that the user moves.
    _trait = "value"

    def __init__(
        self, names: tuple[str, ...], params: tuple[Range, ...], widget: Any, first: tuple[Any, ...], kind: str
    ) -> None:
        self.names, self.params, self.widget, self.first, self.kind = names, params, widget, first, kind
        # Held for moments only, and never while listeners are called, which may hold locks of their own.
        self._lock = threading.RLock()
        self._is_writing = False
        self._listeners: list[Callable[[Mapping[str, Any]], None]] = []
        self._reported = self._read()
        widget.observe(self._moved, names=self._trait)

    def read(self) -> dict[str, Any]:
        """Return the values by token, to the last bit."""
        with self._lock:
            return self._read()

    def check(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return values of some or all of the tokens as the hyperparameters take them.

        Raises
        ------
        UnknownName
            A token is not of this control.
        ValueError
            A token can't have its value.
        """
        for name in values:
            if name not in self.names:
                raise UnknownName("hyperparameter", name, self.names, "of this control")
        with self._lock:
            return self._checked(values)

    def write(self, values: Mapping[str, Any], *, is_return: bool = False) -> None:
        """Move to values of some or all of the tokens, without a call of the listeners; errors as ``check``.

        A slider whose range does not hold a value is widened, and stays so until it returns to an earlier value: its
        range is then the first one, as far as that holds the value.
        """
        with self._lock:
            checked = self.check(values)
            # A move by the user on another thread waits for the lock, and then differs from what was written.
            self._reported = {**self._reported, **checked}
            self._is_writing = True
            try:
                self._place(checked)
                if is_return:
                    self._narrow()
            finally:
                self._is_writing = False

    def on_change(self, callback: Callable[[Mapping[str, Any]], None]) -> None:
        """Call ``callback(values)`` with the tokens that the user has moved, on the thread that handles its messages.

        A widget that was only shown, and has snapped to its steps, was not moved.
        """
        self._listeners.append(callback)

    def _moved(self, _change: object) -> None:
        with self._lock:
            if self._is_writing:
                return
            values = self._read()
            moved = {name: value for name, value in values.items() if not is_same(self._reported[name], value)}
            self._reported = values
        if moved:
            for callback in self._listeners:
                callback(moved)

    def _read(self) -> dict[str, Any]:
        raise NotImplementedError

    def _checked(self, values: Mapping[str, Any]) -> dict[str, Any]:
        raise NotImplementedError

    def _place(self, values: Mapping[str, Any]) -> None:
        raise NotImplementedError

    def _narrow(self) -> None:
        """Offer no wider a range than at first, but for the present value."""


class SingleControl(Control):
    """One hyperparameter: the value that was put counts to the last bit, until the user moves the widget.

    A subclass has ``_check`` for a value, ``_shown_for`` for what the widget shows of it, and ``_meant`` for what the
    user means by another thing that it shows.
    """

    def __init__(self, name: str, param: Range, widget: Any, value: Any, first: Any, kind: str) -> None:
        self._exact, self._shown = value, getattr(widget, self._trait)
        super().__init__((name,), (param,), widget, (first,), kind)

    def _read(self) -> dict[str, Any]:
        shown = getattr(self.widget, self._trait)
        return {self.names[0]: self._exact if shown == self._shown else self._meant(shown)}

    def _checked(self, values: Mapping[str, Any]) -> dict[str, Any]:
        return {name: self._check(value) for name, value in values.items()}

    def _place(self, values: Mapping[str, Any]) -> None:
        for value in values.values():
            # First: a user that moves the widget at this very moment, on another thread, means a value of its own.
            self._exact, self._shown = value, self._shown_for(value)
            setattr(self.widget, self._trait, self._shown)

    def _check(self, value: Any) -> Any:
        raise NotImplementedError

    def _shown_for(self, value: Any) -> Any:
        raise NotImplementedError

    def _meant(self, shown: Any) -> Any:
        return self._exact


# -- sliders --------------------------------------------------------------------------------------------------------


class _Snap:
    """A position of a slider, and the value that was put there, which counts to the last bit.

    The front end snaps a slider to its steps as soon as it is shown and reports that like a move. So the first position
    within half a step of the given value means that value; any other is the user's.
    """

    def __init__(self, scale: Scale, step: float) -> None:
        self._scale, self._step = scale, step
        self._exact: Any = None
        self._placed: float | None = None
        self._snapped: float | None = None

    def put(self, value: Any, place: float) -> None:
        """Take a value, and the position at which the slider stands for it."""
        self._exact, self._placed, self._snapped = value, place, None

    def read(self, place: float) -> Any:
        """Return the value that is meant by a position."""
        if place == self._placed:
            return self._exact
        distance = abs(self._scale.along(place) - self._scale.along(self._exact))
        if self._snapped is None and distance <= self._step / 2 * (1 + 1e-9):
            self._snapped = place
        return self._exact if place == self._snapped else self._scale.meant(place)


class SliderControl(SingleControl):
    """A slider of whole numbers, of floats, or of exponents."""

    def __init__(self, scale: Scale, value: Any, first: Any, appearance: Mapping[str, Any]) -> None:
        common = {"step": scale.step, "readout": False, "continuous_update": False, **appearance}
        widget: Any
        if scale.param.log:
            low, high = exponent(min(scale.low, value)), exponent(max(scale.high, value))
            widget = _LogSlider(value=float(value), base=10, min=low, max=high, **common)
        else:
            slider = _IntSlider if scale.integer else _FloatSlider
            widget = slider(value=scale.place(value), min=scale.low, max=scale.high, **common)
        self._scale, self._snap = scale, _Snap(scale, scale.step)
        self._first_ends = widget.min, widget.max
        self._snap.put(value, widget.value)
        self.integer, self.steps = scale.integer, (scale.step,)
        super().__init__(scale.name, scale.param, widget, value, first, "log" if scale.param.log else "slider")

    def _meant(self, shown: Any) -> Any:
        return self._snap.read(shown)

    def _check(self, value: Any) -> Any:
        return self._scale.checked(value)

    def _shown_for(self, value: Any) -> Any:
        slider = self.widget
        # Only the soft range is offered at first; code may go to the ends of the hard one.
        slider.min, slider.max = self._scale.grown(slider.min, slider.max, value)
        place = self._scale.place(value)
        if self._scale.param.log:  # a slider of exponents clamps to what its ends come to
            place = min(max(place, 10.0**slider.min), 10.0**slider.max)
        self._snap.put(value, place)
        return place

    def _narrow(self) -> None:
        low, high = self._first_ends
        self.widget.min, self.widget.max = self._scale.grown(low, high, self._read()[self.names[0]])


class RangeControl(Control):
    """A slider with two handles for two hyperparameters; the lower value never exceeds the upper one."""

    def __init__(
        self,
        scales: tuple[Scale, Scale],
        values: tuple[Any, ...],
        first: tuple[Any, ...],
        appearance: Mapping[str, Any],
    ) -> None:
        low, high = self._scales = scales
        self.integer, self.steps = low.integer and high.integer, (low.step, high.step)
        slider = _IntRange if self.integer else _FloatRange
        ends = {"min": min(low.low, high.low), "max": max(low.high, high.high), "step": min(low.step, high.step)}
        places = low.place(values[0]), high.place(values[1])
        self._slider = slider(value=places, **ends, readout=False, continuous_update=False, **appearance)
        self._first_ends = self._slider.min, self._slider.max
        self._snaps = _Snap(low, self._slider.step), _Snap(high, self._slider.step)
        self._places: tuple[float, ...] = ()
        self._settle(values, self._slider.value)
        super().__init__((low.name, high.name), (low.param, high.param), self._slider, first, "range")

    def _read(self) -> dict[str, Any]:
        places = self._slider.value
        if places != self._places:
            low, high = (snap.read(place) for snap, place in zip(self._snaps, places, strict=True))
            self._places, self._values = places, self._ordered(low, high)
        return {along.name: value for along, value in zip(self._scales, self._values, strict=True)}

    def _checked(self, values: Mapping[str, Any]) -> dict[str, Any]:
        found = {along.name: along.checked(values[along.name]) for along in self._scales if along.name in values}
        low, high = {**self._read(), **found}.values()
        if low > high:
            below, above = self.names
            name, value, never, other, bound = (
                (below, low, "above", above, high) if below in found else (above, high, "below", below, low)
            )
            text = (
                f"{name!r} can't be {short_repr(value)}: it is never {never} {other!r}, which is {short_repr(bound)}."
            )
            raise InvalidValue(f"{text} Set {other!r} first, or both at once.")
        return found

    def _place(self, values: Mapping[str, Any]) -> None:
        low, high = {**self._read(), **values}.values()
        slider = self._slider
        for scale, value in zip(self._scales, (low, high), strict=True):
            slider.min, slider.max = scale.grown(slider.min, slider.max, value)
        places = self._scales[0].place(low), self._scales[1].place(high)
        # First: a user that moves the slider at this very moment, on another thread, means positions of its own.
        self._settle((low, high), places)
        slider.value = places

    def _narrow(self) -> None:
        ends = self._first_ends
        for scale in self._scales:
            ends = scale.grown(*ends, self._read()[scale.name])
        self._slider.min, self._slider.max = ends

    def _settle(self, values: tuple[Any, Any], places: tuple[float, float]) -> None:
        self._values, self._places = values, places
        for snap, value, place in zip(self._snaps, values, places, strict=True):
            snap.put(value, place)

    def _ordered(self, low: Any, high: Any) -> tuple[Any, Any]:
        """Return values in order: what was moved gives way to what was not.

        The handles are always in order. Their values need not be: each has a range, a type and exact values of its own.
        """
        low_before, high_before = self._values
        if low <= high:
            return low, high
        if is_same(high, high_before):
            low = self._scales[0].meant(high)
            return (low if low <= high else low_before), high
        high = self._scales[1].meant(low)
        if low <= high:
            return low, high
        return (low if low <= high_before else low_before), high_before


# -- choices, texts and what is only shown --------------------------------------------------------------------------


class ChoiceControl(SingleControl):
    """A checkbox for False and True, else a drop-down.

    The value is known by its index, since ipywidgets takes a choice of None for "nothing chosen", and 1 for True.
    """

    def __init__(self, name: str, value: Any, param: Param, first: Any, appearance: Appearance, tooltip: str) -> None:
        self._choices, self._numpy_type = param.choices or (), numpy_type(value)
        is_check = all(map(is_truth, self._choices)) and sorted(self._choices) == [False, True]
        if is_check:
            self._choices = (False, True)
            box: Any = ipywidgets.Checkbox(value=bool(value), **appearance.of((name,), tooltip, CheckboxStyle))
        else:
            self._trait = "index"
            labels = [sendable(text) for text in param.labels or map(_label, self._choices)]
            # The style of sliders has all that a drop-down's has, so it can be shared.
            style = appearance.of((name,), tooltip, SliderStyle)
            box = ipywidgets.Dropdown(options=labels, index=choice_index(self._choices, value), **style)
        super().__init__(name, param, box, value, first, "check" if is_check else "choice")

    def _meant(self, shown: Any) -> Any:
        return self._exact if shown is None else self._typed(self._choices[shown])

    def _check(self, value: Any) -> Any:
        index = choice_index(self._choices, value)
        if index is None:
            raise refused(self.names[0], value, self.params[0])
        return self._typed(self._choices[index])

    def _shown_for(self, value: Any) -> Any:
        return choice_index(self._choices, value)

    def _typed(self, choice: Any) -> Any:
        """Return a choice; as a scalar of NumPy where the value was one and the choice is the same number as such."""
        if self._numpy_type is None or not isinstance(choice, bool | int | float | str):
            return choice
        try:
            typed = self._numpy_type(choice)
        except (OverflowError, ValueError):
            return choice
        return typed if typed == choice else choice


def choice_index(choices: tuple[Any, ...], value: Any) -> int | None:
    """Return the index of a value: of the same one, else of the first that equals it; None if there is none."""
    same = next((index for index, choice in enumerate(choices) if is_same(choice, value)), None)
    if same is not None:
        return same
    return next((index for index, choice in enumerate(choices) if _equals(choice, value)), None)


def _equals(choice: Any, value: Any) -> bool:
    try:
        return is_truth(choice) == is_truth(value) and bool(choice == value)
    except Exception:  # an array, or a class of one's own: it is another value
        return False


def _label(choice: Any) -> str:
    if isinstance(choice, enum.Enum):
        return choice.name
    return choice if isinstance(choice, str) and choice.strip() else short_repr(choice)


class TextControl(SingleControl):
    """A box of text, which commits on Enter or when it is left."""

    def __init__(self, name: str, value: str, param: Text, first: Any, appearance: Mapping[str, Any]) -> None:
        # A box of one line drops the ends of lines as soon as the user types into it.
        kind = ipywidgets.Textarea if "\n" in value else ipywidgets.Text
        self._typed = same_type(value)
        box = kind(value=sendable(value), continuous_update=False, **appearance)
        super().__init__(name, param, box, value, first, "text")

    def _meant(self, shown: Any) -> Any:
        return self._typed(shown)

    def _check(self, value: Any) -> Any:
        if not isinstance(value, str):
            raise refused(self.names[0], value, Text())
        return self._typed(value)

    def _shown_for(self, value: Any) -> Any:
        return sendable(value)


class LineControl(SingleControl):
    """A line that shows a value as text: a rectangle, which is moved on the picture, or what only code can set."""

    def __init__(self, name: str, value: Any, param: Range, first: Any, appearance: Mapping[str, Any]) -> None:
        self.params = (param,)
        line = ipywidgets.HTML(value=self._shown_for(value), **appearance)
        line.add_class("epypes-read-only")
        super().__init__(name, param, line, value, first, "roi" if isinstance(param, Roi) else "shown")

    def _check(self, value: Any) -> Any:
        (param,) = self.params
        if param is None:
            return value
        if isinstance(param, Roi):
            if not allows(param, value):
                way_out = "Give (x, y, width, height) in whole pixels, none of them negative."
                raise InvalidValue(f"{self.names[0]!r} can't be {short_repr(value)}: it is a rectangle. {way_out}")
            return (list if isinstance(self._exact, list) else tuple)(map(int, value))
        if not allows(param, value):
            raise refused(self.names[0], value, param)
        return value

    def _shown_for(self, value: Any) -> Any:
        (param,) = self.params
        if isinstance(param, Roi) and allows(param, value):
            x, y, width, height = value
            return f"x {x}, y {y}, {width} x {height}"
        return html.escape(sendable(short_repr(value)))


# -- of a runner ------------------------------------------------------------------------------------------------------


def controls(
    runner: Tunable, hints: Mapping[str, Any], settings: Mapping[str, tuple[Any, Param]] | None = None
) -> tuple[Control, ...]:
    """Return the controls of a runner's hyperparameters, in graph order; a pair stands where its first token does.

    Those of the settings of a camera come first, each given by its value and what it may be.

    Raises
    ------
    UnknownName, TypeError, ValueError
        A hint is for no hyperparameter, can't be read, or does not fit: see ``ranges``.
    """
    settings = settings or {}
    values, first, params = runner.hyperparameters, runner.first_hyperparameters, ranges(runner, hints, settings)
    pairs = {along.name: pair for pair in _pairs(params, values) for along in pair}
    appearance = Appearance(runner.cg)
    made: dict[str, Control] = {}
    for name, (value, setting) in settings.items():
        made[name] = _single(name, value, setting, value, tooltip(runner.cg, name, setting), appearance)
        made[name].tip = tooltip(runner.cg, name, setting)
    for token, param in params.items():
        if token in made:
            continue
        names = tuple(along.name for along in pairs[token]) if token in pairs else (token,)
        tips = {name: tooltip(runner.cg, name, params[name]) for name in names}
        text = tips[token] if len(names) == 1 else "\n".join(f"{name}: {tip}" for name, tip in tips.items() if tip)
        if token in pairs:
            both, firsts = tuple(values[name] for name in names), tuple(first.get(name) for name in names)
            control: Control = RangeControl(pairs[token], both, firsts, appearance.of(names, text, SliderStyle))
        else:
            control = _single(token, values[token], param, first.get(token), text, appearance)
        control.tip = text
        made |= dict.fromkeys(names, control)
    return tuple(dict.fromkeys(made.values()))


def _pairs(params: Mapping[str, Range], values: Mapping[str, Any]) -> Iterator[tuple[Scale, Scale]]:
    """Yield the scales of two tokens that one slider moves, the lower one first."""
    for token, param in params.items():
        above = params.get(param.below) if isinstance(param, Param) else None
        if not isinstance(param, Param) or not isinstance(above, Param):
            continue
        low, high = scale_of(token, values[token], param), scale_of(param.below, values[param.below], above)
        if low is not None and high is not None and not param.log and not above.log:
            yield low, high


def _single(token: str, value: Any, param: Range, first: Any, tip: str, appearance: Appearance) -> Control:
    if isinstance(param, Text) and isinstance(value, str) and len(value) <= _MAX_TEXT:
        return TextControl(token, value, param, first, appearance.of((token,), tip, TextStyle))
    if isinstance(param, Param) and param.choices is not None and choice_index(param.choices, value) is not None:
        return ChoiceControl(token, value, param, first, appearance, tip)
    along = scale_of(token, value, param) if isinstance(param, Param) else None
    if along is not None:
        return SliderControl(along, value, first, appearance.of((token,), tip, SliderStyle))
    return LineControl(token, value, param, first, appearance.of((token,), tip, HTMLStyle))


# -- of a panel -------------------------------------------------------------------------------------------------------


class ControlSet:
    """The controls of a panel, and which of them the user holds; may be used from any thread.

    A control that is held is never moved by the kernel: a value for it waits until it is released.

    Parameters
    ----------
    controls
        In the order in which they are listed.
    """

    def __init__(self, controls: Iterable[Control]) -> None:
        self.controls = tuple(controls)
        self._widgets = {control.widget.model_id: control.widget for control in self.controls}
        self._by_name = {name: control for control in self.controls for name in control.names}
        self._lock = threading.RLock()
        self._held: set[str] = set()
        self._waiting: dict[str, Any] = {}
        self._contested: set[str] = set()

    @property
    def values(self) -> dict[str, Any]:
        """The values of all controls, by token."""
        return {name: value for control in self.controls for name, value in control.read().items()}

    @property
    def movable(self) -> dict[str, Any]:
        """The values of the controls that are not only shown, by token."""
        return {name: value for name, value in self.values.items() if self._by_name[name].kind != "shown"}

    @property
    def params(self) -> dict[str, Range]:
        """What each hyperparameter may be, by token."""
        return {n: param for control in self.controls for n, param in zip(control.names, control.params, strict=True)}

    @property
    def thresholds(self) -> dict[str, list[str]]:
        """The hyperparameters that are thresholds, by the token that they cut."""
        cuts: dict[str, list[str]] = {}
        for name, param in self.params.items():
            if isinstance(param, Param) and param.cuts:
                cuts.setdefault(param.cuts, []).append(name)
        return cuts

    @property
    def is_holding(self) -> bool:
        """Whether any control is held."""
        return bool(self._held)

    def control(self, name: str) -> Control:
        """Return the control of a token; UnknownName if there is none."""
        if name not in self._by_name:
            raise UnknownName("hyperparameter", name, self._by_name, "of this panel")
        return self._by_name[name]

    def set(self, values: Mapping[str, Any], *, by_user: bool = False, is_return: bool = False) -> dict[str, Any]:
        """Move controls to values that were set, all or none, and return them as the hyperparameters take them.

        A value for a control that is held waits, unless the user sets it, and is not returned. On the return to earlier
        values a slider that was widened gets its first range again.

        Raises
        ------
        UnknownName
            There is no such control.
        ValueError
            A value is outside of its range.
        """
        parts = self._parts(values)
        with self._lock:
            for control, own in parts.items():
                control.check(own)
            moved: dict[str, Any] = {}
            for control, own in parts.items():
                if self._is_held(control) and not by_user:
                    self._waiting.update(own)
                    continue
                control.write(own, is_return=is_return)
                moved |= {name: control.read()[name] for name in own}
            return moved

    def slide(self, places: Mapping[str, Any]) -> None:
        """Move sliders that are being dragged, by the id of their model, as if the front end had set their value."""
        for model, place in places.items():
            if model in self._widgets:
                self._widgets[model].set_state({"value": place})

    def follow(self, values: Mapping[str, Any], *, is_return: bool = False) -> list[str]:
        """Move controls to values of the runner; those that are held follow when they are released.

        ``is_return`` as for ``set``.

        Returns
        -------
        list of str
            A sentence for each value that its control can't show.
        """
        refused = []
        with self._lock:
            for control, own in self._parts({n: value for n, value in values.items() if n in self._by_name}).items():
                if self._is_held(control):
                    self._waiting.update(own)
                    continue
                try:
                    control.write(own, is_return=is_return)
                except ValueError as error:
                    refused.append(f"The control stays where it was: {error}")
        return refused

    def moved(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Take note of what the user has moved, and return what may be set of it.

        What waited for these controls is out of date. A contested value is not set: it waits for the release.
        """
        with self._lock:
            allowed = {name: value for name, value in values.items() if name not in self._contested}
            for name in allowed:
                self._waiting.pop(name, None)
            return allowed

    def contest(self, names: Iterable[str]) -> list[str]:
        """Take note of what others have set, and return which of it is held: it can be set after a release only."""
        with self._lock:
            held = [name for name in names if name in self._held]
            self._contested.update(held)
            return held

    def hold(self, names: Iterable[str]) -> None:
        """Take note that the user holds these controls."""
        with self._lock:
            self._held.update(name for name in names if name in self._by_name)

    def release(self) -> tuple[dict[str, Any], list[str]]:
        """Take note that nothing is held, and move the controls that had to wait.

        Returns
        -------
        dict
            The values that waited, by token.
        list of str
            Sentences as from ``follow``.
        """
        with self._lock:
            self._held.clear()
            self._contested.clear()
            waiting, self._waiting = self._waiting, {}
            return waiting, self.follow(waiting)

    def _is_held(self, control: Control) -> bool:
        return not self._held.isdisjoint(control.names)

    def _parts(self, values: Mapping[str, Any]) -> dict[Control, dict[str, Any]]:
        parts: dict[Control, dict[str, Any]] = {}
        for name, value in values.items():
            parts.setdefault(self.control(name), {})[name] = value
        return parts
