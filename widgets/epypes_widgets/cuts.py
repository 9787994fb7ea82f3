"""Which hyperparameters have to do with which picture?"""

from __future__ import annotations

from epypes.graph import CompGraph
from epypes.hints import Param
from epypes_widgets.hand import Hand


def cuts_of(hand: Hand) -> dict[str, list[str]]:
    """Return the hyperparameters that are thresholds, by the token that they cut."""
    cuts: dict[str, list[str]] = {}
    for name, param in hand.params.items():
        if isinstance(param, Param) and param.cuts:
            cuts.setdefault(param.cuts, []).append(name)
    return cuts


def made_from(cg: CompGraph, token: str) -> list[str]:
    """Return the tokens that a token has to do with: on a picture that it has cut out, it means something else."""
    found = {token}
    for function in cg.functions:
        if found.intersection(cg.func_inputs(function)):
            found.update(cg.func_outputs(function))
    return sorted(found)
