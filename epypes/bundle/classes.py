"""What does a class of the notebook need to stand in a module of its own?

Like functions, classes are looked up by object, and nothing is believed: a text is taken only if its methods compile to
the code that the class has, and its attributes are what the text gives them.
"""

from __future__ import annotations

import ast
import dis
import linecache
import sys
import types
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

from epypes.bundle.cells import place_in
from epypes.bundle.classvalues import (
    IN_STEPS,
    bound_names,
    defaults_in,
    is_other,
    is_value,
    names_in,
    unknown_in,
    values_of_fields,
)  # fmt: skip
from epypes.bundle.source import Refused, evaluated
from epypes.bundle.text import class_code, lines_in, nested_codes, own_text, parsed, same_methods
from epypes.bundle.uses import names_from_outside

# What Python itself puts into every class.
_ALWAYS: Final = frozenset({"__module__", "__qualname__", "__annotations__", "__doc__", "__classcell__"})
# What a NamedTuple has of its own.
_OF_TUPLES: Final = frozenset({"_fields", "_field_defaults", "_field_types"})


@dataclass(frozen=True, slots=True)
class ClassDefinition:
    """A class's definition in the notebook.

    Attributes
    ----------
    text
        Its source with the comment above it and its decorators, not indented.
    node
        Its syntax tree.
    place
        Cell and line, for people.
    code
        What that text compiles to, as a module.
    names
        The names of the notebook.
    file
        The file or cell that it is from, as Python knows it.
    captured
        Nothing: a class inside of a function is not taken.
    """

    name: str
    text: str
    node: ast.ClassDef
    place: str
    code: types.CodeType
    names: Mapping[str, Any]
    file: str
    captured: Mapping[str, Any] = field(default_factory=dict)

    @property
    def line(self) -> int:
        """Where it begins."""
        return self.node.lineno

    def place_of(self, name: str) -> str:
        """Return where it uses a name, for people."""
        uses = (node.lineno for node in ast.walk(self.node) if isinstance(node, ast.Name) and node.id == name)
        return place_in(self.file, next(uses, self.line))


def class_definition(kind: type, around: Mapping[str, Any], what: str) -> ClassDefinition:
    """Return the source of a class that was defined in the notebook or the main script.

    Parameters
    ----------
    kind
        The class.
    around
        The names where it was found, which are those of the notebook if it has no method that knows them.
    what
        How to call it in a reason, as ``"Class 'Blur'"``.

    Raises
    ------
    Refused
        Its source is not to be had, or says something else.
    """
    if kind.__qualname__ != kind.__name__:
        text = f"{what} is defined inside {kind.__qualname__.rpartition('.')[0]!r}"
        raise Refused(f"{text}. Define it at the margin of a cell.")
    why = ""
    for file in _files(kind):
        lines = lines_in(file)
        for node in _classes(lines, kind.__name__):
            problem = next(_differences(kind, node, "".join(lines), around), "")
            if not problem:
                return _definition(kind, around, what, file, lines, node)
            why = why or f"{problem} ({place_in(file, node.lineno)})"
    if not why:
        way_out = "Write a class statement for it, as class P(typing.NamedTuple), and make again what was made of it."
        raise Refused(f"{what} has no class statement: it was made by a call. {way_out}")
    raise Refused(f"{what} is not to be had as text: {why}. Define it in a cell again, and what was made of it.")


def _definition(
    kind: type, around: Mapping[str, Any], what: str, file: str, lines: list[str], node: ast.ClassDef
) -> ClassDefinition:
    names = _names(kind, around)
    place = place_in(file, node.lineno)
    _check_bases(kind, node, names, f"{what} ({place})")
    _check_known(kind, node, names, what, file)
    text = own_text(lines, node, ())
    code = class_code(text, node)
    if code is None:
        raise Refused(f"{what} means something else if its text is moved to another place ({place}).")
    for inside in nested_codes(code):
        for instruction in dis.get_instructions(inside):
            if instruction.opname in ("STORE_GLOBAL", "DELETE_GLOBAL"):
                text = f"{what} changes the global {instruction.argval!r} ({place})."
                raise Refused(f"{text} Keep it in the object.")
    return ClassDefinition(kind.__name__, text, node, place, code, names, file)


def class_names(found: ClassDefinition) -> Iterator[str]:
    """Return the names that a class reads from outside when it is defined or used, each once, in order of use."""
    names: dict[str, None] = {}
    for code in nested_codes(found.code):
        names.update(dict.fromkeys(names_from_outside(code)))
    names.pop(found.name, None)
    return iter(names)


def functions_of(kind: type) -> dict[str, types.FunctionType]:
    """Return the functions of a class that were written for it, by name; of a property, its first."""
    found = {name: list(_functions_in(value)) for name, value in vars(kind).items()}
    return {name: functions[0] for name, functions in found.items() if functions}


def _functions_in(value: Any) -> Iterator[types.FunctionType]:
    """Give the functions that an attribute of a class is made of; none that a library has made, as dataclasses do."""
    parts = [value, *(getattr(value, name, None) for name in ("__func__", "fget", "fset", "fdel", "__wrapped__"))]
    if isinstance(value, cached_property):
        parts.append(value.func)
    for part in parts:
        if isinstance(part, types.FunctionType) and lines_in(part.__code__.co_filename):
            home = part.__globals__.get("__name__")
            if home == "__main__" or home not in sys.modules:
                yield part


