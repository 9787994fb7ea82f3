"""Orders of colours: what three and four channels of each token are, and which function says it.

Marks in annotations say it, and so do functions in their source (``colour_use``). A token that a function passes on, as
a blur does, has the order on both sides of the function. Only what is sure counts against something else.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import Finding
from epypes.graph.bipartite import BipartiteDigraph
from epypes.graph.colour_use import ColourUse, TracedImage, colour_use, may_tell, opposite
from epypes.graph.identity import inner_graph
from epypes.graph.signature import distinct
from epypes.graph.token_annotations import marks_of
from epypes.images import Contracts, Order

if TYPE_CHECKING:
    from epypes.graph.compgraph import CompGraph
    from epypes.graph.validation import GraphParts

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
    parts: GraphParts, digraph: BipartiteDigraph, contracts: Mapping[str, Contracts]
) -> tuple[dict[str, ColourOrder], list[Finding]]:
    """Find the orders of colours of tokens, and the tokens that two functions surely want in different ones.

    Parameters
    ----------
    parts
        The graph's parts.
    digraph
        What is connected to what.
    contracts
        The marks of images in annotations, by function.
    """
    search = _Search(parts, digraph, contracts)
    functions = parts.functions
    # A large graph has few functions under many names.
    telling = {key for key, function in distinct(functions).items() if _is_telling(function)}
    names = [name for name in digraph.inputs if id(functions.get(name)) in telling]
    search.spread([*search.marked(), *search.made(names), *search.taken(names)])
    hints: dict[str, list[ColourOrder]] = {}
    for token, hint in search.taken(names, is_sure=False):
        hints.setdefault(token, []).append(hint)
    for token, (first, *_) in hints.items():
        if token not in search.orders:
            reached = search.spread([(token, first)])
            if any(hint.order != search.orders[each].order for each in reached for hint in hints.get(each, ())):
                for each in reached:
                    del search.orders[each]
    return search.orders, search.findings


class _Search:
    """Carries what functions say from token to token."""

    def __init__(self, parts: GraphParts, digraph: BipartiteDigraph, contracts: Mapping[str, Contracts]) -> None:
        self._parts, self._digraph, self._contracts = parts, digraph, contracts
        self._delayed = [(previous, delay.token) for previous, delay in parts.delays.items()]
        self._uses: dict[tuple[int, int], ColourUse] = {}
        self._disagreeing: set[tuple[str, ...]] = set()
        self.orders: dict[str, ColourOrder] = {}
        self.findings: list[Finding] = []

    # -- what functions say ----------------------------------------------------------------------------------------

    def marked(self) -> Iterator[tuple[str, ColourOrder]]:
        for name, token, mark, verb in marks_of(self._contracts, self._digraph):
            if mark.order is not None:
                yield token, ColourOrder(mark.order, name, verb, token, is_marked=True)

    def made(self, names: Iterable[str]) -> Iterator[tuple[str, ColourOrder]]:
        for name in names:
            for token, image in self._outputs(name):
                if image.place is None:
                    yield token, ColourOrder("rgb" if image.is_swapped else "bgr", name, "makes", token)

    def taken(self, names: Iterable[str], *, is_sure: bool = True) -> Iterator[tuple[str, ColourOrder]]:
        """Give the tokens that functions take in an order; if it is not sure, what names alone say."""
        for name in names:
            use = self._use(name)
            for place, order in (use.taken if is_sure else use.hinted).items():
                if place < len(self._digraph.inputs[name]) and not self._is_marked(name, 0, place):
                    token = self._digraph.inputs[name][place]
                    yield token, ColourOrder(order, name, "takes", token, is_sure=is_sure)

    def _use(self, name: str) -> ColourUse:
        function, count = self._parts.functions.get(name), len(self._digraph.inputs[name])
        key = id(function), count
        if key not in self._uses:
            inner = inner_graph(function)
            self._uses[key] = colour_use(function, count) if inner is None else _use_of_pipeline(function, inner)
        return self._uses[key]

    def _outputs(self, name: str) -> Iterator[tuple[str, TracedImage]]:
        """Give the images that a function makes or passes on, but for those of which a mark says the order."""
        tokens, returned = self._digraph.outputs[name], self._use(name).returned
        if self._parts.has_single_output(name):
            returned = (returned,)
        if isinstance(returned, tuple) and len(returned) == len(tokens):
            for place, (token, image) in enumerate(zip(tokens, returned, strict=True)):
                if isinstance(image, TracedImage) and not self._is_marked(name, 1, place):
                    yield token, image

    def _is_marked(self, name: str, side: int, place: int) -> bool:
        marks = self._contracts[name][side] if name in self._contracts else ()
        mark = marks[place] if place < len(marks) else None
        return mark is not None and mark.order is not None

    # -- from token to token -----------------------------------------------------------------------------------------

    def spread(self, found: Iterable[tuple[str, ColourOrder]]) -> list[str]:
        """Add orders, and those of the tokens that have the same images; return the tokens that had none."""
        pending, reached = deque(found), []
        while pending:
            token, order = pending.popleft()
            if token not in self.orders:
                self.orders[token] = order
                reached.append(token)
                for other, is_swapped in self._same_image(token):
                    pending.append((other, replace(order, order=opposite(order.order)) if is_swapped else order))
            elif order.is_sure and order.order != self.orders[token].order:
                pair = tuple(sorted((self.orders[token].function, order.function)))
                if pair not in self._disagreeing:
                    self._disagreeing.add(pair)
                    self.findings.append(_two_orders(token, self.orders, order))
        return reached

    def _same_image(self, token: str) -> Iterator[tuple[str, bool]]:
        """Give the tokens that have the same image, perhaps swapped: a function passes it on, or a delay does."""
        for pair in self._delayed:
            if token in pair:
                yield pair[pair[0] == token], False
        maker = self._digraph.producer.get(token)
        around = [] if maker is None or maker not in self._digraph.inputs else [maker]
        for name in (*around, *self._digraph.consumers.get(token, ())):
            inputs = self._digraph.inputs[name]
            for made, image in self._outputs(name):
                if image.place is not None and image.place < len(inputs):
                    taken = inputs[image.place]
                    if made != taken and token in (made, taken):
                        yield taken if token == made else made, image.is_swapped


def _is_telling(function: object) -> bool:
    return may_tell(function) or inner_graph(function) is not None


def _use_of_pipeline(function: Any, inner: CompGraph) -> ColourUse:
    """Return the colour use of a pipeline: its graph has the orders of its inputs and outputs."""
    if not getattr(type(function), "__module__", "").startswith("epypes."):
        return ColourUse()  # a subclass may do something around it
    free = enumerate(function.runner.free_source_tokens)
    known = {place: inner.colours[token] for place, token in free if token in inner.colours}
    sinks = [inner.colours.get(token) for token in inner.sink_tokens]
    made = tuple(TracedImage(None, found.order == "rgb") if found and found.is_sure else None for found in sinks)
    return ColourUse(
        {place: found.order for place, found in known.items() if found.is_sure},
        {place: found.order for place, found in known.items() if not found.is_sure},
        made[0] if len(made) == 1 else made,
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
