"""On which thread of the kernel is what the front end says handled?

JupyterLab names one that no cell runs on (a subshell) in every message of a widget. Since ipykernel 7.4 a widget that
has spoken overrules that: what the front end answers is handled where the widget last spoke, which for one that a cell
has made is the thread of the cells, and so waits until they have ended.
"""

from __future__ import annotations

from typing import Any

import ipywidgets


def listen_beside_cells(widget: ipywidgets.Widget) -> None:
    """Have what is said to a widget, and to all inside it, handled on the thread that the front end names."""
    comm = widget.comm
    if comm is not None:
        # Where an ipykernel does not know this name, it goes by what the front end says anyway.
        comm._reply_subshell_for = _as_named
    for child in getattr(widget, "children", ()):
        listen_beside_cells(child)


def _as_named(_data: Any, named: str | None) -> str | None:
    return named
