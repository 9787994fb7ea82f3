"""In which order can functions run, and where is the shortest cycle?

A computational graph G = (F, T, E) is a bipartite digraph of functions F and tokens T (Semeniuta and
Falkman 2019). The two kinds of vertex live in separate name spaces, so a function may be called like a token.
"""

from __future__ import annotations

import heapq
import itertools
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property


@dataclass(frozen=True)
class BipartiteDigraph:
    """Functions, tokens and the edges between them.

    Attributes
    ----------
    inputs, outputs
        By function name, its input and output tokens; the order of the functions is the order of definition.
    producer
        By token, the function that makes it (the first one, where a faulty graph has several).
    """

    inputs: Mapping[str, tuple[str, ...]]
    outputs: Mapping[str, tuple[str, ...]]
    producer: dict[str, str] = field(init=False)

    def __post_init__(self) -> None:
        producer: dict[str, str] = {}
        for function, tokens in self.outputs.items():
            for token in tokens:
                if token not in producer:
                    producer[token] = function
        object.__setattr__(self, "producer", producer)

    @cached_property
    def consumers(self) -> dict[str, list[str]]:
        """By token, the functions that take it, in order of definition. Made when it is asked for: a run is not."""
        consumers: dict[str, list[str]] = {}
        for function, tokens in self.inputs.items():
            for token in dict.fromkeys(tokens):
                consumers.setdefault(token, []).append(function)
        return consumers

    def successors(self, function: str) -> Iterable[str]:
        """Return the functions that take an output of ``function``, each once, in order of definition."""
        return dict.fromkeys(
            consumer
            for token in self.outputs[function]
            if self.producer[token] == function  # in a faulty graph a token may have a second producer
            for consumer in self.consumers.get(token, ())
        )

    def predecessors(self, function: str) -> Iterable[str]:
        """Return the functions that make an input of ``function``, each once."""
        return dict.fromkeys(self.producer[token] for token in self.inputs[function] if token in self.producer)

    def run_order(self) -> tuple[str, ...]:
        """Sort the functions topologically (Kahn 1962); of those that can run, the first defined comes first.

        Functions on a cycle, and those behind one, are left out.
        """
        if self._is_in_order():
            return tuple(self.inputs)
        names = tuple(self.inputs)
        position = {function: index for index, function in enumerate(names)}
        producer, consumers, outputs = self.producer, self.consumers, self.outputs
        waiting = [len(producer.keys() & tokens) for tokens in self.inputs.values()]
        ready = [index for index, count in enumerate(waiting) if not count]
        order: list[str] = []
        while ready:
            function = names[heapq.heappop(ready)]
            order.append(function)
            # In a faulty graph a token may have a second producer, or be made twice by one.
            made = {token for token in outputs[function] if producer[token] == function}
            for consumer in itertools.chain.from_iterable(consumers.get(token, ()) for token in made):
                index = position[consumer]
                waiting[index] -= 1
                if not waiting[index]:
                    heapq.heappush(ready, index)
        return tuple(order)

    def _is_in_order(self) -> bool:
        """Whether every function is defined after those that it needs, which is the usual case."""
        to_come = set(self.producer)
        for function, tokens in self.inputs.items():
            if not to_come.isdisjoint(tokens):
                return False
            to_come.difference_update(self.outputs[function])
        return True

    def shortest_cycle(self) -> tuple[str, ...]:
        """Return the vertices of a shortest cycle, tokens and functions in turn, beginning and ending with one token.

        Empty if there is none.
        """
        best: tuple[str, ...] = ()
        suspects = self._on_cycles(set(self.inputs))
        while suspects:
            start = next(function for function in self.inputs if function in suspects)
            found = self._cycle_through(start, suspects, len(best))
            if found and (not best or len(found) < len(best)):
                best = found
            # Every cycle through it has been looked at; what was on no other cycle goes with it.
            suspects = self._on_cycles(suspects - {start})
        return self._with_tokens(best) if best else ()

    def _on_cycles(self, functions: set[str]) -> set[str]:
        """Drop the functions that nothing among the others leads to, or that lead to nothing, until none is left."""
        kept = set(functions)
        for neighbours, opposite in ((self.predecessors, self.successors), (self.successors, self.predecessors)):
            count = {function: sum(other in kept for other in neighbours(function)) for function in kept}
            ends = [function for function, left in count.items() if not left]
            while ends:
                gone = ends.pop()
                kept.discard(gone)
                for other in opposite(gone):
                    if other in kept:
                        count[other] -= 1
                        if not count[other]:
                            ends.append(other)
        return kept

    def _cycle_through(self, start: str, allowed: set[str], shorter_than: int) -> tuple[str, ...]:
        """Search breadth-first for the shortest way from ``start`` back to itself."""
        parent: dict[str, str] = {}
        depth = {start: 0}
        queue = deque([start])
        while queue:
            function = queue.popleft()
            if shorter_than and depth[function] + 2 >= shorter_than:
                return ()
            for successor in self.successors(function):
                if successor == start:
                    return _path(parent, start, function)
                if successor in allowed and successor not in depth:
                    depth[successor] = depth[function] + 1
                    parent[successor] = function
                    queue.append(successor)
        return ()

    def _with_tokens(self, functions: tuple[str, ...]) -> tuple[str, ...]:
        """Put between each two functions the token that joins them; begin with the token that closes the cycle."""
        joints = [
            next(token for token in self.outputs[left] if token in self.inputs[right])
            for left, right in itertools.pairwise(functions)
        ]
        vertices = [joints[-1]]
        for function, token in zip(functions[:-1], joints, strict=True):
            vertices += [function, token]
        return tuple(vertices)


def _path(parent: Mapping[str, str], start: str, last: str) -> tuple[str, ...]:
    path = [start]
    while last != start:
        path.append(last)
        last = parent[last]
    path.append(start)
    return tuple(reversed(path))
