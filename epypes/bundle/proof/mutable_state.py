"""Mutable state that a bundle's functions refer to: locked where it is an array, else compared after each call.

No answer may depend on an earlier event. Promotion refuses functions that plainly write to what outlives their call;
syntax can't show all of it. So each function of a loaded bundle that refers to a mutable object is wrapped: after its
call, a snapshot of these objects is compared; if one has changed, it is put back and the call raises StateChanged.
For functions that refer only to constants, which are most, settings alone are compared, which takes some 2 us.

How Python and libraries are set, and the variables of the context, are compared after each call of the user's
functions. What a call sets in its context is gone with that; what else it has set is put back. A function that may set
something for all threads until it is done never runs beside another one. The global random generators begin each event
as they were when the bundle was loaded.

Calls in several threads share the objects. Where a call finds a change and other calls ran meanwhile, any of them may
have made it, or have read it: each of them is called again, alone, on objects that have been put back.

What a guarded call calls is part of it. Its context says so, which also reaches the helper threads of a runner, but not
those of a function's own ``ThreadPoolExecutor``. There a node that a function refers to is part of the calls that are
running: to wait for one of them could be to wait for its own caller.
"""

from __future__ import annotations

import functools
import itertools
import sys
import threading
import types
from collections.abc import Callable, Iterator, Mapping
from contextvars import ContextVar, copy_context
from typing import Any, Final

from epypes.bundle.proof.code_snapshot import LRU_CACHE, CodeSnapshot, checked_cache
from epypes.bundle.proof.process_settings import GlobalGenerators, ProcessSettings, is_setting
from epypes.errors import StateChanged
from epypes.graph import as_switch, is_placeholder
from epypes.pipeline import Node, Pipeline
from epypes.pipeline.node import wrap_calls
from epypes.run.guard import WATCH, WRITTEN, is_unguarded

# What the code of Cython says of an array that it doesn't take.
_READ_ONLY: Final = "buffer source array is read-only"
# Code with one of these may set something for all threads until it is done.
_SETS_FOR_A_WHILE: Final = frozenset(
    {"chdir", "field_size_limit", "option_context", "patch", "rcParams", "rc_context", "redirect_stderr"}
    | {"redirect_stdout", "register_dialect", "reset_option", "set_option", "setfirstweekday", "setlocale"}
)


# -- calls ---------------------------------------------------------------------------------------------------------

# The lock that a guarded call in this context holds. What that calls is part of it, also in a runner's helper threads.
_held: ContextVar[object] = ContextVar("_held", default=None)


class MutableState:
    """Guards the functions of one loaded bundle.

    Parameters
    ----------
    functions
        All of them, by name; nested pipelines are looked through.
    hyperparameters
        Values by token. A runner copies containers for each call, and not what is in them.
    """

    def __init__(self, functions: Mapping[str, Callable[..., Any]], hyperparameters: Mapping[str, Any]) -> None:
        self._lock, self._settings, self._generators = _ReadersWriterLock(), ProcessSettings(), GlobalGenerators()
        self._shared = {
            f"hyperparameter {token}": value for token, value in hyperparameters.items() if _has_containers(value)
        }
        self._compared: dict[int, object] = {}
        # The nodes, also of pipelines, that functions refer to and may call themselves, by id.
        self._referred: dict[int, Node] = {}
        for name, function in _with_inner(functions):
            if is_unguarded(function):
                # It rejects read-only arrays.
                CodeSnapshot({name: function}, self._compared, lock=False)

    def guarded(self, functions: Mapping[str, Callable[..., Any]]) -> dict[str, Callable[..., Any]]:
        """Have runners and nodes call what compares the state of these functions; return them, odd kinds wrapped.

        Nodes, and those of nested pipelines, are changed in place.
        """
        return {name: self._guarded(name, function) for name, function in functions.items()}

    def _guarded(self, name: str, function: Any) -> Any:
        if is_placeholder(function) or as_switch(function) is not None:
            return function
        if isinstance(function, Pipeline):
            self.guarded(function.network.nodes)
            return function
        function = checked_cache(function)
        snapshot = CodeSnapshot({**self._shared, name: function}, self._compared)
        self._settings.add(snapshot.words)
        is_of_user = snapshot.has_code or bool(snapshot)
        if not is_of_user and not self._settings.is_set_by(function):
            return function
        if is_of_user and type(function) in (types.FunctionType, functools.partial, LRU_CACHE):
            # It stays what the module defines, so that it can be promoted again.
            setattr(function, WATCH, functools.partial(self._guarded_call, function=function, snapshot=snapshot))
            self._refer_to(snapshot.nodes)
            return function
        if not isinstance(function, Node):
            return self._guarded_call(name, function, snapshot)
        self._refer_to({key: node for key, node in snapshot.nodes.items() if node is not function})
        wrap_calls(function, lambda called: self._guarded_call(name, called, snapshot, function))
        return function

    def _refer_to(self, nodes: Mapping[int, Node]) -> None:
        for key, node in nodes.items():
            self._referred[key] = node
            if isinstance(node, Pipeline):
                self._refer_to({id(inner): inner for inner in node.network.nodes.values()})

    def _guarded_call(
        self, name: str, function: Callable[..., Any], snapshot: CodeSnapshot, node: Node | None = None
    ) -> Callable[..., Any]:
        lock, referred, settings = self._lock, self._referred, self._settings
        draws = bool(snapshot.draws or snapshot.seeds) or self._generators.are_drawn_by(snapshot.words)
        has_resets = draws or bool(snapshot.resets) or not _SETS_FOR_A_WHILE.isdisjoint(snapshot.words)
        attempt = functools.partial(_attempt, function, snapshot if snapshot else None, settings)

        @functools.wraps(function)
        def call(*args: Any, __tracebackhide__: bool = True, **kwargs: Any) -> Any:
            nonlocal attempt
            # Another call of the bundle may have made this one in a thread of its own, which has no context.
            ticket = lock.acquire_read(only_if_free=id(node) in referred) if _held.get() is not lock else None
            if ticket is None:
                return function(*args, **kwargs)
            is_exclusive, is_restored, token = has_resets or snapshot.is_unlocking, True, _held.set(lock)
            try:
                if is_exclusive:
                    lock.upgrade(ticket)
                    if snapshot.changed() is not None:  # by a call that waits to put it back
                        snapshot.restored()
                    if draws:
                        self._generators.begin(name)
                result, error, changed = attempt(args, kwargs)
                if type(error) is ValueError and _READ_ONLY in str(error) and not snapshot.is_unlocking:
                    is_exclusive = is_exclusive or lock.upgrade(ticket) or True
                    snapshot.begin_unlocking()
                    attempt = functools.partial(_attempt, function, snapshot, settings)
                    result, error, changed = attempt(args, kwargs)
                if changed is not None:
                    was_alone = is_exclusive or lock.upgrade(ticket)
                    is_exclusive = True
                    if not was_alone or not settings.is_known():
                        found, first = settings.now(), (result, error)
                        snapshot.restored()
                        settings.restored()
                        result, error, changed = attempt(args, kwargs)
                        if was_alone and changed is None:  # they were set between two calls
                            settings.set_to(found)
                            result, error = first
                        del first
                    is_restored = changed is None or snapshot.restored() & settings.restored()
            finally:
                _held.reset(token)
                lock.release(ticket, is_exclusive)
            try:
                if error is not None:
                    raise error
                if changed:
                    raise StateChanged(name, changed, is_restored, is_setting=is_setting(changed))
                return result
            finally:
                del error, result

        vars(call).pop(WATCH, None)
        setattr(call, WRITTEN, function)
        return call


