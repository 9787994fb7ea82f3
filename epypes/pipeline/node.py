"""What is a function at run time?"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from time import perf_counter_ns
from typing import Any


class Node:
    """The runtime counterpart of a function: callable with positional inputs, measures its time.

    Made for subclassing: override ``compute`` to do something around, or instead of, the function.

    Parameters
    ----------
    name
        Its name in graphs and reports.
    func
        What it computes.

    Attributes
    ----------
    time
        How long the last call took, in seconds; 0.0 before the first.
    run_count
        How often it was called, failed calls included.

    Notes
    -----
    Semeniuta and Falkman 2019, "Nodes and pipelines".

    Examples
    --------
    >>> node = Node("double", lambda x: 2 * x)
    >>> node(21), node.run_count
    (42, 1)
    """

    def __init__(self, name: str, func: Callable[..., Any]) -> None:
        if not callable(func):
            raise TypeError(f"Node {name!r:.40} needs a function to call, not {type(func).__name__!r}.")
        self.name = name
        self.func = func
        self.time = 0.0
        self.run_count = 0
        self._counter = itertools.count(1)
        # A list, since adding to it and taking from it are whole in every thread, and counting up is not.
        self._calls_under_way: list[None] = []
        # Gives the node its function's signature, so that a graph of nodes is checked like one of functions.
        functools.update_wrapper(self, func, updated=())
        # Marks go along; whatever else a callable object or another node keeps must not take the place of our own.
        marks = {key: mark for key, mark in getattr(func, "__dict__", {}).items() if not hasattr(self, key)}
        self.__dict__.update(marks)

    def __call__(self, *args: Any) -> Any:
        """Compute, and measure the time."""
        self._calls_under_way.append(None)
        start_ns = perf_counter_ns()
        try:
            return self.compute(*args)
        finally:
            self.time = (perf_counter_ns() - start_ns) / 1e9
            self.run_count = next(self._counter)
            self._calls_under_way.pop()

    def compute(self, *args: Any) -> Any:
        """Compute the node's value from its inputs; the hook for subclasses."""
        return self.func(*args)

    @property
    def is_running(self) -> bool:
        """Whether a call has not returned yet."""
        return bool(self._calls_under_way)

    def traverse_time(self) -> tuple[Any, ...]:
        """Return ``(name, seconds of the last call)``; a pipeline adds its nodes' tuples as a third item."""
        return self.name, self.time

    def __repr__(self) -> str:
        return f"<{type(self).__name__:.30} {self.name!r:.40}: {self.run_count} calls>"
