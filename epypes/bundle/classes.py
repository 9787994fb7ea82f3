"""What does a class of the notebook need to stand in a module of its own?

Like functions, classes are looked up by object, and nothing is believed: a text is taken only if its methods compile to
the code that the class has, and its attributes are what the text gives them.
"""

from __future__ import annotations

import ast
import dis
import enum
import io
import linecache
import sys
import types
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from functools import cached_property
from typing import Any, Final

from epypes.bundle.cells import place_in
from epypes.bundle.literal import is_data, is_same_data
from epypes.bundle.source import Refused, evaluated
from epypes.bundle.text import class_code, nested_codes, own_text, parsed, same_methods
from epypes.bundle.uses import names_from_outside

# What Python itself puts into every class.
_ALWAYS: Final = frozenset({"__module__", "__qualname__", "__annotations__", "__doc__", "__classcell__"})


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
        lines = io.StringIO("".join(linecache.getlines(file)), newline=None).readlines()
        for node in _classes(lines, kind.__name__):
            problem = next(_differences(kind, node, "".join(lines)), "")
            if not problem:
                return _definition(kind, around, what, file, lines, node)
            why = why or f"{problem} ({place_in(file, node.lineno)})"
    text = f"{what} is not to be had as text: {why or 'it has no source'}."
    raise Refused(f"{text} Define it in a cell again, and what was made of it.")


def _definition(
    kind: type, around: Mapping[str, Any], what: str, file: str, lines: list[str], node: ast.ClassDef
) -> ClassDefinition:
    own = next((function.__globals__ for function in functions_of(kind).values()), None)
    names = around if own is None else own
    place = place_in(file, node.lineno)
    _check_bases(kind, node, names, f"{what} ({place})")
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
        if isinstance(part, types.FunctionType) and linecache.getlines(part.__code__.co_filename):
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


def _differences(kind: type, node: ast.ClassDef, text: str) -> Iterator[str]:
    """Give what a class is otherwise than a text says."""
    own, bound = vars(kind), _bound(node)
    gone = bound.keys() - own.keys() - _fields(kind).keys() - {"_ignore_"}
    if gone:
        yield f"the class has no {sorted(gone)[0]!r}, which its text gives it"
    methods = {function.name for function in node.body if isinstance(function, ast.FunctionDef)}
    written = {name: list(_functions_in(own.get(name))) for name in methods}
    changed = same_methods(text, node, written)
    if changed:
        yield f"its {changed!r} is not what its text says: one of the two was changed since"
    for name, expression in bound.items():
        if expression is not None and not _is_as_written(kind, name, expression):
            yield f"its {name!r} has another value by now than its text gives it"
    yield from _added(kind, bound.keys() | methods)


def _added(kind: type, said: set[str]) -> Iterator[str]:
    """Give what was hung on a class besides its text, but for what Python and its decorators make of it."""
    for name, value in vars(kind).items():
        if name in said or name in _ALWAYS or name in _fields(kind):
            continue
        is_own = any(True for _ in _functions_in(value))
        if is_own or (is_data(value) and not name.startswith("_")):
            yield f"it has {name!r}, which its text does not give it"


def _bound(node: ast.ClassDef) -> dict[str, ast.expr | None]:
    """Return the names that the body of a class binds, each with its expression if it is a plain assignment."""
    found: dict[str, ast.expr | None] = {}
    for statement in node.body:
        if isinstance(statement, ast.Assign):
            targets = [target for target in statement.targets if isinstance(target, ast.Name)]
            found.update({target.id: statement.value for target in targets})
        elif isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name) and statement.value:
            found[statement.target.id] = statement.value
        elif isinstance(statement, ast.FunctionDef | ast.ClassDef):
            found[statement.name] = None
    return {name: value for name, value in found.items() if name not in _ALWAYS}


def _fields(kind: type) -> Mapping[str, Any]:
    """Return the defaults of a dataclass's or NamedTuple's fields, which may not be attributes of the class."""
    fields = vars(kind).get("__dataclass_fields__", {})
    defaults = {name: field.default for name, field in fields.items()}
    return {
        **defaults,
        **dict.fromkeys(vars(kind).get("_fields", ()), MISSING),
        **vars(kind).get("_field_defaults", {}),
    }


def _is_as_written(kind: type, name: str, expression: ast.expr) -> bool:
    """Whether an attribute still is what a literal in the text says; other expressions the replay must tell."""
    try:
        written = ast.literal_eval(expression)
    except (ValueError, TypeError, SyntaxError, RecursionError):
        return True
    value = _fields(kind).get(name, MISSING)
    if issubclass(kind, enum.Enum):
        value = kind.__members__[name].value if name in kind.__members__ else written
    elif value is MISSING:
        value = vars(kind).get(name, written)
    return is_same_data(written, value) or not is_data(value)


def _check_bases(kind: type, node: ast.ClassDef, names: Mapping[str, Any], what: str) -> None:
    """Refuse a class whose base was defined again since: the module would have the new one."""
    known = (*kind.__bases__, *getattr(kind, "__orig_bases__", ()))
    for expression in node.bases:
        base = evaluated(expression, names)
        if isinstance(base, type) and not any(base is one for one in known):
            text = f"{what} is made from {ast.unparse(expression)!r}, which was defined again since."
            raise Refused(f"{text} Define the class again too, and what was made of it.")


def made_again(value: Any, expression_of: Callable[[Any], str], class_of: Callable[[type], str]) -> str:
    """Return the expression of a member of an enumeration, or of a record of values; "" for any other.

    Parameters
    ----------
    value
        Anything.
    expression_of
        Returns the expression of a value in it; "" if there is none.
    class_of
        Returns the expression of a class, which is added to the module.
    """
    kind = type(value)
    if isinstance(value, enum.Enum):
        return f"{class_of(kind)}.{value.name}" if value.name in kind.__members__ else ""
    if not hasattr(kind, "__dataclass_fields__") and not (isinstance(value, tuple) and hasattr(kind, "_fields")):
        return ""
    records = [(field.name, field.init) for field in fields(value)] if is_dataclass(value) else _of_tuple(value)
    parts = [(name, expression_of(getattr(value, name))) for name, _ in records]
    more = getattr(value, "__dict__", {}).keys() - {name for name, _ in records}
    if more or not all(source for _, source in parts) or not all(is_given for _, is_given in records):
        return ""
    return f"{class_of(kind)}({', '.join(f'{name}={source}' for name, source in parts)})"


def _of_tuple(value: Any) -> list[tuple[str, bool]]:
    return [(name, True) for name in type(value)._fields]
