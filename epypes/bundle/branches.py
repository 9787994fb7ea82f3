"""Which functions are written down, and inside which branch of a switch?

A function that only one branch needs stands inside it, so that it runs only when that branch is chosen. What several
branches need stands before the switch.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from dataclasses import dataclass, field
from typing import Final

from epypes.graph import CompGraph, as_switch

# Python itself can't indent deeper than 100; nobody can read half of that.
_DEEPEST: Final = 20


@dataclass(eq=False, slots=True)
class Region:
    """A place of functions: the graph itself, or a branch of a switch.

    Attributes
    ----------
    around
        The region in which the switch is; None for the graph.
    token
        The token that the branch passes on.
    keys
        The values of the selector that choose it.
    functions
        The functions that stand in it, in run order.
    """

    around: Region | None = None
    depth: int = 0
    token: str = ""
    keys: list[Hashable] = field(default_factory=list)
    functions: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Placement:
    """Where the functions of a graph stand.

    Attributes
    ----------
    root
        The graph itself.
    branches
        The regions of each switch that is written.
    functions
        All functions that are written, in run order.
    tokens
        The tokens that are made, read or wanted, in graph order.
    """

    root: Region
    branches: dict[str, list[Region]]
    functions: tuple[str, ...]
    tokens: tuple[str, ...]

    @property
    def is_too_deep(self) -> bool:
        """Whether switches stand in switches so often that nobody can read it."""
        return any(region.depth > _DEEPEST for regions in self.branches.values() for region in regions)


def place(cg: CompGraph, wanted: Iterable[str] | None) -> Placement:
    """Place what the wanted tokens need; without, all functions."""
    root = Region()
    used = dict.fromkeys(cg.sink_tokens if wanted is None else wanted, root)
    branches: dict[str, list[Region]] = {}
    switches = set(cg.switches)
    inside: dict[str, Region] = {}
    for name in reversed(tuple(cg.functions)):
        made = cg.func_outputs(name)
        regions = [used[token] for token in made if token in used]
        if not regions and (made or wanted is not None):
            continue
        inside[name] = region = _common(regions or [root])
        read = [(token, region) for token in cg.func_inputs(name)]
        if name in switches:
            branches[name] = _branches(cg, name, region)
            read = [read[0], *((branch.token, branch) for branch in branches[name])]
        for token, reader in read:
            used[token] = _common([used.get(token, reader), reader])
    functions = tuple(name for name in cg.functions if name in inside)
    for name in functions:
        inside[name].functions.append(name)
    seen = {*used, *(token for name in functions for token in cg.func_outputs(name))}
    return Placement(root, branches, functions, tuple(token for token in cg.tokens if token in seen))


def _branches(cg: CompGraph, name: str, around: Region) -> list[Region]:
    """Return the branches of a switch; values of the selector that choose the same token choose the same branch."""
    function = as_switch(cg.functions[name])
    keys = function.branches if function is not None else ()
    found: dict[str, Region] = {}
    for key, token in zip(keys, cg.func_inputs(name)[1:], strict=True):
        found.setdefault(token, Region(around, around.depth + 1, token)).keys.append(key)
    return list(found.values())


def _common(regions: list[Region]) -> Region:
    """Return the innermost region around all of these."""
    found = regions[0]
    for other in regions[1:]:
        while found is not other:
            if found.depth >= other.depth:
                found = found.around or found
            else:
                other = other.around or other
    return found
