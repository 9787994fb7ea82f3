"""The structure of a graph, whatever has been run: its parts, chosen branches, sources and redefinitions."""

from __future__ import annotations

import inspect
import linecache
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from itertools import islice
from types import CodeType, FunctionType
from typing import Any, Final
from weakref import WeakKeyDictionary

from epypes.display.previews.preview import preview
from epypes.display.previews.short import without_addresses
from epypes.display.text import cut, listed, shortened
from epypes.display.views.graphview import (
    EdgeView,
    FunctionState,
    FunctionView,
    GraphView,
    TokenState,
    TokenView,
)
from epypes.graph import (
    ASSUMED,
    CompGraph,
    Switch,
    as_switch,
    inner_graph,
    is_redefined_inside,
    redefined,
    unwrapped,
)
from epypes.wording import counted

_TO_BE_WRITTEN: Final = "to be written"
_REDEFINED: Final = "redefined since: build the graph again"
_REDEFINED_INSIDE: Final = "a function inside was redefined: build again"
_SELECTOR_CHARACTERS: Final = 20
_KEY_CHARACTERS: Final = 16
_NAMED: Final = 3
# By graph the last structure, with what it depends on: a run changes values, and rarely more.
_kept: WeakKeyDictionary[CompGraph, tuple[tuple[Any, ...], GraphView]] = WeakKeyDictionary()


def structure_of(cg: CompGraph, branches: Mapping[str, Any], left_out: Collection[str]) -> GraphView:
    """Look at a graph.

    Parameters
    ----------
    branches
        By switch, the key of the chosen branch; a switch that has not chosen is not in it.
    left_out
        The functions that are not needed; they, and the tokens that only they make or take, get this state.
    """
    # Whether it is a function inside that was redefined.
    old = {name: is_redefined_inside(cg.functions[name]) for name in redefined(cg)}
    key = tuple(old.items()), tuple(branches.items()), tuple(left_out)
    kept = _kept.get(cg)
    if kept is None or kept[0] != key:
        kept = _kept[cg] = key, _Structure(cg, branches, left_out, old).view()
    return kept[1]


class _Structure:
    """A graph with what runs depend on: the chosen branches, and which functions are not needed or redefined."""

    def __init__(
        self, cg: CompGraph, branches: Mapping[str, Any], left_out: Collection[str], old: Mapping[str, bool]
    ) -> None:
        self._cg, self._branches, self._left_out, self._old = cg, branches, left_out, old
        # By switch, the tokens of the branches that it does not read: all as long as it has not chosen.
        self._unread: dict[str, frozenset[str]] = {}
        for name in cg.switches:
            selector, *tokens = cg.func_inputs(name)
            function, read = as_switch(cg.functions[name]), {selector}
            if function is not None and name in branches:
                read.add(tokens[function.branch_index(branches[name])])
            self._unread[name] = frozenset(tokens) - read

    def view(self) -> GraphView:
        delays = tuple((delay.token, previous) for previous, delay in self._cg.delays.items())
        functions, tokens = map(self._function, self._cg.functions), map(self._token, self._cg.tokens)
        return GraphView(tuple(functions), tuple(tokens), tuple(self._edges()), self._caption(), delays=delays)

    def _function(self, name: str) -> FunctionView:
        state: FunctionState = "left out" if name in self._left_out else "static"
        function, old = self._cg.functions[name], name in self._old
        switch, inner = as_switch(function), inner_graph(function)
        if switch is not None:
            return FunctionView(name, state, kind="switch", notes=(self._choice(name, switch),))
        if name in self._cg.placeholders:
            return FunctionView(name, state, kind="placeholder", notes=(_TO_BE_WRITTEN,))
        notes = ((_REDEFINED_INSIDE if self._old[name] else _REDEFINED),) if old else ()
        if inner is None:
            signature, source = signature_and_source(function)
            return FunctionView(name, state, notes=notes, is_redefined=old, signature=signature, source=source)
        notes = (f"pipeline of {counted(len(inner.functions), 'function')}", *notes)
        return FunctionView(name, state, kind="pipeline", notes=notes, is_redefined=old, source=_graph_lines(inner))

    def _choice(self, name: str, function: Switch) -> str:
        selector = cut(self._cg.func_inputs(name)[0], _SELECTOR_CHARACTERS)
        if name not in self._branches:
            return f"one of {len(function.branches)} by {selector}"
        key = self._branches[name]
        return f"{selector} = {cut(key if isinstance(key, str) else preview(key).text, _KEY_CHARACTERS)}"

    def _token(self, token: str) -> TokenView:
        maker, takers = self._cg.digraph.producer.get(token), self._cg.digraph.consumers.get(token, ())
        if maker is not None:
            is_left_out = maker in self._left_out
        else:
            is_left_out = all(
                name in self._left_out or (name in self._branches and token in self._unread[name]) for name in takers
            )
        state: TokenState = "left out" if is_left_out else "static"
        colours, delay = self._cg.colours.get(token, ASSUMED), self._cg.delays.get(token)
        delayed = delay.token if delay is not None else ""
        return TokenView(token, "payload", state, order=colours.order, order_by=colours.function, delayed=delayed)

    def _edges(self) -> Iterator[EdgeView]:
        place = {token: index for index, token in enumerate(self._cg.tokens)}
        for index, name in enumerate(self._cg.functions):
            is_needed, unread = name not in self._left_out, self._unread.get(name, frozenset())
            for token in dict.fromkeys(self._cg.func_inputs(name)):
                yield EdgeView(index, place[token], True, is_needed and token not in unread)
            for token in dict.fromkeys(self._cg.func_outputs(name)):
                yield EdgeView(index, place[token], False, is_needed)

    def _caption(self) -> str:
        if not self._old:
            return ""
        names = [
            f"{'a function inside ' * is_inside}{cut(name, _SELECTOR_CHARACTERS)!r}"
            for name, is_inside in self._old.items()
        ]
        some, verb = listed(names, _NAMED), "was" if len(names) == 1 else "were"
        start = some[0].upper() + some[1:]
        return f"{start} {verb} redefined since the graph was built: run the cell that builds it again"


