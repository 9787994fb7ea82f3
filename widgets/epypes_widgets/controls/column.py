"""The controls below each other, in folders by function, and what the page has to know of each."""

from __future__ import annotations

import html
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import ipywidgets
from ipywidgets.widgets.widget_string import HTMLStyle, TextStyle

from epypes.graph import CompGraph
from epypes.hints import Param
from epypes_widgets.controls.control import Control
from epypes_widgets.values import is_number, json_value, sendable


@dataclass(frozen=True, slots=True)
class Column:
    """All controls, in folders by function: those that several functions take have a folder of their own.

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
    """Return controls in a column, each under the names of the functions that take its first token."""
    # One layout and one style for all: each would be a model of its own in the browser.
    layout, heading_style = ipywidgets.Layout(), HTMLStyle()
    text = "Show only hyperparameters with these letters in their name, function or tooltip"
    search = {"placeholder": "Filter", "tooltip": text, "continuous_update": False, "style": TextStyle()}
    filter_box = ipywidgets.Text(**search, layout=layout, _dom_classes=("epypes-filter",))
    boxes: list[Any] = []
    rows: list[dict[str, Any]] = []
    folders: list[dict[str, Any]] = []
    for functions, own in _by_functions(cg, controls):
        name = f"shared: {', '.join(functions)}" if len(functions) > 1 else functions[0]
        value = f'<span class="epypes-name">{html.escape(sendable(name))}</span> <span class="epypes-time"></span>'
        heading = ipywidgets.HTML(value, layout=layout, style=heading_style, _dom_classes=("epypes-heading",))
        inside: list[Any] = [heading]
        for control in own:
            css = f"epypes-row-{len(rows)}"
            inside.append(ipywidgets.Box([control.widget], layout=layout, _dom_classes=("epypes-row", css)))
            rows.append(_row(control, css, functions))
        css = f"epypes-folder-{len(folders)}"
        boxes.append(ipywidgets.VBox(inside, layout=layout, _dom_classes=("epypes-folder", css)))
        folders.append({"css": css, "functions": list(functions)})
    # Folders in columns, within what scrolls.
    inner = ipywidgets.VBox(boxes, layout=layout, _dom_classes=("epypes-folders",))
    widget = ipywidgets.VBox([filter_box, inner], layout=layout, _dom_classes=("epypes-controls",))
    return Column(widget, tuple(rows), tuple(folders))


def _by_functions(cg: CompGraph, controls: Iterable[Control]) -> Iterator[tuple[tuple[str, ...], list[Control]]]:
    """Yield controls by the functions that take them, in run order of the first; its own come before shared ones."""
    folders: dict[tuple[str, ...], list[Control]] = {}
    for control in controls:
        folders.setdefault(_takers(cg, control.names[0]), []).append(control)
    places = {function: place for place, function in enumerate(cg.functions)}
    # Those of a camera come first, as it does.
    yield from sorted(folders.items(), key=lambda folder: (places.get(folder[0][0], -1), len(folder[0])))


def _takers(cg: CompGraph, name: str) -> tuple[str, ...]:
    """Return the functions that take a hyperparameter; of one inside a pipeline, the pipeline; else the camera."""
    inside = [function for function in cg.functions if name.startswith(f"{function}__")] or ["camera"]
    return tuple(dict.fromkeys(cg.digraph.consumers.get(name, inside[:1])))


def _row(control: Control, css: str, functions: tuple[str, ...]) -> dict[str, Any]:
    ranges = [param if isinstance(param, Param) else Param() for param in control.params]
    is_movable = control.kind != "shown"
    return {
        "css": css,
        "names": list(control.names),
        "kind": control.kind,
        "functions": list(functions),
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
