"""Orders of colours: what three and four channels of each token are, and which function says it.

Marks in annotations say it, and so do functions in their source (``colour_use``). A token that a function passes on, as
a blur does, has the order on both sides of the function. Only what is sure counts against something else.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import Finding
from epypes.graph.bipartite import BipartiteDigraph
from epypes.graph.colour_names import Passed, Seen, opposite
from epypes.graph.colour_use import ColourUse, colour_use, may_tell
from epypes.graph.identity import inner_graph
from epypes.graph.signature import distinct
from epypes.graph.token_annotations import marks_of
from epypes.images import Contracts, Order

if TYPE_CHECKING:
    from epypes.graph.compgraph import CompGraph
    from epypes.graph.validation import Delay

_MARK: Final = "Annotated[np.ndarray, ep.Image(order={!r})]."


@dataclass(frozen=True, slots=True)
class ColourOrder:
    """The order of a token's three or four channels, and the function that says it.

    Attributes
    ----------
    order
        ``"bgr"`` or ``"rgb"``.
    function
        The function that says it. Empty if none does: the order is assumed.
    verb
        ``"takes"`` or ``"makes"``.
    token
        What that function takes or makes; another token if it is passed on.
    is_marked
        Whether an annotation says it.
    is_sure
        Whether more than a name says it that programs also use for the other direction, as ``COLOR_RGB2BGR``.

    Examples
    --------
    >>> str(ColourOrder("bgr")), str(ColourOrder("rgb", "gray", "takes", "image"))
    ('bgr, assumed', "rgb, as in function 'gray'")
    """

    order: Order
    function: str = ""
    verb: str = ""
    token: str = ""
    is_marked: bool = False
    is_sure: bool = True

    @property
    def is_assumed(self) -> bool:
        """Whether no function says it."""
        return not self.function

    def __str__(self) -> str:
        return f"{self.order}, assumed" if self.is_assumed else f"{self.order}, as in function {self.function!r}"


# What the order is where nothing says it, as in OpenCV.
ASSUMED: Final = ColourOrder("bgr")


def colour_order(cg: CompGraph, token: str) -> Order:
    """Return what three and four channels of a token are: BGR, unless a function says otherwise."""
    cg.require_token(token)
    return cg.colours.get(token, ASSUMED).order


def find_orders(
    functions: Mapping[str, Callable[..., Any]],
    digraph: BipartiteDigraph,
    func_io: Mapping[str, Any],
    contracts: Mapping[str, Contracts],
    delays: Mapping[str, Delay],
) -> tuple[dict[str, ColourOrder], list[Finding]]:
    """Find the orders of colours of tokens, and the tokens that two functions surely want in different ones.

    Parameters
    ----------
    functions
        The callables by name.
    digraph, func_io
        What ``read_io`` returns.
    contracts
        The marks of images in annotations, by function.
    delays
        By token, the token whose previous value it has.
    """
    search = _Search(functions, digraph, func_io, contracts, delays)
    search.run()
    return search.orders, search.findings


class _Search:
    """Carries what functions say from token to token."""

    def __init__(
        self,
        functions: Mapping[str, Callable[..., Any]],
        digraph: BipartiteDigraph,
        func_io: Mapping[str, Any],
        contracts: Mapping[str, Contracts],
        delays: Mapping[str, Delay],
    ) -> None:
        self._functions, self._digraph, self._func_io, self._contracts = functions, digraph, func_io, contracts
        self._delayed = [(previous, delay.token) for previous, delay in delays.items()]
        self._uses: dict[int, ColourUse] = {}
        self._disagreeing: set[tuple[str, str]] = set()
        self.orders: dict[str, ColourOrder] = {}
        self.findings: list[Finding] = []

    def run(self) -> None:
        # A large graph has few functions under many names.
        telling = {key for key, function in distinct(self._functions).items() if _is_telling(function)}
        names = [name for name in self._digraph.inputs if id(self._functions.get(name)) in telling]
        for token, order in (*self._marked(), *self._made(names), *self._taken(names)):
            self._add(token, order)
        self._pass_on([*self.orders])
        self._add_hints(self._hinted(names))

    # -- what functions say ----------------------------------------------------------------------------------------

    def _marked(self) -> Iterator[tuple[str, ColourOrder]]:
        for name, token, mark, verb in marks_of(self._contracts, self._digraph):
            if mark.order is not None:
                yield token, ColourOrder(mark.order, name, verb, token, is_marked=True)

    def _made(self, names: list[str]) -> Iterator[tuple[str, ColourOrder]]:
        for name in names:
            for token, seen in self._outputs(name):
                if seen == "bgr" or seen == "rgb":
                    yield token, ColourOrder(seen, name, "makes", token)

    def _taken(self, names: list[str]) -> Iterator[tuple[str, ColourOrder]]:
        for name in names:
            for place, order in self._use(name).taken.items():
                for token in self._input(name, place):
                    yield token, ColourOrder(order, name, "takes", token)

    def _hinted(self, names: list[str]) -> dict[str, list[ColourOrder]]:
        """Return by token what names alone say."""
        found: dict[str, list[ColourOrder]] = {}
        for name in names:
            for place, order in self._use(name).hinted.items():
                for token in self._input(name, place):
                    hint = ColourOrder(order, name, "takes", token, is_sure=False)
                    found.setdefault(token, []).append(hint)
        return found

    def _use(self, name: str) -> ColourUse:
        function = self._functions.get(name)
        if id(function) not in self._uses:
            self._uses[id(function)] = _use_in_graph(function)
        return self._uses[id(function)]

    def _input(self, name: str, place: int) -> tuple[str, ...]:
        """Return the token at a place, unless a mark says its order."""
        return () if self._mark(name, 0, place) else self._digraph.inputs[name][place : place + 1]

    def _outputs(self, name: str) -> Iterator[tuple[str, Seen]]:
        """Give the tokens that a function makes, but for those of which a mark says the order, and what each is."""
        use, tokens = self._use(name), self._digraph.outputs[name]
        is_single = name in self._func_io and isinstance(self._func_io[name][1], str)
        parts = (use.returned,) if is_single else use.parts
        if len(parts) == len(tokens):
            for place, pair in enumerate(zip(tokens, parts, strict=True)):
                if not self._mark(name, 1, place):
                    yield pair

    def _mark(self, name: str, side: int, place: int) -> Order | None:
        marks = self._contracts[name][side] if name in self._contracts else ()
        mark = marks[place] if place < len(marks) else None
        return mark.order if mark is not None else None

    # -- from token to token -----------------------------------------------------------------------------------------

    def _pass_on(self, tokens: list[str]) -> list[str]:
        """Give tokens that are passed on the order of those that are known; return all of them."""
        pending = deque(tokens)
        while pending:
            token = pending.popleft()
            known = self.orders[token]
            for other, is_swapped in self._same_image(token):
                passed = replace(known, order=opposite(known.order)) if is_swapped else known
                if self._add(other, passed):
                    pending.append(other)
                    tokens.append(other)
        return tokens

    def _add_hints(self, hints: Mapping[str, list[ColourOrder]]) -> None:
        """Add what names say of tokens of which nothing is sure, unless they disagree."""
        for token, (first, *_) in hints.items():
            if token not in self.orders:
                self.orders[token] = first
                reached = self._pass_on([token])
                if any(hint.order != self.orders[each].order for each in reached for hint in hints.get(each, ())):
                    for each in reached:
                        del self.orders[each]

    def _same_image(self, token: str) -> Iterator[tuple[str, bool]]:
        """Give the tokens that have the same image: a function passes it on, or its delay brings it again."""
        for pair in self._delayed:
            if token in pair:
                yield pair[pair[0] == token], False
        maker = self._digraph.producer.get(token)
        around = [] if maker is None or maker not in self._digraph.inputs else [maker]
        for name in (*around, *self._digraph.consumers.get(token, ())):
            for made, seen in self._outputs(name):
                if isinstance(seen, Passed):
                    for taken in self._digraph.inputs[name][seen.place : seen.place + 1]:
                        if made != taken and token in (made, taken):
                            yield taken if token == made else made, seen.is_swapped

    def _add(self, token: str, found: ColourOrder) -> bool:
        """Add what a function says of a token; return whether it is new. A contradiction becomes a finding."""
        if token not in self.orders:
            self.orders[token] = found
            return True
        first = self.orders[token]
        if found.is_sure and first.order != found.order:
            pair = min(first.function, found.function), max(first.function, found.function)
            if pair not in self._disagreeing:
                self._disagreeing.add(pair)
                self.findings.append(_two_orders(token, self.orders, found))
        return False


def _is_telling(function: object) -> bool:
    return may_tell(function) or inner_graph(function) is not None


def _use_in_graph(function: Any) -> ColourUse:
    """Return the colour use of a function, also of a pipeline: its graph has the orders of its inputs and outputs."""
    inner = inner_graph(function)
    if inner is None:
        return colour_use(function)
    if not getattr(type(function), "__module__", "").startswith("epypes."):
        return ColourUse()  # a subclass may do something around it
    free = function.runner.free_source_tokens
    known = [(place, inner.colours[token]) for place, token in enumerate(free) if token in inner.colours]
    made = [
        found.order if (found := inner.colours.get(token)) and found.is_sure else None for token in inner.sink_tokens
    ]
    return ColourUse(
        {place: found.order for place, found in known if found.is_sure},
        {place: found.order for place, found in known if not found.is_sure},
        made[0] if len(made) == 1 else None,
        tuple(made),
    )


def _two_orders(token: str, orders: Mapping[str, ColourOrder], second: ColourOrder) -> Finding:
    """Return the finding of a token that has an order already, and surely should have the other."""
    first = orders[token]
    name, other = first.function, second.function
    said = f"Function {name!r} {first.verb} token {first.token!r} as {orders[first.token].order}"
    if first.token != token:
        said += f", so token {token!r} is {first.order}"
    have, want, place = first.order, second.order, f"before {other!r}"
    if second.token == token:
        but = f"{other!r} {second.verb} it as {want}"
    else:
        but = f"it is {want} since {other!r} {second.verb} {second.token!r} as {orders[second.token].order}"
        have, want = want, have
    if first.verb == "makes" or second.token != token:
        place = "between them"
    conversion = f"cv2.cvtColor({token}, cv2.COLOR_{have.upper()}2{want.upper()})"
    text = f"{said}, but {but}. Convert it in a function {place}: {conversion}."
    if not (first.is_marked and second.is_marked):
        text += " Or, if that is not so, annotate what the function takes: " + _MARK.format(first.order)
    return Finding("colour", text, (token, name, other))
