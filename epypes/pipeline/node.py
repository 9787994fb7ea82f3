"""A function at run time."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from time import perf_counter_ns
from types import CodeType
from typing import Any, Final, TypeVar

from epypes.run.guard import WATCH, called_for
from epypes.run.underway import functions_under_way, locals_under_way

M = TypeVar("M", bound=Callable[..., Any])

_CALLS: Final[set[CodeType]] = set()


def is_a_call(method: M) -> M:
    """Mark a method of nodes: as long as it has not returned, its node is running."""
    _CALLS.add(method.__code__)
    return method


def under_way() -> list[object]:
    """Return the nodes that have been called and have not returned, in any thread, and the functions of graphs."""
    return [*functions_under_way(), *(found["self"] for found in locals_under_way(_CALLS))]


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
    duration_ns
        How long the last call took, in nanoseconds; 0 before the first.
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
        self.func = called_for(name, func)
        self.duration_ns = 0
        self.run_count = 0
        # Whole in every thread, which counting up is not.
        self.next_count = itertools.count(1).__next__
        # Gives the node its function's signature, so that a graph of nodes is checked like one of functions.
        functools.update_wrapper(self, func, updated=())
        # Marks go along; whatever else a callable object or another node keeps must not take the place of our own.
        marks = {
            key: mark for key, mark in getattr(func, "__dict__", {}).items() if not hasattr(self, key) and key != WATCH
        }
        self.__dict__.update(marks)

    @is_a_call
    def __call__(self, *args: Any) -> Any:
        """Compute, and measure the time."""
        start_ns = perf_counter_ns()
        try:
            return self.compute(*args)
        finally:
            # What calls ``func`` in its place does these two as well.
            self.duration_ns = perf_counter_ns() - start_ns
            self.run_count = self.next_count()

    @property
    def time(self) -> float:
        """How long the last call took, in seconds; 0.0 before the first."""
        return self.duration_ns / 1e9

    def compute(self, *args: Any) -> Any:
        """Compute the node's value from its inputs; the hook for subclasses."""
        return self.func(*args)

    @property
    def __epypes_is_its_func__(self) -> bool:
        """Whether it comes to the same to call ``func``, set ``duration_ns`` and count the call."""
        kind = type(self)
        return kind.__call__ is Node.__call__ and kind.compute is Node.compute and "compute" not in vars(self)

    @property
    def is_running(self) -> bool:
        """Whether a call has not returned yet."""
        return any(node is self for node in under_way())

    def traverse_time(self) -> tuple[Any, ...]:
        """Return ``(name, seconds of the last call)``; a pipeline adds its nodes' tuples as a third item."""
        return self.name, self.time

    def __repr__(self) -> str:
        return f"<{type(self).__name__:.30} {self.name!r:.40}: {self.run_count} calls>"
