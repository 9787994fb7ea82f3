"""The registry of functions that look at values, by type.

Kinds are classes or their dotted names, so that a package is known without being imported. A value is looked at by the
function of the first class in its method resolution order that has one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, TypeVar, overload
from weakref import WeakKeyDictionary

from epypes.display.previews.introspection import dotted_name, kind_name, parents
from epypes.display.previews.model import Look
from epypes.run.guard import lend_to_reader

_Function = TypeVar("_Function", bound=Callable[[Any], Any])
# What a preview function may return is checked where it is called.
PreviewFunction = Callable[[Any, Look], Any]
_BuiltIn = TypeVar("_BuiltIn", bound=PreviewFunction)


class _Registry:
    """Functions by class, and by a class's dotted name."""

    def __init__(self) -> None:
        # Weak, so that a class of a notebook that was defined again can go.
        self._by_class: WeakKeyDictionary[type, PreviewFunction] = WeakKeyDictionary()
        self._by_name: dict[str, PreviewFunction] = {}
        self.revision = 0

    def add(self, kind: type | str, function: PreviewFunction) -> None:
        """Take a function for a class or a dotted name; it replaces an earlier one."""
        self.revision += 1
        if isinstance(kind, type):
            self._by_class[kind] = function
        else:
            self._by_name[kind] = function

    def get(self, kind: type) -> PreviewFunction | None:
        """Return the function of this very class."""
        found = self._by_class.get(kind)
        return found if found or not self._by_name else self._by_name.get(dotted_name(kind))


_built_in: Final = _Registry()
_users: Final = _Registry()


def preview_function_of(kind: type) -> PreviewFunction:
    """Return the function that looks at values of a class; of two for one class, the user's."""
    for parent in parents(kind):
        found = _users.get(parent) or _built_in.get(parent)
        if found is not None:
            return found
    raise TypeError(f"nothing is registered for {kind_name(kind)}")


def is_shown_by_user(kind: type) -> bool:
    """Whether a user's function looks at values of a class, or of one of its parents."""
    return any(map(_users.get, parents(kind)))


def users_revision() -> int:
    """Return how often a user has registered a function."""
    return _users.revision


def built_in(*kinds: type | str) -> Callable[[_BuiltIn], _BuiltIn]:
    """Register a function of this package, as a decorator."""

    def register(function: _BuiltIn) -> _BuiltIn:
        for kind in kinds:
            _built_in.add(kind, function)
        return function

    return register


@overload
def register_preview(kind: type | str, function: None = None) -> Callable[[_Function], _Function]: ...
@overload
def register_preview(kind: type | str, function: _Function) -> _Function: ...
def register_preview(kind: type | str, function: Callable[[Any], Any] | None = None) -> Any:
    """Register how values of a type are shown in pictures of graphs and runs.

    Parameters
    ----------
    kind
        The class, whose subclasses are then shown so too, or its dotted name, ``"package.module.Pose"``, which
        imports nothing.
    function
        Takes a value, arrays read-only, and returns a short text, an image (an array as OpenCV has it), or a
        ``Preview``. It runs whenever a picture of a graph or run with such a value is made, so it should be quick and
        change nothing. If it raises, the reason is shown in place; what it shows itself meanwhile has no previews.

    Returns
    -------
    callable
        The function; without one, a decorator.

    Raises
    ------
    TypeError
        The kind is neither class nor name, or the function can't be called.

    Examples
    --------
    >>> class Pose:
    ...     x = 3
    >>> @register_preview(Pose)
    ... def show_pose(pose):
    ...     return f"x = {pose.x}"
    """
    if not isinstance(kind, type) and not (isinstance(kind, str) and "." in kind):
        raise TypeError(f"A preview is registered for a class or its dotted name, 'module.Class', not {kind!r}.")
    if function is None:
        return lambda given: register_preview(kind, given)
    if not callable(function):
        raise TypeError(f"The preview of {kind!r} must be a function that takes the value, not {function!r:.60}.")
    # As for the functions of a graph: what is shown can't be spoilt.
    _users.add(kind, lambda value, look: function(lend_to_reader(value)))
    return function
