"""What does a wrapper hold besides what it wraps, and would its decorator make that again?"""

from __future__ import annotations

import ast
import inspect
import types
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any, Final

from epypes.bundle.changes import changes, is_container
from epypes.bundle.evaluate import is_same
from epypes.bundle.literal import is_data
from epypes.bundle.remade import is_same_value, makers, pure_value, unlike, with_inner
from epypes.bundle.source import evaluated, importable
from epypes.bundle.text import definition_of, first_line
from epypes.run.guard import WATCH

# Objects of libraries hold much that is no function of the notebook.
_MOST: Final = 500


def own_state(
    made_by: types.FunctionType, wrapper: types.FunctionType, wrapped: Any, given: Mapping[str, Any],
    names: Mapping[str, Any],
) -> str:  # fmt: skip
    """Return why a decorator of the notebook would not make a wrapper again; "" if nothing speaks against it.

    Parameters
    ----------
    made_by
        The decorator, or the function that returns it.
    wrapper, wrapped
        What it made, of what.
    given
        What its text gives to the decorator, by parameter.
    names
        The names of the notebook.
    """
    hung = [name for name in wrapper.__dict__.keys() - wrapped.__dict__.keys() if name not in ("__wrapped__", WATCH)]
    if hung:
        return f"which hangs {min(hung)!r} on it, where it may keep something from call to call"
    _, node = definition_of(made_by.__code__)
    parts = (part for part in (ast.walk(node) if node else ()) if isinstance(part, ast.FunctionDef | ast.Lambda))
    inner = [part for part in parts if _is_of(part, wrapper.__code__)]
    around = makers(node, inner[0]) if node and len(inner) == 1 else None
    if around is None:
        return "which does not always define what it returns"
    captured = captured_by(wrapper)
    known = {**names, **captured}
    for part, name in changes(inner[0], known):
        if name in captured and (not isinstance(part, ast.Call) or is_container(captured[name])):
            return f"which keeps something in {name!r} from call to call"
    every = with_inner(captured, made_by.__code__)
    known_values = {**_defaults(made_by), **given}
    known_values |= {name: value for name, value in every.items() if value is wrapped or value is wrapper}
    kept = unlike(around, every, known_values, names) or _other_default(inner[0], wrapper, {**known, **known_values})
    return f"which keeps {kept!r}, of which the text does not say that it is the same by now" if kept else ""


def captured_by(wrapper: types.FunctionType) -> dict[str, Any]:
    """Return what a function has from the functions around it, by name."""
    cells = zip(wrapper.__code__.co_freevars, wrapper.__closure__ or (), strict=True)
    return {name: cell.cell_contents for name, cell in cells}


def _is_of(part: ast.FunctionDef | ast.Lambda, code: types.CodeType) -> bool:
    if isinstance(part, ast.Lambda):
        return code.co_name == "<lambda>" and part.lineno == code.co_firstlineno
    return part.name == code.co_name and first_line(part) == code.co_firstlineno


def _defaults(function: Callable[..., Any]) -> dict[str, Any]:
    parameters = inspect.signature(function).parameters.values()
    return {one.name: one.default for one in parameters if one.default is not inspect.Parameter.empty}


def _other_default(node: ast.FunctionDef | ast.Lambda, wrapper: types.FunctionType, names: Mapping[str, Any]) -> str:
    """Return the text of a wrapper's default that means something else by now; "" if there is none."""
    arguments = node.args
    named = wrapper.__kwdefaults__ or {}
    pairs = [*zip(arguments.defaults, wrapper.__defaults__ or (), strict=False)]
    pairs += [
        (default, named.get(argument.arg))
        for argument, default in zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)
        if default is not None
    ]
    other = (given for given, value in pairs if not is_same_value(pure_value(given, names), value))
    return next(map(ast.unparse, other), "")


def library_state(decorator: ast.expr, wrapper: Any, wrapped: Any, names: Mapping[str, Any]) -> str:
    """Return why the decorator of a library may not make a wrapper again; "" if nothing speaks against it."""
    for held in _held(wrapper, wrapped):
        if isinstance(held, Mapping) and len(held) > 1 and any(value is wrapped for value in held.values()):
            return "which knows other functions besides it that were registered later"
        if isinstance(held, types.FunctionType) and held.__module__ == "__main__":
            return f"which holds another function of the notebook, {held.__name__!r}"
    captured = captured_by(wrapper) if isinstance(wrapper, types.FunctionType) else {}
    given = [*decorator.args, *(part.value for part in decorator.keywords)] if isinstance(decorator, ast.Call) else []
    for expression in given:
        if not _is_fixed(expression, names) and not any(is_same(expression, one, names) for one in captured.values()):
            return f"whose argument {ast.unparse(expression)!r} may have had another value: write the value itself"
    return ""


def _is_fixed(expression: ast.expr, names: Mapping[str, Any]) -> bool:
    """Whether an expression means the same whatever the notebook has done since: literals, and what is imported."""
    read = [part for part in ast.walk(expression) if isinstance(part, ast.Name)]
    values = [evaluated(part, names) for part in read if part.id in names]
    return not any(is_data(value) or _is_own(value) for value in values)


def _is_own(value: Any) -> bool:
    return not isinstance(value, types.ModuleType) and importable(value) is None


def _held(wrapper: Any, wrapped: Any) -> Iterator[Any]:
    """Give what a wrapper holds: in its attributes, in what it has captured, in containers of these."""
    waiting, seen = [wrapper], {id(wrapped)}
    while waiting and len(seen) < _MOST:
        one = waiting.pop(0)
        if id(one) in seen:
            continue
        seen.add(id(one))
        if one is not wrapper:
            yield one
        waiting.extend(_inside(one, is_outermost=one is wrapper))


def _inside(one: Any, *, is_outermost: bool) -> Collection[Any]:
    if isinstance(one, dict | types.MappingProxyType):
        return list(one.values())
    if isinstance(one, list | tuple | set | frozenset):
        return list(one)
    if isinstance(one, types.FunctionType) and one.__module__ == "__main__" and not is_outermost:
        return ()
    if isinstance(one, types.FunctionType):
        cells = [cell.cell_contents for cell in one.__closure__ or () if cell != types.CellType()]
        return [*cells, *one.__dict__.values()]
    return [*vars(one).values()] if is_outermost and hasattr(one, "__dict__") else ()
