"""Names and keywords of EPypes 0.1: they answer with a DeprecationWarning, or an error, that says the new form.

Classes inherit `OldNames`, packages that had other names get ``__getattr__`` from `old_names`, and functions whose
parameters were renamed are decorated with `takes_old_keywords`. What an old name answers is in the table of
``epypes.compat``, which imports the upper rooms and is loaded when an object is first asked for an old name.
"""

from __future__ import annotations

import functools
import importlib
import warnings
from collections.abc import Callable, Mapping
from typing import Any, Final, TypeVar

from epypes.tracebacks import fold_end

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
# Attributes by class; what they answer is in the table.
OLD_MEMBERS: Final[Mapping[str, tuple[str, ...]]] = {
    "CompGraph": ("graph", "to_cg_with_nodes"),
    "CompGraphRunner": (
        "freeze_token", "frozen_tokens", "required_source_tokens", "to_networkx", "token_manager", "token_value",
    ),
    "TokenManager": (
        "free", "free_source_tokens", "freeze_token", "frozen", "frozen_values", "get_values", "save_payload_value",
        "to_networkx", "token_value",
    ),
    "Pipeline": ("cgraph", "get_attr", "modify_frozen_token", "set_attr", "token_value"),
    "EventView": ("cgraph", "get_attr", "modify_frozen_token", "runner", "set_attr", "token_value"),
    "EventLoop": ("is_alive", "set_exception_handler"),
    "Endpoint": ("join",),
    "PayloadError": ("missing_source_tokens",),
}  # fmt: skip
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
        __tracebackhide__ = True
        if kwargs and not _OLD.isdisjoint(kwargs):
            kwargs = _renamed(kwargs)
        try:
            return function(*args, **kwargs)
        except TypeError as error:  # that there is no such parameter has this frame for its last
            fold_end(error)
            raise

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


class _OldName:
    """An attribute that a class had in EPypes 0.1; see docs/from_0_1.md."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, owner: Any, kind: type) -> Any:
        old = None if owner is None else importlib.import_module(_TABLE).member(kind, self._name)
        if old is None:
            raise AttributeError(f"{kind.__name__!r} has no attribute {self._name!r}")
        return old.answer(owner, f"{kind.__name__}.{self._name}", AttributeError)


class OldNames:
    """Answers the attributes that a class had in EPypes 0.1; they are not listed by ``dir()`` of its objects.

    There is no ``__getattr__``: with one, CPython does not specialize any look-up of an attribute, which made an event
    take a fifth longer.
    """

    __slots__ = ()

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if cls.__module__.startswith("epypes."):
            for name in OLD_MEMBERS.get(cls.__name__, ()):
                setattr(cls, name, _OldName(name))

    def __dir__(self) -> list[str]:
        """List the attributes that the class has today."""
        old = {name for kind in type(self).__mro__ for name, value in vars(kind).items() if type(value) is _OldName}
        return [name for name in super().__dir__() if name not in old]


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