def _files(kind: type) -> Iterator[str]:
    """Give the files and cells that may hold a class: those of its methods, else all that Python remembers."""
    own = dict.fromkeys(function.__code__.co_filename for function in functions_of(kind).values())
    if own:
        yield from own
        return
    yield from reversed([*linecache.cache])
    main = getattr(sys.modules.get("__main__"), "__file__", None)
    if isinstance(main, str) and main not in linecache.cache:
        yield main


def _classes(lines: list[str], name: str) -> list[ast.ClassDef]:
    """Return the definitions of a class in a text, the last one first."""
    text = "".join(lines)
    tree = parsed(text) if f"class {name}" in text else None
    found = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef) and node.name == name] if tree else []
    return found[::-1]


def _differences(kind: type, node: ast.ClassDef, text: str, around: Mapping[str, Any]) -> Iterator[str]:
    """Give what a class is otherwise than a text says."""
    own, bound = vars(kind), _bound(node)
    plain = {name for name, expression in bound.items() if expression is not IN_STEPS}
    gone = plain - own.keys() - values_of_fields(kind).keys() - {"_ignore_"}
    if gone:
        yield f"the class has no {sorted(gone)[0]!r}, which its text gives it"
    methods = _methods(kind, node)
    changed = same_methods(text, node, methods)
    if changed:
        yield f"its {changed!r} is not what its text says: one of the two was changed since"
    names = names_in(kind, bound, _names(kind, around))
    for name, expression in bound.items():
        if expression is not None and is_other(kind, name, expression, names):
            yield f"its {name!r} has another value by now than its text gives it"
    for name, default, is_changed in defaults_in(node, methods, names):
        if is_changed:
            yield f"its {name!r} has another default by now than {ast.unparse(default)!r}, which its text gives it"
    yield from _added(kind, bound.keys(), node)


def _methods(kind: type, node: ast.ClassDef) -> dict[str, list[types.FunctionType]]:
    """Return the functions that a class has by the names of the methods in its text."""
    names = {function.name for function in node.body if isinstance(function, ast.FunctionDef)}
    return {name: list(_functions_in(vars(kind).get(name))) for name in names}


def _names(kind: type, around: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the names of the notebook that a class was defined in."""
    return next((function.__globals__ for function in functions_of(kind).values()), around)


def _check_known(kind: type, node: ast.ClassDef, names: Mapping[str, Any], what: str, file: str) -> None:
    """Refuse values of which nobody can tell whether the text still makes them."""
    bound = _bound(node)
    names = names_in(kind, bound, names)
    found = [
        (name, part)
        for name, expression in bound.items()
        for part in (unknown_in(kind, name, expression, names) if expression is not None else ())
    ]
    found += [
        (name, default)
        for name, default, is_changed in defaults_in(node, _methods(kind, node), names)
        if not is_changed
    ]
    for name, part in found:
        how = "makes in steps" if part is IN_STEPS else f"computes by {ast.unparse(part)!r}"
        text = f"{what} has {name!r} ({place_in(file, getattr(part, 'lineno', node.lineno))}), which its text {how}"
        way_out = (
            f"Compute it above the class under a name of its own, {name.upper()} = ..., and use that name in the class"
        )
        raise Refused(f"{text}: it may be another value by the time it is served. {way_out}.")


def _added(kind: type, said: Collection[str], node: ast.ClassDef) -> Iterator[str]:
    """Give what was hung on a class besides its text, but for what Python and its decorators make of it."""
    fields = values_of_fields(kind)
    for name, value in vars(kind).items():
        if name in said or name in _ALWAYS or name in fields or _is_of_python(kind, name):
            continue
        is_own = any(True for _ in _functions_in(value))
        if is_own or (is_value(value) and not (name.startswith("_") and node.decorator_list)):
            yield f"it has {name!r}, which its text does not give it"


def _is_of_python(kind: type, name: str) -> bool:
    """Whether a name is one that Python or a library gives to the classes of its kind, as Enum does."""
    if name.startswith("__") and name.endswith("__"):
        return name not in _functions_named(kind)
    bases = (above for above in kind.__mro__[1:] if above.__module__ != kind.__module__)
    return name in _OF_TUPLES or any(name in vars(above) for above in bases)


def _functions_named(kind: type) -> set[str]:
    return {name for name, value in vars(kind).items() if any(True for _ in _functions_in(value))}


def _bound(node: ast.ClassDef) -> dict[str, ast.expr | None]:
    """Return the names that the body of a class binds, each with its expression if it is a plain assignment."""
    return {name: value for name, value in bound_names(node.body).items() if name not in _ALWAYS}


def _check_bases(kind: type, node: ast.ClassDef, names: Mapping[str, Any], what: str) -> None:
    """Refuse a class whose base was defined again since: the module would have the new one."""
    known = (*kind.__bases__, *getattr(kind, "__orig_bases__", ()))
    for expression in node.bases:
        base = evaluated(expression, names)
        if isinstance(base, type) and not any(base is one for one in known):
            text = f"{what} is made from {ast.unparse(expression)!r}, which was defined again since."
            raise Refused(f"{text} Define the class again too, and what was made of it.")
