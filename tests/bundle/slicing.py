"""How does a test slice the functions of a graph?"""

from __future__ import annotations

from epypes.bundle.slicer import Slice, slice_functions


def slice_graph(functions):
    """Return what the module needs, and by function of the graph the expression that refers to it."""
    gathered = Slice()
    references = slice_functions(gathered, [(f"Function {name!r}", function) for name, function in functions.items()])
    return gathered, dict(zip(functions, references, strict=True))
