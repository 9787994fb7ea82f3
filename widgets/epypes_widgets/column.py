"""The controls below each other, in one folder per function, and what the page has to know of each."""

from __future__ import annotations

import html
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import ipywidgets
from ipywidgets.widgets.widget_string import HTMLStyle, TextStyle

from epypes.graph import CompGraph
from epypes.hints import Param
from epypes_widgets.controls import Control
from epypes_widgets.values import is_number, json_value, sendable


@dataclass(frozen=True, slots=True)
class Column:
    """All controls, in one folder per function.

    Attributes
    ----------
    widget
        What is seen: a filter box, then the folders.
    rows
        What the page has to know of each control, ready for JSON.
    folders
        The same of each folder.
    """

    widget: Any = field(repr=False)
    rows: tuple[dict[str, Any], ...]
    folders: tuple[dict[str, Any], ...]


def column(cg: CompGraph, controls: Iterable[Control]) -> Column:
    """Return controls in a column, each under the name of the function that takes its first token first."""
    # One layout and one style for all: each would be a model of its own in the browser.
    layout, heading_style = ipywidgets.Layout(), HTMLStyle()
    text = "Show only hyperparameters with these letters in their name, function or tooltip"
    search = {"placeholder": "Filter", "tooltip": text, "continuous_update": False, "style": TextStyle()}
    boxes: list[Any] = [ipywidgets.Text(**search, layout=layout, _dom_classes=("epypes-filter",))]
    rows: list[dict[str, Any]] = []
    folders: list[dict[str, Any]] = []
    for function, own in _by_function(cg, controls):
        value = f'<span class="epypes-name">{html.escape(sendable(function))}</span> <span class="epypes-time"></span>'
        heading = ipywidgets.HTML(value, layout=layout, style=heading_style, _dom_classes=("epypes-heading",))
        inside: list[Any] = [heading]
        for control in own:
            css = f"epypes-row-{len(rows)}"
            inside.append(ipywidgets.Box([control.widget], layout=layout, _dom_classes=("epypes-row", css)))
            rows.append(_row(control, css, function))
        css = f"epypes-folder-{len(folders)}"
        boxes.append(ipywidgets.VBox(inside, layout=layout, _dom_classes=("epypes-folder", css)))
        folders.append({"css": css, "function": function})
    widget = ipywidgets.VBox(boxes, layout=layout, _dom_classes=("epypes-controls",))
    return Column(widget, tuple(rows), tuple(folders))


def _by_function(cg: CompGraph, controls: Iterable[Control]) -> Iterator[tuple[str, list[Control]]]:
    left = {control.names[0]: control for control in controls}
    for function, inputs in cg.digraph.inputs.items():
        inside = [name for name in left if name.startswith(f"{function}__") and name not in cg.tokens]
        own = [left.pop(token) for token in dict.fromkeys((*inputs, *inside)) if token in left]
        if own:
            yield function, own


def _row(control: Control, css: str, function: str) -> dict[str, Any]:
    ranges = [param if isinstance(param, Param) else Param() for param in control.params]
    is_movable = control.kind != "shown"
    return {
        "css": css,
        "names": list(control.names),
        "kind": control.kind,
        "function": function,
        "model": control.widget.model_id,
        "integer": control.integer,
        "odd": any(param.odd for param in ranges),
        "log": control.kind == "log",
        "low": [_end(param.low) for param in ranges],
        "high": [_end(param.high) for param in ranges],
        "step": list(control.steps) or [None] * len(ranges),
        "default": [json_value(value) if is_movable else None for value in control.first],
        "unit": ranges[0].unit,
        "tip": control.tip,
    }


def _end(end: Any) -> Any:
    return json_value(end) if is_number(end) else None