def _attempt(
    function: Callable[..., Any], snapshot: CodeSnapshot | None, settings: ProcessSettings, args: Any, kwargs: Any
) -> tuple[Any, BaseException | None, str | None]:
    """Call a function; return its result, what it has raised, and what it has changed that outlives the call."""
    # What the call sets in the context is gone with that.
    __tracebackhide__, context, modules, error = True, copy_context(), len(sys.modules), None
    unlocked = snapshot if snapshot is not None and snapshot.is_unlocking else None
    if unlocked is not None:
        unlocked.set_locks(False)
    try:
        result = context.run(function, *args, **kwargs)
    except BaseException as raised:
        result, error = None, raised
    if unlocked is not None:
        unlocked.set_locks(True)
    changed = None
    if snapshot is not None:
        snapshot.reset()
        changed = snapshot.changed()
    try:
        return result, error, settings.changed(context, modules) if changed is None else changed
    finally:
        # The exception refers to this frame, which refers to the exception, and to the images of the call.
        del error, result


class _ReadersWriterLock:
    """A lock that calls share as readers, each of which may become the writer, which has the objects alone.

    Readers that wait to become the writer count as ended, so they don't wait for one another. No reader begins then.
    To begin and to end as a reader takes no lock: the dict of those that run is changed in one step each time.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition(threading.Lock())
        # The readers that are running, by number; how many are, or wait to become, the writer; the number begun last.
        self._running: dict[int, bool] = {}
        self._writers = self._begun = 0
        self._numbers = itertools.count(1)

    def acquire_read(self, *, only_if_free: bool = False) -> int | None:
        """Begin as a reader; return a ticket for ``upgrade`` and ``release``: a negative one if others are running.

        With ``only_if_free`` nothing is acquired, and None is returned, where others are running.
        """
        while True:
            if only_if_free and (self._running or self._writers):
                return None
            number = next(self._numbers)
            self._running[number] = True
            self._begun = number
            if not self._writers:
                return number if len(self._running) == 1 else -number
            with self._changed:
                del self._running[number]
                self._changed.notify_all()
                while self._writers:
                    self._changed.wait()

    def upgrade(self, ticket: int) -> bool:
        """Become the writer when all other readers have ended; return whether none ran since the ticket was given."""
        with self._changed:
            was_alone = ticket == self._begun
            self._writers += 1
            del self._running[abs(ticket)]
            self._changed.notify_all()
            try:
                while self._running:
                    self._changed.wait()
            finally:
                self._running[abs(ticket)] = True
            return was_alone

    def release(self, ticket: int, is_writer: bool) -> None:
        """End as a reader or as the writer."""
        del self._running[abs(ticket)]
        if self._writers:
            with self._changed:
                self._writers -= is_writer
                self._changed.notify_all()


def _has_containers(value: Any) -> bool:
    """Whether a container has others in it that can change."""
    parts = [*value.values()] if type(value) is dict else value if type(value) in (list, tuple) else ()
    return any(type(part) in (list, dict, set) or _has_containers(part) for part in parts)


def _with_inner(functions: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Give functions, and those of nested pipelines instead of the pipelines."""
    for name, function in functions.items():
        if isinstance(function, Pipeline):
            yield from _with_inner(function.cg.functions)
        else:
            yield name, function
