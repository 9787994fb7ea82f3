"""How a graph, a run and a value look, as static SVG, HTML and text."""

from __future__ import annotations
