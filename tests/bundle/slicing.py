"""How does a test slice the functions of a graph?"""

from __future__ import annotations

import epypes as ep
from epypes.bundle.emit import emit_module
from epypes.bundle.equivalence import refusal
from epypes.bundle.settings import Settings
from epypes.bundle.slice import Slice, slice_functions


def slice_graph(functions, uncalled=()):
    """Return what the module needs, and by function of the graph the expression that refers to it.

    The module is executed and compared with the functions, as a promotion does.
    """
    gathered = Slice(uncalled=uncalled)
    references = slice_functions(gathered, [(f"Function {name!r}", function) for name, function in functions.items()])
    written = dict(zip(functions, references, strict=True))
    if not gathered.refusals:
        cg = ep.CompGraph(functions, {name: ("x", f"{name}_made") for name in functions}, types=False)
        text = emit_module(Settings("case", ("x",), ("y",), {}), cg, gathered, written)
        why, closure = refusal(text, {}, lambda made: _pairs(functions, made), gathered.called)
        if closure:
            return slice_graph(functions, {*uncalled, closure})
        gathered.refusals += [why] if why else []
    return gathered, written


def _pairs(functions, module):
    return [(f"Function {name!r}", function, module.func_dict[name]) for name, function in functions.items()]
