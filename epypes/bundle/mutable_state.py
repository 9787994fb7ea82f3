"""Mutable state that a bundle's functions refer to: locked where it is an array, else compared after each call.

No answer may depend on an earlier event. Promotion refuses functions that plainly write to what outlives their call;
syntax can't show all of it. So each function of a loaded bundle that refers to a mutable object is wrapped: after its
call, a snapshot of these objects is compared; if one has changed, it is put back and the call raises StateChanged.
Functions that refer only to constants, which are most, are not wrapped.

Calls in several threads share the objects. Where a call finds a change and other calls ran meanwhile, any of them may
have made it, or have read it: each of them is called again, alone, on objects that have been put back.

The cache of an ``lru_cache`` is no state: arrays in it are locked when they are computed, and a value that can still be
changed does not stay in it after the call. The attributes of a node of the user's own class are put back without a
failure, since it may count its calls; what a pipeline of the user's own class keeps in its attributes is not looked at.
The global generators of ``random`` and ``numpy.random`` are not compared: a function may seed them for another one, and
the replay finds draws without a seed.
"""

from __future__ import annotations

import functools
import threading
import types
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from epypes.bundle.code_snapshot import CACHED, CacheCheck, CodeSnapshot
from epypes.errors import StateChanged
from epypes.graph import as_switch, is_placeholder
from epypes.pipeline import Node, Pipeline
from epypes.run.guard import WATCH, WRITTEN, is_array, is_unguarded
from epypes.run.snapshot import is_own

# The turns of the guarded call under way. What that calls, also in helper threads, is part of it.
_under_way: ContextVar[object] = ContextVar("_under_way", default=None)


class MutableState:
    """Guards the functions of one loaded bundle.

    Parameters
    ----------
    functions
        All of them, by name; nested pipelines are looked through.
    """

    def __init__(self, functions: Mapping[str, Callable[..., Any]]) -> None:
        self._turns = _Turns()
        self._caches: dict[int, CacheCheck] = {}
        self._compared: dict[int, object] = {}
        for name, function in _with_inner(functions):
            if is_unguarded(function):
                # It rejects read-only arrays.
                self._compared |= CodeSnapshot({name: function}, lock=False).arrays

    def guarded(self, functions: Mapping[str, Callable[..., Any]]) -> dict[str, Callable[..., Any]]:
        """Have runners and nodes call what watches over these functions; return them, those of odd kinds wrapped.

        Nodes, and those of nested pipelines, are changed in place.
        """
        return {name: self._guarded(name, function) for name, function in functions.items()}

    def _guarded(self, name: str, function: Any) -> Any:
        if is_placeholder(function) or as_switch(function) is not None:
            return function
        if isinstance(function, Pipeline):
            self.guarded(function.network.nodes)
            return function
        snapshot = CodeSnapshot({name: function}, compared=self._compared, caches=self._caches)
        if not snapshot:
            return function
        if type(function) in (types.FunctionType, functools.partial, CACHED):
            # It stays what the module defines, so that it can be promoted again.
            setattr(function, WATCH, functools.partial(self._guarded_call, function=function, snapshot=snapshot))
            return function
        if not isinstance(function, Node):
            return self._guarded_call(name, function, snapshot)
        if type(function).compute is Node.compute:
            function.func = self._guarded_call(name, function.func, snapshot)
        else:
            function.compute = self._guarded_call(name, function.compute, snapshot)  # type: ignore[method-assign]
        return function

    def _guarded_call(self, name: str, function: Callable[..., Any], snapshot: CodeSnapshot) -> Callable[..., Any]:
        turns = self._turns

        def attempt(args: Any, kwargs: Any) -> tuple[Any, BaseException | None]:
            token = _under_way.set(turns)
            try:
                return function(*args, **kwargs), None
            except BaseException as error:
                return None, error
            finally:
                _under_way.reset(token)
                snapshot.settle()

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            if _under_way.get() is turns:
                return function(*args, **kwargs)
            emptied, entered, is_restored = snapshot.emptied, turns.enter(), True
            result, error = attempt(args, kwargs)
            changed = snapshot.changed()
            with turns.changed:
                try:
                    is_alone = turns.was_alone(entered)
                    if changed is not None and is_alone:
                        is_restored = snapshot.restored()
                finally:
                    turns.leave()
            if not is_alone and (changed is not None or snapshot.emptied != emptied):
                with turns.alone():
                    snapshot.restore()
                    result, error = attempt(args, kwargs)
                    changed = snapshot.changed()
                    is_restored = changed is None or snapshot.restored()
            try:
                if error is not None:
                    raise error
                if changed is not None:
                    raise StateChanged(name, changed, is_restored)
                return result
            finally:
                # The exception keeps this frame, which would keep the exception, and with it the images of the call.
                del error, result

        vars(call).pop(WATCH, None)
        setattr(call, WRITTEN, function)
        return call


class _Turns:
    """Tells a call whether others ran meanwhile, and lets one run alone."""

    def __init__(self) -> None:
        self.changed = threading.Condition()
        self._running = self._entered = 0
        self._is_taken = False

    def enter(self) -> int:
        """Begin a call; return its number, or 0 if others are running."""
        with self.changed:
            while self._is_taken:
                self.changed.wait()
            self._running += 1
            self._entered += 1
            return self._entered if self._running == 1 else 0

    def was_alone(self, entered: int) -> bool:
        """Whether no other call ran since this one has begun; to be asked with ``changed`` held."""
        return entered == self._entered

    def leave(self) -> None:
        """End a call, with ``changed`` held."""
        self._running -= 1
        if self._is_taken:
            self.changed.notify_all()

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Wait for the others to end, and let none begin until the block ends."""
        with self.changed:
            while self._is_taken:
                self.changed.wait()
            self._is_taken = True
            while self._running:
                self.changed.wait()
        try:
            yield
        finally:
            with self.changed:
                self._is_taken = False
                self.changed.notify_all()


def _with_inner(functions: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Give functions, and those of nested pipelines in their place."""
    for name, function in functions.items():
        if isinstance(function, Pipeline):
            yield from _with_inner(function.cg.functions)
        else:
            yield name, function


def lock_cached_values(names: dict[str, Any]) -> None:
    """Have each lru_cache among the names of a module lock the arrays that its function returns."""
    made: dict[int, Any] = {}
    for name, value in [*names.items()]:
        if type(value) is CACHED and is_own(str(value.__module__)):
            if id(value) not in made:
                made[id(value)] = _with_locked_values(value)
            names[name] = made[id(value)]
    for value in [*names.values()]:
        if type(value) is dict:
            value.update({key: made[id(part)] for key, part in value.items() if id(part) in made})


def _with_locked_values(cached: Any) -> Any:
    function = cached.__wrapped__

    def locked_result(*args: Any, **kwargs: Any) -> Any:
        result = function(*args, **kwargs)
        _lock_arrays(result)
        return result

    again = functools.lru_cache(**cached.cache_parameters())(locked_result)
    return functools.update_wrapper(again, function)


def _lock_arrays(value: Any) -> None:
    if is_array(value):
        value.setflags(write=False)
        _lock_arrays(value.base)
    elif type(value) in (tuple, list):
        for part in value:
            _lock_arrays(part)
    elif type(value) is dict:
        for part in value.values():
            _lock_arrays(part)
