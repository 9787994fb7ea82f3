"""How does a test slice the functions of a graph?"""

from __future__ import annotations

import epypes as ep
from epypes.bundle.settings import Settings
from epypes.bundle.source.equivalence import refusal
from epypes.bundle.source.module import Graphs, emit_module
from epypes.bundle.source.slice import gather


def slice_graph(functions):
    """Return what the module needs, and by function of the graph the expression that refers to it.

    The module is executed and compared with the functions, as a promotion does.
    """
    cg = ep.CompGraph(functions, {name: ("x", f"{name}_made") for name in functions}, types=False)
    gathered, written = gather(lambda needed: Graphs(needed).write(cg))
    if not gathered.refusals:
        text = emit_module(Settings("case", ("x",), ("y",), {}), cg, gathered, written)
        why = refusal(text, lambda made: _pairs(functions, made))
        gathered.refusals += [why] if why else []
    return gathered, written


def _pairs(functions, module):
    return [(f"Function {name!r}", function, module.func_dict[name]) for name, function in functions.items()]
