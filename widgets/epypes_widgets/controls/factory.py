"""The control that each hyperparameter of a runner gets."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from ipywidgets.widgets.widget_int import SliderStyle
from ipywidgets.widgets.widget_string import HTMLStyle, TextStyle

from epypes.graph import CompGraph
from epypes.hints import Param, Text
from epypes_widgets.controls.control import (
    Appearance,
    ChoiceControl,
    Control,
    LineControl,
    RangeControl,
    SliderControl,
    TextControl,
    choice_index,
    is_short_text,
)
from epypes_widgets.controls.scale import Scale, scale
from epypes_widgets.ranges import Range, ranges
from epypes_widgets.session import Tunable
from epypes_widgets.tooltips import tooltip


def controls(runner: Tunable, hints: Mapping[str, Any]) -> tuple[Control, ...]:
    """Return the controls of a runner's hyperparameters, in graph order; a pair stands where its first token does.

    Raises
    ------
    UnknownName, TypeError, ValueError
        A hint is for no hyperparameter, can't be read, or does not fit: see ``ranges``.
    """
    cg, values, first = runner.cg, runner.hyperparameters, runner.first_hyperparameters
    params = ranges(runner, hints)
    pairs = {scale.name: pair for pair in _pairs(params, values) for scale in pair}
    appearance = Appearance()
    made: dict[str, Control] = {}
    for token, param in params.items():
        if token in made:
            continue
        if token not in pairs:
            made[token] = _single(cg, token, values[token], param, first.get(token), appearance)
            continue
        low, high = pair = pairs[token]
        text = "\n".join(f"{scale.name}: {tooltip(cg, scale.name, scale.param)}" for scale in pair)
        given = values[low.name], values[high.name]
        firsts = first.get(low.name), first.get(high.name)
        control = RangeControl(pair, given, firsts, appearance.of((low.name, high.name), text, SliderStyle))
        made[low.name] = made[high.name] = control
    return tuple(dict.fromkeys(made.values()))


def _pairs(params: Mapping[str, Range], values: Mapping[str, Any]) -> Iterator[tuple[Scale, Scale]]:
    """Yield the scales of two tokens that one slider moves, the lower one first."""
    for token, param in params.items():
        above = params.get(param.below) if isinstance(param, Param) else None
        if not isinstance(param, Param) or not isinstance(above, Param):
            continue
        low, high = scale(token, values[token], param), scale(param.below, values[param.below], above)
        if low is not None and high is not None and not param.log and not above.log:
            yield low, high


def _single(cg: CompGraph, token: str, value: Any, param: Range, first: Any, appearance: Appearance) -> Control:
    text = tooltip(cg, token, param)
    if isinstance(param, Text) and is_short_text(value):
        return TextControl(token, value, param, first, appearance.of((token,), text, TextStyle))
    if isinstance(param, Param) and param.choices is not None and choice_index(param.choices, value) is not None:
        return ChoiceControl(token, value, param, first, appearance, text)
    along = scale(token, value, param) if isinstance(param, Param) else None
    if along is not None:
        return SliderControl(along, value, first, appearance.of((token,), text, SliderStyle))
    return LineControl(token, value, param, first, appearance.of((token,), text, HTMLStyle))
