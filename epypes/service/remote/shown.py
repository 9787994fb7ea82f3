"""How does a connection to a service look in a notebook?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from epypes.display.markup import content
from epypes.display.mime import html_and_svg
from epypes.display.paint.page import paint_page
from epypes.display.paint.rows import Table
from epypes.display.paint.tables import paint_table
from epypes.display.views.graphview import GraphView

_DIGEST_CHARACTERS = 12


def painted(url: str, info: Mapping[str, Any], graph: GraphView | None) -> dict[str, str]:
    """Return the graph of a service as it was last seen, for a page, with its state and its addresses below it."""
    table = paint_table(Table("", ("", ""), _rows(url, info), 2))
    below = f"<p>{content(_sentence(info))}</p>{table}"
    return {"text/html": paint_page(below)} if graph is None else html_and_svg(graph, below)


def _sentence(info: Mapping[str, Any]) -> str:
    """Return the state in words."""
    reason = str(info.get("reason") or "")
    return f"{info['name']} is {info['state']}{f': {reason}' if reason else '.'}"


def _rows(url: str, info: Mapping[str, Any]) -> list[tuple[str, ...]]:
    addresses = info.get("addresses")
    told = {"http": url, **(addresses if isinstance(addresses, Mapping) else {})}
    return [
        *((name, str(address)) for name, address in told.items() if address),
        ("bundle", str(info.get("bundle", ""))),
        ("digest", str(info["digest"])[:_DIGEST_CHARACTERS]),
        ("revision", str(info.get("revision", 0))),
        ("restarts", str(info.get("restarts", 0))),
    ]
