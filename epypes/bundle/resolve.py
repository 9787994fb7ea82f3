"""The resolution of an object: the name under which it can be imported, if it has one.

Objects are looked up by identity, never by name: a name may mean another function by now.
"""

from __future__ import annotations

import ast
import sys
import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final


class Refused(Exception):
    """One reason why something can't be promoted; collected, then raised together as PromotionRefused."""


@dataclass(frozen=True, slots=True)
class Importable:
    """An object that ``module`` has as ``qualname``."""

    module: str
    qualname: str


def importable(value: Any, *names: str) -> Importable | None:
    """Return a public name under which an object can be imported, if it has one.

    Parameters
    ----------
    value
        A function, class or other object.
    names
        Names that it may have in its module besides its own.
    """
    module = getattr(value, "__module__", None)
    qualname = getattr(value, "__qualname__", None) or getattr(value, "__name__", None)
    if module == "__main__":
        return None
    fallback = None
    if isinstance(module, str) and isinstance(qualname, str) and _reach(module, qualname) is value:
        fallback = Importable(_public_module(module, qualname, value), qualname)
        if not fallback.module.startswith("_"):
            return fallback
    # C functions and the special forms of typing often know their name, but not their module.
    own = (getattr(value, "__name__", None), getattr(value, "_name", None))
    for name in dict.fromkeys(name for name in (*own, *names) if isinstance(name, str) and name.isidentifier()):
        home = min(_modules_with(name, value), key=_plainness, default=None)
        if home is not None:
            return Importable(home, name)
    return fallback


def _reach(module: str, qualname: str) -> Any:
    found: Any = sys.modules.get(module)
    for part in qualname.split("."):
        found = getattr(found, part, None)
    return found


def _public_module(module: str, qualname: str, value: Any) -> str:
    """Return the package if it shows the object, else its own module; of a private one, the shortest that shows it."""
    # _functools is what functools is made of.
    top = module.partition(".")[0].lstrip("_")
    if _reach(top, qualname) is value:
        return top
    if "._" not in module and not module.startswith("_"):
        return module
    shown = (name for name in list(sys.modules) if name.partition(".")[0] == top and "._" not in name)
    homes = [name for name in shown if not name.startswith("_") and _reach(name, qualname) is value]
    return min(homes, key=_plainness, default=module)


def _plainness(module: str) -> tuple[int, int, str]:
    return module.count("."), len(module), module


def _modules_with(name: str, value: Any) -> Iterator[str]:
    for module_name, module in list(sys.modules.items()):
        if module_name.startswith("_") or "._" in module_name or module_name == "__main__":
            continue
        if isinstance(module, types.ModuleType) and vars(module).get(name) is value:
            yield module_name


def evaluated(expression: ast.expr, names: Mapping[str, Any]) -> Any:
    """Look up a dotted name; None for any other expression."""
    if isinstance(expression, ast.Name):
        return names.get(expression.id)
    if isinstance(expression, ast.Attribute):
        return getattr(evaluated(expression.value, names), expression.attr, None)
    return None


# A wrapper may be made to wrap itself; a hundred layers are no accident of a notebook.
_DEEPEST: Final = 100


def layers(function: Any) -> list[Any]:
    """Return a function, what it wraps, and so on down to what wraps nothing."""
    found = [function]
    while len(found) < _DEEPEST and "__wrapped__" in getattr(found[-1], "__dict__", {}):
        found.append(found[-1].__wrapped__)
    return found
