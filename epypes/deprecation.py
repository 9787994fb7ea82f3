"""Names and keywords of EPypes 0.1: they answer with a DeprecationWarning, or an error, that says the new form.

Classes inherit `OldNames`, packages that had other names get ``__getattr__`` from `old_names`, and functions whose
parameters were renamed are decorated with `takes_old_keywords`. What an old name answers is in the table of
``epypes.compat``, which imports the upper rooms and is loaded when an object is first asked for an attribute that it
has not.
"""

from __future__ import annotations

import functools
import importlib
import warnings
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Final, TypeVar

F = TypeVar("F", bound=Callable[..., Any])

# New names of parameters by old ones.
RENAMED: Final[Mapping[str, str]] = {
    "comp_graph": "cg",
    "frozen_tokens": "hparams",
    "event_dispatcher": "f_in",
    "out_prep_func": "f_out",
    "q": "q_in",
    "callback_func": "callback",
    "callback_pipeline": "callback",
}
# Parameters that are gone: what to write in their place.
REMOVED: Final[Mapping[str, str]] = {
    "func_v_attr": "networkx.set_node_attributes(graph, ...)",
    "token_v_attr": "networkx.set_node_attributes(graph, ...)",
    "edge_attr": "networkx.set_edge_attributes(graph, ...)",
}
_OLD: Final = frozenset({*RENAMED, *REMOVED})
_TABLE: Final = "epypes.compat"
_PAGE: Final = "See docs/from_0_1.md."


def describe(old: str, new: str) -> str:
    """Return the sentence that a warning or an error says."""
    return f"{old} is of EPypes 0.1. Write {new}. {_PAGE}"


def takes_old_keywords(function: F) -> F:
    """Have a function take the parameters that were renamed under their old names too; those that are gone raise."""

    @functools.wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        if kwargs and not _OLD.isdisjoint(kwargs):
            kwargs = _renamed(kwargs)
        return function(*args, **kwargs)

    return wrapper  # type: ignore[return-value]


def _renamed(given: Mapping[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in given.items():
        if name in REMOVED:
            raise TypeError(describe(f"{name}=", REMOVED[name]))
        new = RENAMED.get(name, name)
        if new in found or (new != name and new in given):
            raise TypeError(f"{new}= is given twice: {name}= is its name in EPypes 0.1.")
        if new != name:
            warnings.warn(describe(f"{name}=", f"{new}="), DeprecationWarning, stacklevel=3)
        found[new] = value
    return found


class OldNames:
    """Answers the attributes that a class had in EPypes 0.1; they are not listed by ``dir()``."""

    __slots__ = ()

    if not TYPE_CHECKING:  # a type checker would take any name for an attribute

        def __getattr__(self, name: str) -> Any:
            if not name.startswith("_"):
                old = importlib.import_module(_TABLE).member(type(self), name)
                if old is not None:
                    return old.answer(self, f"{type(self).__name__}.{name}", AttributeError)
            # Raises what brought us here: also an AttributeError inside a property.
            return object.__getattribute__(self, name)


def old_names(module: str) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a module that had other names in EPypes 0.1."""

    def get(name: str) -> Any:
        if not name.startswith("_"):
            old = importlib.import_module(_TABLE).MODULES[module].get(name)
            if old is not None:
                # What an `import` statement raises; it would hide the text of an AttributeError.
                return old.answer(None, f"{module}.{name}", ImportError)
        raise AttributeError(f"module {module!r} has no attribute {name!r}")

    return get
