"""Safe introspection: the kind and the parts of a value, without running a line of its class.

A class may say of itself what it likes, and compute or raise when it is asked. So Python's own slots are read, and
what is known of a value is only what its classes are, by identity.
"""

from __future__ import annotations

import dataclasses
import sys
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from types import FunctionType, GetSetDescriptorType, MappingProxyType, MemberDescriptorType, SimpleNamespace
from typing import Any, Final

from epypes.errors import InvalidType

# The name of a class, its name within its module, and the class with its parents in the order in which Python asks
# them. These never raise, whatever a metaclass says.
kind_name: Final[Callable[[type], str]] = type.__dict__["__name__"].__get__
qualified_name: Final[Callable[[type], str]] = type.__dict__["__qualname__"].__get__
parents: Final[Callable[[type], tuple[type, ...]]] = type.__dict__["__mro__"].__get__
# A text whose class is str, whatever a subclass makes of its methods.
plain_text: Final[Callable[[str], str]] = str.__str__
_module_of: Final = type.__dict__["__module__"].__get__
_attributes_of: Final = type.__dict__["__dict__"].__get__
# Their length is known to Python itself. Subclasses may compute theirs, and are asked for that of their parent.
_SIZED: Final[tuple[Any, ...]] = (
    list, tuple, set, frozenset, OrderedDict, dict, deque, str, bytes, bytearray, range,
    type({}.keys()), type({}.values()), type({}.items()),
)  # fmt: skip
_ITERABLE: Final[tuple[Any, ...]] = (list, tuple, set, frozenset, deque)
_MAPPINGS: Final[tuple[Any, ...]] = (OrderedDict, dict, MappingProxyType)
_PANDAS: Final = ("DataFrame", "Series", "Index")


def dotted_name(kind: type) -> str:
    """Return where a class is from, ``"package.module.Pose"``; never raises."""
    try:
        return f"{plain_text(_module_of(kind))}.{qualified_name(kind)}"
    except (AttributeError, TypeError):  # a class may have lost its module, or have a number as one
        return qualified_name(kind)


def declared(kind: type, name: str) -> Any:
    """Return an attribute as it stands in a class or the nearest of its parents; None if there is none."""
    for parent in parents(kind):
        attributes = _attributes_of(parent)
        if name in attributes:
            return attributes[name]
    return None


def stored(value: Any, name: str) -> tuple[Any, ...]:
    """Return a tuple of the attribute that an object holds itself, or of its class's constant; else an empty one."""
    kind = type(value)
    descriptor, own = declared(kind, name), declared(kind, "__dict__")
    if type(own) is GetSetDescriptorType and name in (attributes := own.__get__(value)):
        return (attributes[name],)
    if type(descriptor) is MemberDescriptorType:
        return (descriptor.__get__(value),)
    return () if descriptor is None or declared(type(descriptor), "__get__") is not None else (descriptor,)


def is_of(value: Any, package: str, *names: str) -> bool:
    """Whether a value is of one of these classes of a package, if that is imported by now."""
    module = sys.modules.get(package)
    if module is None:
        return False
    ancestors = parents(type(value))
    for name in names:
        known = getattr(module, name, None)
        # By identity, since a class may say of itself that it equals another.
        if any(known is parent for parent in ancestors):
            return True
    return False


def is_array(value: Any) -> bool:
    """Whether a value is an array or a number of numpy."""
    return is_of(value, "numpy", "ndarray", "generic")


def length_of(value: Any) -> int:
    """Return the length of a value of which it is known without computing; 0 of any other."""
    known = _first_of(_SIZED, value)
    if known is not None:
        return int(known.__len__(value))
    return len(value) if is_of(value, "pandas", *_PANDAS) else 0


def items_in(value: Any) -> Iterator[Any]:
    """Return the items of a list, tuple, set or deque, or of what is of a subclass."""
    known = _first_of(_ITERABLE, value)
    if known is None:
        raise InvalidType(f"the items of {kind_name(type(value))} are not known")
    found: Iterator[Any] = known.__iter__(value)
    return found


def pairs_in(value: Any) -> Iterator[tuple[Any, Any]]:
    """Return the keys and values of a dict, or of what is of a subclass."""
    known = _first_of(_MAPPINGS, value)
    if known is None:
        raise InvalidType(f"the items of {kind_name(type(value))} are not known")
    return iter(known.items(value))


def _first_of(kinds: Iterable[Any], value: Any) -> Any:
    kind = type(value)
    for known in kinds:
        if issubclass(kind, known):
            return known
    return None


def sorted_items(value: Any, written: Callable[[Any], str], most: int = 2_000) -> list[Any]:
    """Return the items of a set in an order that is the same in every process; none of a very large one.

    Items are compared with their like: numbers and texts by what they are, all others by how they are written, since
    to compare them is their authors' affair.
    """
    if length_of(value) > most:
        return []

    def rank(item: Any) -> tuple[str, bool, Any]:
        is_plain = type(item) in (int, float, str, bytes)
        return kind_name(type(item)), is_plain, item if is_plain else written(item)

    return sorted(items_in(value), key=rank)


_ATTRIBUTES: Final[Any] = declared(SimpleNamespace, "__dict__")


def fields_of(value: Any) -> dict[str, Any] | None:
    """Return the fields of a named tuple, or of a dataclass that Python writes by its fields; None of any other.

    Fields that are not to be in the repr are left out, and those that a property computes.
    """
    kind = type(value)
    if issubclass(kind, tuple):
        names = declared(kind, "_fields")
        return dict(zip(names, items_in(value), strict=False)) if type(names) is tuple else None
    if declared(kind, "__repr__") is SimpleNamespace.__repr__:
        return dict(_ATTRIBUTES.__get__(value))
    # Those that Python writes: a repr of the author's own may be to hide something. It is recognized as pprint does it.
    made = getattr(declared(kind, "__repr__"), "__wrapped__", None)
    if type(declared(kind, "__dataclass_fields__")) is not dict or type(made) is not FunctionType:
        return None
    if "__create_fn__" not in made.__qualname__:
        return None
    fields = ((field.name, stored(value, field.name)) for field in dataclasses.fields(kind) if field.repr)
    return {name: found[0] for name, found in fields if found}


def silent_numpy() -> AbstractContextManager[Any]:
    """Return what keeps numpy from warning of numbers that overflow or are none: they are counted, and shown."""
    numpy = sys.modules.get("numpy")
    return nullcontext() if numpy is None else numpy.errstate(all="ignore")


_is_in_users_code: Final = ContextVar("_is_in_users_code", default=False)
# Whether a preview function or a repr of a user's runs meanwhile. One that shows the run that its own value is in would
# never come to an end: values are named only.
is_in_users_code: Final = _is_in_users_code.get


@contextmanager
def users_code() -> Iterator[None]:
    """Call what a user has written of a value."""
    token = _is_in_users_code.set(True)
    try:
        yield
    finally:
        _is_in_users_code.reset(token)
