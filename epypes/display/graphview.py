"""What does the frozen picture of a graph consist of?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

from epypes.display.preview import Preview
from epypes.images import Order

TokenRole = Literal["payload", "hyperparameter"]
TokenState = Literal["static", "not computed", "fresh", "stale", "missing", "left out"]
FunctionKind = Literal["function", "pipeline", "switch", "placeholder"]
FunctionState = Literal["static", "not run", "ran", "reused", "stale", "failed", "planned", "missing", "left out"]


@dataclass(frozen=True, slots=True)
class TokenView:
    """What is to be seen of a token; ``preview`` is None if it has no value, ``order`` is that of its colours."""

    name: str
    role: TokenRole
    state: TokenState
    preview: Preview | None = None
    order: Order = "bgr"


@dataclass(frozen=True, slots=True)
class FunctionView:
    """What is to be seen of a function.

    Attributes
    ----------
    share
        Its part of the run's time, from 0 to 1.
    message
        Why it failed, would run or is left out.
    notes
        Short lines that are true of it in any state: the branch that a switch has chosen, that it is to be written, how
        many functions are inside a pipeline.
    is_redefined
        Whether its name now means another function, or that of a function inside it does.
    """

    name: str
    state: FunctionState
    duration_ns: int | None = None
    share: float = 0.0
    message: str = ""
    kind: FunctionKind = "function"
    notes: tuple[str, ...] = ()
    is_redefined: bool = False


class EdgeView(NamedTuple):
    """What is to be seen of an edge.

    Attributes
    ----------
    function, token
        Their indices.
    is_input
        Whether the function takes the token, not makes it.
    is_live
        Whether a run uses it. A switch reads the chosen branch only, and none as long as none is chosen.
    """

    function: int
    token: int
    is_input: bool
    is_live: bool = True


@dataclass(frozen=True, slots=True)
class GraphView:
    """What is to be seen of a graph.

    Attributes
    ----------
    functions, tokens
        In run order and graph order.
    edges
        By function, inputs before outputs.
    caption
        What stands under the picture: the run's time and graph overhead, and what was left out.
    """

    functions: tuple[FunctionView, ...]
    tokens: tuple[TokenView, ...]
    edges: tuple[EdgeView, ...]
    caption: str = ""

    def io(self) -> list[tuple[list[str], list[str]]]:
        """Return by function, in order, the names of its input and of its output tokens."""
        found: list[tuple[list[str], list[str]]] = [([], []) for _ in self.functions]
        for edge in self.edges:
            found[edge.function][0 if edge.is_input else 1].append(self.tokens[edge.token].name)
        return found
