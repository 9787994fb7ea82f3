"""Switches: functions that choose one of several branches of a graph by a hyperparameter."""

from __future__ import annotations

import inspect
from collections.abc import Hashable, Mapping
from typing import TYPE_CHECKING, Any

from epypes.errors import InvalidType, InvalidValue, UnknownName, require_mapping
from epypes.graph.identity import innermost

if TYPE_CHECKING:
    from epypes.graph.compgraph import CompGraph


class Switch:
    """The function of a switch: takes a selector and one value per branch, returns the value of the branch chosen.

    Parameters
    ----------
    name
        Its name, for errors.
    branches
        The keys of the branches, in the order of the inputs.

    Attributes
    ----------
    branches
        The keys, in order.
    """

    def __init__(self, name: str, branches: tuple[Hashable, ...]) -> None:
        self.name, self.branches = name, branches
        self._index = {key: index for index, key in enumerate(branches)}
        # The graph checks the number of inputs against it.
        names = ("selector", *(f"branch_{index}" for index in range(len(branches))))
        positional = inspect.Parameter.POSITIONAL_ONLY
        self.__signature__ = inspect.Signature([inspect.Parameter(name, positional) for name in names])

    def branch_index(self, selector: Any) -> int:
        """Return the place of the chosen branch: 0 is the first input after the selector.

        Raises
        ------
        UnknownName
            No branch has this key.
        """
        try:
            return self._index[selector]
        except (KeyError, TypeError):  # an unhashable selector raises TypeError
            where = f"of switch {self.name!r}"
            raise UnknownName("branch", selector, map(str, self.branches), where=where) from None

    def __call__(self, selector: Any, *values: Any) -> Any:
        """Return the value of the chosen branch."""
        return values[self.branch_index(selector)]

    def __repr__(self) -> str:
        return f"<Switch {self.name!r:.40}: {len(self.branches)} branches>"


def as_switch(function: object) -> Switch | None:
    """Return the switch that a function is or wraps, None if it is no switch."""
    found = innermost(function)
    return found if isinstance(found, Switch) else None


def switch(name: str, branches: Mapping[Any, str], by: str, output: str) -> CompGraph:
    """Make a graph of one function that chooses between the tokens of branches; join it to theirs by ``|``.

    Only the chosen branch is computed. So the selector must be known before anything runs: it is a source token of the
    graph, best frozen as a hyperparameter.

    Parameters
    ----------
    name
        The function's name.
    branches
        By value of the selector, the token that is then passed on.
    by
        The selector, a source token.
    output
        The token that is made.

    Raises
    ------
    TypeError
        The branches are no mapping, or the output is not one token.
    ValueError
        There is no branch.
    GraphError
        A name is no name of a token.

    Examples
    --------
    >>> switch("choose", {"canny": "edges_canny", "sobel": "edges_sobel"}, by="method", output="edges")
    <CompGraph: 1 function, 4 tokens; method, edges_c... -> edges>
    """
    from epypes.graph.compgraph import CompGraph

    require_mapping("branches", branches, "from selector values to tokens")
    if not branches:
        raise InvalidValue(f"Switch {name!r} has no branches. Give at least one: {{value of {by!r}: token}}.")
    if not isinstance(output, str):
        text = f"output takes one token, not {type(output).__name__!r}: a switch passes on one value as it is."
        raise InvalidType(f"{text} Put a function behind it, which takes the value apart.")
    function = Switch(name, tuple(branches))
    return CompGraph({name: function}, {name: ((by, *branches.values()), output)})
