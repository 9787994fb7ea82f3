"""The frozen view of a graph, which painters read alone, and its JSON."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, Final, Literal, NamedTuple

from epypes.display.layout import Direction as Direction
from epypes.display.previews import Chart, Picture, Preview
from epypes.errors import InvalidType
from epypes.images import Order

# For each vertex.
_MOST_EDGES: Final = 10

TokenRole = Literal["payload", "hyperparameter"]
TokenState = Literal["static", "not computed", "fresh", "stale", "nothing found", "missing", "left out"]
FunctionKind = Literal["function", "pipeline", "switch", "placeholder", "group"]
FunctionState = Literal[
    "static", "not run", "running", "ran", "reused", "skipped", "stale", "failed", "planned", "missing", "left out"
]


class TokenView(NamedTuple):
    """What is to be seen of a token.

    Attributes
    ----------
    preview
        None if it has no value.
    order
        That of its colours.
    first
        The text of the first value of a hyperparameter that has another one now; empty for all other tokens.
    order_by
        The function that says the order; empty if it is assumed.
    delayed
        The token whose value in the run before it has; empty for all other tokens.
    label
        What stands on it in place of its name: inside the frame of a pipeline, its name there.
    """

    name: str
    role: TokenRole
    state: TokenState
    preview: Preview | None = None
    order: Order = "bgr"
    first: str = ""
    order_by: str = ""
    delayed: str = ""
    label: str = ""


def has_picture(token: TokenView) -> bool:
    """Whether the thumbnail of a token is an encoded picture, not a chart."""
    return token.preview is not None and token.preview.picture is not None


class FunctionView(NamedTuple):
    """What is to be seen of a function.

    Attributes
    ----------
    share
        Its part of the run's time, from 0 to 1.
    message
        Why it failed, was skipped, would run or is left out.
    notes
        Short lines that are true of it in any state: the branch that a switch has chosen, that it is to be written, how
        many functions are inside a pipeline.
    is_redefined
        Whether its name now means another function, or that of a function inside it does.
    signature, source
        Its parameters, and the first lines of its source; empty where they can't be found.
    label
        What stands on it in place of its name: inside the frame of a pipeline, its name there.
    """

    name: str
    state: FunctionState
    duration_ns: int | None = None
    share: float = 0.0
    message: str = ""
    kind: FunctionKind = "function"
    notes: tuple[str, ...] = ()
    is_redefined: bool = False
    signature: str = ""
    source: str = ""
    label: str = ""


class StageView(NamedTuple):
    """What is to be seen of one stage of a reactive pipeline, outside its graph.

    Attributes
    ----------
    name
        Such as ``"q_in"``.
    notes
        Short lines: what it is, its counts.
    """

    kind: Literal["queue", "loop", "function"]
    name: str
    state: Literal["static", "running", "stopped", "failed"] = "static"
    notes: tuple[str, ...] = ()


class FrameView(NamedTuple):
    """A pipeline of which the inside is drawn: its name, and those of the functions and tokens in its frame."""

    name: str
    function_names: tuple[str, ...]
    token_names: tuple[str, ...]


class EdgeView(NamedTuple):
    """What is to be seen of an edge.

    Attributes
    ----------
    function, token
        Their indices.
    is_input
        Whether the function takes the token, not makes it.
    is_live
        Whether a run uses it. A switch reads the chosen branch only, and none as long as none is chosen; a skipped
        function uses none.
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
    title
        What stands on the frame around it; empty if there is no frame.
    before, after
        The stages that an event passes before and after the graph.
    groups
        What is inside the vertices of kind ``"group"`` and ``"pipeline"``, by their names.
    direction
        Where the data flows to on the page.
    delays
        Pairs of a token and the one that has its value in the next run.
    frames
        Around what is inside a pipeline, the outer ones first.
    """

    functions: tuple[FunctionView, ...]
    tokens: tuple[TokenView, ...]
    edges: tuple[EdgeView, ...]
    caption: str = ""
    title: str = ""
    before: tuple[StageView, ...] = ()
    after: tuple[StageView, ...] = ()
    groups: tuple[GroupView, ...] = ()
    direction: Direction = "down"
    delays: tuple[tuple[str, str], ...] = ()
    frames: tuple[FrameView, ...] = ()

    @property
    def draws_edges(self) -> bool:
        """Whether its edges can be seen: there are not too many."""
        return len(self.edges) <= _MOST_EDGES * (len(self.functions) + len(self.tokens))

    def io(self) -> list[tuple[list[str], list[str]]]:
        """Return by function, in order, the names of its input and of its output tokens."""
        found: list[tuple[list[str], list[str]]] = [([], []) for _ in self.functions]
        for edge in self.edges:
            found[edge.function][0 if edge.is_input else 1].append(self.tokens[edge.token].name)
        return found


@dataclass(frozen=True, slots=True)
class GroupView:
    """What is inside a group: a graph of its own, whose tokens are those that its functions take and make."""

    name: str
    graph: GraphView


def to_json(graph: GraphView) -> dict[str, Any]:
    """Return a view as what ``json.dumps`` takes: a record is an object by the names of its fields, a picture a URI."""
    written: dict[str, Any] = _written(graph)
    return written


def from_json(written: Mapping[str, Any]) -> GraphView:
    """Return the view that ``to_json`` has written; fields that are missing have their defaults.

    Raises
    ------
    TypeError, ValueError
        This is not a view.
    """
    if not isinstance(written, Mapping):
        raise InvalidType(f"A view in JSON is an object, not {type(written).__name__!r}.")
    graph: GraphView = _read(written, GraphView)
    return graph


def _written(value: Any) -> Any:
    if isinstance(value, Picture):
        return {"uri": value.uri, "width": value.width, "height": value.height}
    if is_dataclass(value):
        return {field.name: _written(getattr(value, field.name)) for field in fields(value)}
    if hasattr(value, "_asdict"):
        return {name: _written(item) for name, item in value._asdict().items()}
    return [_written(item) for item in value] if isinstance(value, tuple) else value


# The fields that have records, one or several; those of all others have texts, numbers and tuples of them.
_RECORDS: Final[dict[str, type]] = {
    "functions": FunctionView,
    "tokens": TokenView,
    "edges": EdgeView,
    "before": StageView,
    "after": StageView,
    "groups": GroupView,
    "frames": FrameView,
    "graph": GraphView,
    "preview": Preview,
    "picture": Picture,
    "chart": Chart,
}


def _read(written: Any, record: type | None) -> Any:
    if isinstance(written, list):
        return tuple(_read(item, record) for item in written)
    if record is None or written is None:
        return written
    if not isinstance(written, Mapping):
        raise InvalidType(f"A {record.__name__} in JSON is an object, not {type(written).__name__!r}.")
    if record is Picture:
        media_type, _, data = written["uri"].removeprefix("data:").partition(";base64,")
        return Picture(base64.b64decode(data), media_type, written["width"], written["height"])
    known = record.__annotations__
    return record(**{name: _read(item, _RECORDS.get(name)) for name, item in written.items() if name in known})