# -- signatures and sources ----------------------------------------------------------------------------------------

SIGNATURE_CHARACTERS: Final = 200
SOURCE_LINES: Final = 30
LINE_CHARACTERS: Final = 120
_DOCUMENTED: Final = "# no source in Python; its documentation begins:"
# A re-display of 200 functions must not look at 200 files again. A function that is defined again is another object.
_sources: WeakKeyDictionary[Any, tuple[str, str]] = WeakKeyDictionary()


def signature_and_source(function: Any) -> tuple[str, str]:
    """Return a function's parameters, and the first lines of its source; never raises.

    Those of the user's own function in what is decorated, partial or a node. What has no source in Python has the first
    lines of its documentation instead, marked so.

    Returns
    -------
    tuple
        Two texts, either of which is empty if it can't be found: at most 200 characters; at most 30 lines of at most
        120 characters.
    """
    try:
        if function not in _sources:
            _sources[function] = _signature(function), _source(function)
        return _sources[function]
    except TypeError:  # no weak reference to it, or no hash: it is looked at again
        return _signature(function), _source(function)
    except Exception:  # whatever odd objects raise when they are hashed or compared
        return "", ""


def _or_nothing(text_of: Callable[[Any], str], function: Any) -> str:
    try:
        return text_of(function)
    except Exception:  # a signature or a docstring may be any object
        return ""


def _signature(function: Any) -> str:
    if not isinstance(function, FunctionType | partial) and isinstance(unwrapped(function), FunctionType):
        function = unwrapped(function)
    return _or_nothing(_signature_text, function)


class _Text(str):
    """A default as its preview: its own repr may be long, slow or raise."""

    __slots__ = ()
    __repr__ = str.__str__


def _signature_text(function: Any) -> str:
    signature = inspect.signature(function)
    short = [
        each if each.default is each.empty else each.replace(default=_Text(preview(each.default).text))
        for each in signature.parameters.values()
    ]
    text = without_addresses(str(signature.replace(parameters=short)))
    if len(text) > SIGNATURE_CHARACTERS:
        plain = [each.replace(annotation=each.empty) for each in short]
        text = without_addresses(str(signature.replace(parameters=plain, return_annotation=signature.empty)))
    return shortened(text, SIGNATURE_CHARACTERS)


def _source(function: Any) -> str:
    return _or_nothing(_code, unwrapped(function)) or _or_nothing(_documentation, unwrapped(function))


def _code(function: Any) -> str:
    """Return the lines of a function; none if the lines that are there now are not those of a definition of it.

    Found by the positions in its code: to parse the file, as ``inspect.getsource`` does, takes a hundred times longer.
    """
    if not isinstance(function, FunctionType):
        function = getattr(type(function), "__call__", None)  # noqa: B004 - the method itself is wanted
    if not isinstance(function, FunctionType):
        return ""
    code = function.__code__
    lines = linecache.getlines(code.co_filename, function.__globals__)[code.co_firstlineno - 1 : _last_line(code)]
    mark = "lambda" if code.co_name == "<lambda>" else f"def {code.co_name}"
    return _first_lines(lines) if any(mark in line for line in lines) else ""


def _last_line(code: CodeType) -> int:
    """Return the last line of code, with the functions defined in it."""
    inner = (_last_line(item) for item in code.co_consts if isinstance(item, CodeType))
    own = (end for _, end, _, _ in code.co_positions() if end is not None)
    return max((*inner, *own), default=code.co_firstlineno)


def _documentation(function: Any) -> str:
    """Return the first lines of the docstring of what is not written in Python; it may be as long as a book."""
    if isinstance(function, FunctionType) or not callable(function):
        return ""
    lines = (inspect.getdoc(function) or "")[:10_000].splitlines()[: SOURCE_LINES - 1]
    return "\n".join([_DOCUMENTED, *(shortened(line.rstrip(), LINE_CHARACTERS) for line in lines)]) if lines else ""


def _graph_lines(cg: CompGraph) -> str:
    """Return the first functions of a pipeline's graph as lines: ``canny(image, low, high) -> edges``."""
    return _first_lines([
        f"{name}({', '.join(cg.func_inputs(name))}) -> {', '.join(cg.func_outputs(name)) or 'nothing'}"
        for name in islice(cg.functions, SOURCE_LINES + 1)
    ])  # fmt: skip


def _first_lines(lines: Sequence[str]) -> str:
    kept = [line.rstrip().expandtabs(4) for line in lines[:SOURCE_LINES]]
    margin = min((len(line) - len(line.lstrip()) for line in kept if line), default=0)
    short = [shortened(line[margin:], LINE_CHARACTERS) for line in kept]
    if len(lines) > SOURCE_LINES:
        short[-1] = "…"
    return "\n".join(short)
