"""Static checks that name the line: writes to state that outlives a call, monkeypatches, and what only a notebook has.

What syntax can't see is found by the replays, and by the snapshot that guards the functions of a loaded bundle.
"""

from __future__ import annotations

import ast
import builtins
import dis
import linecache
import sys
import types
from collections import deque
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Any, Final

from epypes.bundle.notebook_source import (
    executed_cells,
    names_from_outside,
    nested_codes,
    parsed,
    place_in,
)
from epypes.bundle.resolve import Importable, Refused, evaluated
from epypes.run.guard import is_plain_array

# -- writes to what outlives a call ----------------------------------------------------------------------------------

# Methods of lists, dicts, sets, deques and arrays that change them.
CHANGING: Final = frozenset(
    {
        *("append", "appendleft", "extend", "extendleft", "insert", "pop", "popleft", "popitem", "remove", "clear"),
        *("update", "setdefault", "add", "discard", "sort", "reverse", "fill", "itemset", "put", "resize"),
        *("difference_update", "intersection_update", "symmetric_difference_update", "setfield", "setflags"),
    }
)
_INTO: Final = frozenset(("out", "dst"))


def root_of(node: ast.expr) -> str:
    """Return the name of what a subscript or attribute is of; "" if that is no name."""
    while isinstance(node, ast.Subscript | ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""


_ASKED: Final = {
    "get_ipython": "the notebook itself, as magics and shell escapes do. Write it in Python, or elsewhere",
    "display": "which shows something in the notebook; a service shows nothing. Return it as a token",
    "input": "which asks a person. Make the answer a token",
    "breakpoint": "which waits for a person. Leave it out",
    "exit": "which ends the notebook. Raise an exception",
    "quit": "which ends the notebook. Raise an exception",
    "globals": "all names of the notebook. Use those that you need by name",
    "eval": "which may use any name. Write what it evaluates",
    "exec": "which may use any name. Write what it runs",
    "In": "the notebook's cells. Make the text a token",
    "Out": "what the notebook's cells have shown. Make the value a token",
}
_OF_A_MODULE: Final = frozenset(
    ["__name__", "__file__", "__doc__", "__spec__", "__loader__", "__package__", "__builtins__", "__cached__"]
)


def check_state(function: types.FunctionType, node: ast.AST, what: str) -> None:
    """Refuse a function of the notebook that changes something outside of it.

    Parameters
    ----------
    function
        The function.
    node
        Its definition.
    what
        How a reason calls it.
    """
    code = function.__code__
    check_globals(code, node, code.co_filename, what)
    check_nonlocal(function, node, what)
    names = {**function.__globals__, **captured_by(function)}
    outside = {*code.co_freevars, *(name for inner in nested_codes(code) for name in names_from_outside(inner))}
    for part in ast.walk(node):
        for written in _written(part, names):
            name = root_of(written)
            if name in outside:
                place = place_in(code.co_filename, getattr(part, "lineno", code.co_firstlineno))
                text = f"{what} writes into {name!r}, which outlives the call ({place})"
                raise Refused(f"{text}: the next event would find it different. Copy it first, or make it a token.")


def _written(node: ast.AST, names: Mapping[str, Any]) -> Iterator[ast.expr]:
    """Give the expressions whose objects a part of a function plainly writes into."""
    if isinstance(node, ast.Subscript | ast.Attribute) and isinstance(node.ctx, ast.Store | ast.Del):
        yield node
    if isinstance(node, ast.Call):
        if isinstance(node.func, ast.Name) and node.func.id in ("setattr", "delattr"):
            yield from node.args[:1]
        of = node.func.value if isinstance(node.func, ast.Attribute) and node.func.attr in CHANGING else None
        given = [*([of] if of is not None else []), *(part.value for part in node.keywords if part.arg in _INTO)]
        yield from (part for part in given if _is_container(evaluated(part, names), names.get(root_of(part))))


def _is_container(value: Any, root: Any) -> bool:
    """Whether a value is of a kind that is written into; of what is no name, whether that in which it is found is."""
    value = root if value is None else value
    return isinstance(value, list | dict | set | bytearray | deque) or is_plain_array(value)


def check_globals(code: types.CodeType, node: ast.AST, file: str, what: str) -> None:
    """Refuse what changes global names of the notebook."""
    for inner in nested_codes(code):
        for instruction in dis.get_instructions(inner):
            if instruction.opname in ("STORE_GLOBAL", "DELETE_GLOBAL"):
                name = instruction.argval
                uses = (part.lineno for part in ast.walk(node) if isinstance(part, ast.Name) and part.id == name)
                place = place_in(file, next(uses, code.co_firstlineno))
                raise Refused(f"{what} changes the global {name!r} ({place}). Return the value.")


def check_nonlocal(function: types.FunctionType, node: ast.AST, what: str) -> None:
    """Refuse a function that keeps something from call to call in the function around it."""
    code = function.__code__
    for part in ast.walk(node):
        kept = [name for name in part.names if name in code.co_freevars] if isinstance(part, ast.Nonlocal) else []
        if kept and isinstance(part, ast.Nonlocal):
            text = f"{what} changes {kept[0]!r} of the function around it ({place_in(code.co_filename, part.lineno)})"
            raise Refused(f"{text}, so that every call finds it different. Make it a token, or return the value.")


def captured_by(function: types.FunctionType) -> dict[str, Any]:
    """Return what a function has from the functions around it, by name; nothing of a name without a value."""
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    return {name: cell.cell_contents for name, cell in cells if cell != types.CellType()}


def check_asked(name: str, value: Any, found: Any, what: str) -> None:
    """Refuse a name that means something in a notebook alone."""
    if name in _ASKED and not (isinstance(value, types.FunctionType) and value.__module__ == "__main__"):
        raise Refused(f"{what} uses {name!r} ({found.place_of(name)}), {_ASKED[name]}.")
    if name == "vars" and any(map(_asks_for_names, ast.walk(found.node))):
        raise Refused(f"{what} uses 'vars()' ({found.place_of(name)}), all names there are. Use those that you need.")
    if name in _OF_A_MODULE:
        text = f"{what} uses {name!r} ({found.place_of(name)}), which is another one in a bundle"
        raise Refused(f"{text}. Write the value itself, or make it a token.")


def _asks_for_names(node: ast.AST) -> bool:
    """Whether this is ``vars()``, or a module's."""
    is_call = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "vars"
    return isinstance(node, ast.Call) and is_call and not any(isinstance(part, ast.Name) for part in node.args)


# -- monkeypatches ---------------------------------------------------------------------------------------------------

_Key = tuple[types.ModuleType | type, str]


def check_patches(found: Any, what: str) -> None:
    """Refuse a definition that reads what the notebook has changed in a module."""
    known, names = _patched(), {**found.names, **_imports_of(found.node)}
    # A module by itself, as in getattr(module, name), may be asked for any name.
    dotted = {id(node.value) for node in ast.walk(found.node) if isinstance(node, ast.Attribute)}
    for node in ast.walk(found.node):
        if isinstance(node, ast.Name) and (builtins, node.id) in known:
            _refuse(what, node.id, known[builtins, node.id])
        for (owner, name), place in known.items():
            is_asked = isinstance(owner, type) or id(node) not in dotted
            if is_asked and _is_of(node, owner, name, names):
                _refuse(what, f"{owner.__name__}.{name}", place)
    for chain in _read_by(found.node):
        key = _key(chain, names)
        value = getattr(*key, None) if key is not None and key[0].__name__ != "__main__" else None
        is_own = isinstance(value, types.FunctionType | type) and value.__module__ == "__main__"
        if key is not None and (is_own or key in known):
            _refuse(what, ".".join(chain), known.get(key, found.place))


def _is_of(node: ast.AST, owner: types.ModuleType | type, name: str, names: Mapping[str, Any]) -> bool:
    """Whether a part of a definition reads an attribute of this name of any object, or the module or class itself."""
    if isinstance(owner, type) and isinstance(node, ast.Attribute) and node.attr == name:
        return True
    return isinstance(node, ast.Name | ast.Attribute) and evaluated(node, names) is owner


def check_home(home: Importable, what: str) -> None:
    """Refuse what can be imported only as the notebook has changed it."""
    place = _patched().get((sys.modules[home.module], home.qualname.partition(".")[0]))
    if place:
        _refuse(what, f"{home.module}.{home.qualname}", place)


def _refuse(what: str, name: str, place: str) -> None:
    text = f"{what} uses {name!r}, which the notebook has changed ({place}); a service has it as it was installed"
    raise Refused(f"{text}. Call yours by a name of its own, or make the value a token.")


def _patched() -> dict[_Key, str]:
    """Return what the notebook has changed, by module and name there, each with its place."""
    names = vars(sys.modules["__main__"])
    texts = executed_cells(names)
    script = names.get("__file__")
    if not texts and isinstance(script, str):
        texts = [(0, "".join(linecache.getlines(script)))]
    found = {}
    for cell, text in texts:
        for chain, line in _patches_in(text):
            key = _key(chain, names)
            if key:
                found[key] = f"cell [{cell}], line {line}" if cell else place_in(str(script), line)
    return found


def _key(chain: tuple[str, ...], names: Mapping[str, Any]) -> _Key | None:
    """Return the module, or class of a library, of a dotted name, and what is read of it; None for anything else."""
    reached = names.get(chain[0])
    for part in chain[1:]:
        if isinstance(reached, type) and reached.__module__ != "__main__":
            return reached, part
        if not isinstance(reached, types.ModuleType):
            return None
        inner = getattr(reached, part, None)
        if not isinstance(inner, types.ModuleType):
            return reached, part
        reached = inner
    return None


@lru_cache(maxsize=512)  # every function of a graph asks for every cell
def _patches_in(text: str) -> tuple[tuple[tuple[str, ...], int], ...]:
    """Return the dotted names that a cell writes into, with their lines."""
    tree = parsed(text)
    found = [(chain, getattr(node, "lineno", 1)) for node in ast.walk(tree) for chain in _targets(node)] if tree else []
    return tuple(found)


def _targets(node: ast.AST) -> Iterator[tuple[str, ...]]:
    parts: list[ast.AST] = []
    more: tuple[str, ...] = ()
    if isinstance(node, ast.Attribute | ast.Subscript) and isinstance(node.ctx, ast.Store | ast.Del):
        parts = [node]
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in CHANGING:
        parts = [node.func.value]
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("setattr", "delattr"):
        parts, name = list(node.args[:1]), node.args[1] if len(node.args) > 1 else None
        more = (str(name.value),) if isinstance(name, ast.Constant) else ()
    chains = (dotted_name(part) + more for part in parts)
    yield from (chain for chain in chains if len(chain) > 1)


def dotted_name(node: ast.AST) -> tuple[str, ...]:
    """Return the dotted name that an expression begins with; nothing if it is none."""
    parts: list[str] = []
    while isinstance(node, ast.Attribute | ast.Subscript):
        parts = [node.attr, *parts] if isinstance(node, ast.Attribute) else []
        node = node.value
    return (node.id, *parts) if isinstance(node, ast.Name) else ()


def _read_by(tree: ast.AST) -> Iterator[tuple[str, ...]]:
    """Give the dotted names that a definition reads, and what it imports from modules."""
    for node in ast.walk(tree):
        chain = dotted_name(node) if isinstance(node, ast.Attribute) else ()
        if len(chain) > 1:
            yield chain
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield from ((f"from {node.module}", alias.name) for alias in node.names)


def _imports_of(tree: ast.AST) -> dict[str, Any]:
    """Return what a definition imports itself, by name, and the modules of which it imports names."""
    found: dict[str, Any] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            module = found[f"from {node.module}"] = sys.modules.get(node.module)
            found |= {alias.asname or alias.name: getattr(module, alias.name, None) for alias in node.names}
        for alias in node.names if isinstance(node, ast.Import) else ():
            dotted = alias.name if alias.asname else alias.name.partition(".")[0]
            found[alias.asname or dotted] = sys.modules.get(dotted)
    return found
