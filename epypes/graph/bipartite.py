"""The bipartite digraph of functions and tokens: its order and its shortest cycle.

A computational graph G = (F, T, E) is a bipartite digraph of functions F and tokens T (Semeniuta and
Falkman 2019). The two kinds of vertex live in separate name spaces, so a function may be called like a token.
"""

from __future__ import annotations

import heapq
import itertools
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property


@dataclass(frozen=True)
class BipartiteDigraph:
    """Functions, tokens and the edges between them.

    Attributes
    ----------
    inputs, outputs
        By function name, its input and output tokens; the order of the functions is the order of definition.
    """

    inputs: Mapping[str, tuple[str, ...]]
    outputs: Mapping[str, tuple[str, ...]]

    @cached_property
    def producer(self) -> dict[str, str]:
        """By token, the function that makes it (the first one, where a faulty graph has several)."""
        producer: dict[str, str] = {}
        for function, tokens in self.outputs.items():
            for token in tokens:
                producer.setdefault(token, function)
        return producer

    @cached_property
    def consumers(self) -> dict[str, list[str]]:
        """By token, the functions that take it, in order of definition."""
        consumers: dict[str, list[str]] = {}
        for function, tokens in self.inputs.items():
            for token in dict.fromkeys(tokens):
                consumers.setdefault(token, []).append(function)
        return consumers

    def tokens(self) -> dict[str, None]:
        """Return every token once, by first appearance, inputs before outputs."""
        sides = zip(self.inputs.values(), self.outputs.values(), strict=True)
        return dict.fromkeys(itertools.chain.from_iterable(itertools.chain.from_iterable(sides)))

    def successors(self, function: str) -> Iterable[str]:
        """Return the functions that take an output of ``function``, each once, in order of definition."""
        # In a faulty graph a token may have a second producer.
        made = (token for token in self.outputs[function] if self.producer[token] == function)
        return dict.fromkeys(itertools.chain.from_iterable(self.consumers.get(token, ()) for token in made))

    def predecessors(self, function: str) -> Iterable[str]:
        """Return the functions that make an input of ``function``, each once."""
        return dict.fromkeys(self.producer[token] for token in self.inputs[function] if token in self.producer)

    def run_order(self) -> tuple[str, ...]:
        """Sort the functions topologically (Kahn 1962); of those that can run, the first defined comes first.

        Functions on a cycle, and those behind one, are left out.
        """
        return tuple(self.inputs) if self._is_defined_in_order() else self._sorted(self.inputs)

    def _is_defined_in_order(self) -> bool:
        """Whether every function is defined after those that it needs: the usual case, which takes a tenth to see."""
        to_come = set(self.producer)
        for function, tokens in self.inputs.items():
            if not to_come.isdisjoint(tokens):
                return False
            to_come.difference_update(self.outputs[function])
        return True

    def _sorted(self, functions: Iterable[str]) -> tuple[str, ...]:
        """Sort some functions topologically, as if there were no others."""
        position = {function: index for index, function in enumerate(functions)}
        names = tuple(position)
        waiting = [sum(maker in position for maker in self.predecessors(function)) for function in names]
        ready = [index for index, count in enumerate(waiting) if not count]
        order: list[str] = []
        while ready:
            function = names[heapq.heappop(ready)]
            order.append(function)
            for successor in self.successors(function):
                if successor in position:
                    index = position[successor]
                    waiting[index] -= 1
                    if not waiting[index]:
                        heapq.heappush(ready, index)
        return tuple(order)

    def shortest_cycle(self) -> tuple[str, ...]:
        """Return the vertices of a shortest cycle, tokens and functions in turn, beginning and ending with one token.

        Empty if there is none.
        """
        best: tuple[str, ...] = ()
        suspects = dict.fromkeys(self.inputs)
        while True:
            for function in self._sorted(suspects):
                del suspects[function]
            if not suspects:
                return self._with_tokens(best) if best else ()
            start = next(iter(suspects))
            found = self._cycle_through(start, suspects, len(best))
            best = found or best
            # Every cycle through it is known now. What was on no other cycle is sorted out with it.
            del suspects[start]

    def _cycle_through(self, start: str, allowed: Iterable[str], shorter_than: int) -> tuple[str, ...]:
        """Search breadth-first for the shortest way from ``start`` back to itself; 0 is any length."""
        to_visit = set(allowed) - {start}
        pending: deque[tuple[str, ...]] = deque([(start,)])
        while pending:
            path = pending.popleft()
            if shorter_than and len(path) + 1 >= shorter_than:
                return ()
            for successor in self.successors(path[-1]):
                if successor == start:
                    return (*path, start)
                if successor in to_visit:
                    to_visit.remove(successor)
                    pending.append((*path, successor))
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
