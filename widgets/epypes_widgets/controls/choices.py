"""How is one of several values chosen?"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import ipywidgets
from ipywidgets.widgets.widget_bool import CheckboxStyle
from ipywidgets.widgets.widget_int import SliderStyle

from epypes.display.previews.short import short_repr
from epypes.hints import Param
from epypes_widgets.controls.control import Control
from epypes_widgets.controls.kinds import is_same, is_truth, kept_type, like
from epypes_widgets.controls.look import Look, sendable
from epypes_widgets.controls.scale import refused


class _Chosen:
    """A widget that shows one of several values, by its index.

    By index, since ipywidgets takes a choice of None for "nothing chosen", and 1 for True.
    """

    def __init__(self, name: str, param: Param, value: Any, widget: Any, trait: str) -> None:
        self._name, self._param, self._widget, self._trait = name, param, widget, trait
        self._choices = param.choices or ()
        self._like = like(value) if kept_type(value) else None
        self._exact, self._index = value, getattr(widget, trait)

    def read(self) -> dict[str, Any]:
        index = getattr(self._widget, self._trait)
        if index is not None and index != self._index:
            self._index, self._exact = index, self._typed(self._choices[index])
        return {self._name: self._exact}

    def checked(self, values: Mapping[str, Any]) -> dict[str, Any]:
        return {name: self._one(value) for name, value in values.items()}

    def place(self, values: Mapping[str, Any]) -> None:
        for value in values.values():
            self._exact, self._index = value, index_of(self._choices, value)
            setattr(self._widget, self._trait, self._index)

    def _one(self, value: Any) -> Any:
        index = index_of(self._choices, value)
        if index is None:
            raise refused(self._name, value, self._param)
        return self._typed(self._choices[index])

    def _typed(self, choice: Any) -> Any:
        """Return a choice; as a scalar of NumPy where the value was one and the choice is the same number as such."""
        if self._like is None or not isinstance(choice, bool | int | float | str):
            return choice
        try:
            typed = self._like(choice)
        except (OverflowError, ValueError):
            return choice
        return typed if typed == choice else choice


def choice(name: str, value: Any, param: Param, first: Any, look: Look, tip: str) -> Control | None:
    """Return a checkbox for False and True, else a drop-down; None if the value is not among the choices."""
    choices = param.choices or ()
    index = index_of(choices, value)
    if index is None:
        return None
    if all(map(is_truth, choices)) and sorted(choices) == [False, True]:
        box = ipywidgets.Checkbox(value=bool(value), **look.words((name,), tip, CheckboxStyle))
        mechanism = _Chosen(name, replace(param, choices=(False, True)), value, box, "value")
        return Control((name,), "check", (param,), box, mechanism, first=(first,))
    labels = param.labels or tuple(map(label, choices))
    # The style of sliders has all that a drop-down's has, so it can be shared.
    words = look.words((name,), tip, SliderStyle)
    box = ipywidgets.Dropdown(options=[sendable(text) for text in labels], index=index, **words)
    return Control((name,), "choice", (param,), box, _Chosen(name, param, value, box, "index"), "index", (first,))


def label(choice: Any) -> str:
    """Return how a choice is called if nobody has given it a name."""
    if isinstance(choice, enum.Enum):
        return choice.name
    return choice if isinstance(choice, str) and choice.strip() else short_repr(choice)


def index_of(choices: tuple[Any, ...], value: Any) -> int | None:
    """Return the place of a value: of the same one, else of the first that equals it; None if there is none."""
    same = next((index for index, choice in enumerate(choices) if is_same(choice, value)), None)
    if same is not None:
        return same
    return next((index for index, choice in enumerate(choices) if _equals(choice, value)), None)


def _equals(choice: Any, value: Any) -> bool:
    try:
        return is_truth(choice) == is_truth(value) and bool(choice == value)
    except Exception:  # an array, or a class of one's own: it is another value
        return False
