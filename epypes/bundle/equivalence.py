"""The comparison of a notebook's objects with those that a bundle's module makes.

The module is emitted by simple rules and executed once. Then one walk goes over the notebook's objects and the module's
objects side by side: from every function over its text, defaults, closure and attributes to every global that its code
names. The same text over the same data computes the same on every input, whatever the notebook has rebound meanwhile. A
difference is a refusal that names the object, its cell and line.

The module is executed in the promoting process, because only there can its objects be compared with the notebook's.
What its decorators, classes and factories do when they are called, they do once more, with objects of the module. All
checks that need no execution are made before.
"""

from __future__ import annotations

import ast
import builtins
import copyreg
import dataclasses
import enum
import functools
import linecache
import reprlib
import sys
import tempfile
import traceback
import types
import warnings
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from epypes.bundle.expressions import has_steady_order, is_data, is_same_data, write_arrays
from epypes.bundle.graphs import is_set_elsewhere
from epypes.bundle.load import MODULE, execute
from epypes.bundle.notebook_source import (
    computes_the_same,
    definition_of,
    lambdas_of,
    names_from_outside,
    nested_codes,
    place_in,
    place_of,
    spelled_tree,
)
from epypes.bundle.resolve import annotated_names, defaults_of, layers, statements_of_class
from epypes.graph import CompGraph, Switch
from epypes.pipeline import Node, Pipeline
from epypes.run.guard import as_written, is_plain_array, is_unguarded

_PLAIN: Final = frozenset({int, float, complex, bool, str, bytes, type(None), type(...)})
_DRAFT: Final = "epypes-draft-"
_LOST: Final = object()
# What an attribute in a slot, or the dict of all others, takes of an object.
_SLOT: Final = tuple.__itemsize__
# What Python and the standard library add to a class, from its text and its fields, which are compared.
_ADDED_TO_CLASSES: Final = frozenset(
    {"__module__", "__qualname__", "__doc__", "__dict__", "__weakref__", "__annotations__", "__orig_bases__"}
    | {"__annotate__", "__annotate_func__", "__annotations_cache__", "__static_attributes__", "__firstlineno__"}
    | {"_abc_impl", "__dataclass_params__", "__slotnames__", "_value2member_map_"}
)
_OF_DATACLASSES: Final = frozenset(
    {"__init__", "__repr__", "__eq__", "__lt__", "__le__", "__gt__", "__ge__", "__hash__", "__setattr__"}
    | {"__delattr__", "__replace__"}
)
_OF_FIELDS: Final = (
    "name", "default", "default_factory", "init", "repr", "hash", "compare", "metadata", "kw_only", "_field_type",
)  # fmt: skip
_WAY_OUT: Final = (
    "The bundle would have what the text of the cells makes. Run the cells that make it again, or make it a token."
)


@dataclasses.dataclass(frozen=True, slots=True)
class _Path:
    """The way to an object, for a reason: a function of the graph, the nearest function or class, and its part."""

    root: str
    owner: str
    part: str = ""

    def to(self, more: str) -> _Path:
        return dataclasses.replace(self, part=self.part + more)

    @property
    def name(self) -> str:
        return f"its{self.part}" if self.part else "it"

    def __str__(self) -> str:
        is_root = self.owner.startswith(self.root)
        return self.owner if is_root else f"{self.owner}, which {self.root[0].lower()}{self.root[1:]} needs"


class _Different(Exception):
    """Two objects differ; the text is the reason."""

    def __init__(self, path: _Path, text: str) -> None:
        super().__init__(f"{path}: {text}")


Pair = tuple[str, Any, Any]


def refusal(text: str, arrays: Mapping[str, Any], pairs: Callable[[Any], Iterable[Pair]]) -> str:
    """Execute a module that was emitted, and return why its objects are not the notebook's; "" if they are.

    Parameters
    ----------
    text
        The module.
    arrays
        What it reads from files, by name.
    pairs
        Returns of the module what is compared: how a reason calls an object, the notebook's object and the module's.
    """
    with tempfile.TemporaryDirectory(prefix=_DRAFT) as folder:
        path = Path(folder) / MODULE
        path.write_text(text, encoding="utf-8")
        write_arrays(path.parent, arrays)
        try:
            return _refusal(path, pairs)
        finally:
            linecache.cache.pop(str(path), None)


def _refusal(path: Path, pairs: Callable[[Any], Iterable[Pair]]) -> str:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the notebook has shown them
            module = execute(path, path.read_bytes())
    except (Exception, SystemExit) as error:  # whatever the notebook's own code raises
        frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
        where = f", at {str(frames[0].line)!r}" if frames else ""
        return f"The module fails when it is imported{where}: {type(error).__name__}: {error}. {_WAY_OUT}"
    walk = _Walk()
    walk.waiting.extend((_Path(what, _placed(what, ours)), ours, theirs) for what, ours, theirs in pairs(module))
    try:
        walk.finish()
    except _Different as found:
        return f"{found} {_WAY_OUT}"
    return ""


class _Walk:
    """A walk over two graphs of objects that compares each pair of objects once."""

    def __init__(self) -> None:
        self.waiting: deque[tuple[_Path, Any, Any]] = deque()
        # The objects by their ids. They are kept here, so that no id is used again.
        self._seen: dict[tuple[int, int], tuple[Any, Any]] = {}
        self._partners: tuple[dict[int, Any], dict[int, Any]] = {}, {}
        self._divided: dict[bool, _Different] = {}
        self._asks_for_identity = self._asks_for_membership = False

    def finish(self) -> None:
        """Compare all that is waiting and what it reaches; raise at the first difference."""
        while self.waiting:
            path, ours, theirs = self.waiting.popleft()
            ours, theirs = _bare(ours), _bare(theirs)
            self._compare_identity(path, ours, theirs)
            if ours is not theirs and (id(ours), id(theirs)) not in self._seen:
                self._seen[id(ours), id(theirs)] = ours, theirs
                self._compare(path, ours, theirs)
        for has_equals, difference in self._divided.items():
            if self._asks_for_identity or (self._asks_for_membership and not has_equals):
                raise difference

    def _compare_identity(self, path: _Path, ours: Any, theirs: Any) -> None:
        """Note an object of one side that is several objects of the other."""
        is_number = type(ours) in _PLAIN
        if is_number and ours == ours:
            return
        has_equals = is_data(ours) and not is_number
        for side, (one, other) in enumerate(((ours, theirs), (theirs, ours))):
            if self._partners[side].setdefault(id(one), other) is not other:
                where, elsewhere = _side(side == 0), _side(side == 1)
                text = f"{path.name} is one object in the {where} and several in the {elsewhere}, and a function"
                self._divided.setdefault(has_equals, _Different(path, f"{text} compares by 'is' or 'in'."))

    def _compare(self, path: _Path, ours: Any, theirs: Any) -> None:
        """Compare two objects but for their parts, which are then waiting."""
        kind = type(ours)
        if ours is _LOST or theirs is _LOST:
            raise _Different(path, f"{path.name} is defined only in the {'module' if ours is _LOST else 'notebook'}.")
        if isinstance(ours, type) and isinstance(theirs, type):
            self._compare_classes(path, ours, theirs)
            return
        if kind is types.FunctionType and type(theirs) is kind:
            self._compare_functions(path, ours, theirs)
            return
        if kind is not type(theirs):
            if not _is_of_notebook(kind) or kind.__name__ != type(theirs).__name__:
                raise _unlike(path, ours, theirs)
            self._add(path.to(" class"), kind, type(theirs))
        if kind in _PLAIN:
            if not is_same_data(ours, theirs):
                raise _unlike(path, ours, theirs)
            return
        if is_plain_array(ours) and not ours.dtype.hasobject:
            # A view with gaps is whole in the file that the module reads it from.
            is_whole = ours.flags.c_contiguous or ours.flags.f_contiguous
            if _bits(ours, is_whole) != _bits(theirs, is_whole):
                raise _unlike(path, ours, theirs)
            return
        try:
            mine, others = _parts(ours), _parts(theirs)
        except Exception as error:  # whatever an object of a library raises that can't be copied
            text = f"{path.name} is a {kind.__name__!r}, made anew in the module, which can't be compared."
            raise _Different(path, f"{text} Make it inside the function.") from error
        self._add_all(path, mine, others)

    def _add(self, path: _Path, ours: Any, theirs: Any) -> None:
        self.waiting.append((path, ours, theirs))

    def _add_all(self, path: _Path, mine: Mapping[str, Any], others: Mapping[str, Any]) -> None:
        """Add parts by name, which must be the same in the same order."""
        if [*mine] != [*others]:
            only = sorted(mine.keys() ^ others.keys())
            if not only:
                raise _Different(path, f"{path.name} has another order in the module.")
            raise _Different(path, f"{path.name} has {only[0].strip()} only in the {_side(only[0] in mine)}.")
        for part, value in mine.items():
            self._add(path.to(part), value, others[part])

    def _compare_functions(self, path: _Path, ours: types.FunctionType, theirs: types.FunctionType) -> None:
        if ours.__code__ is not theirs.__code__:
            node = _node(ours.__code__)
            owner = _placed(f"Function {ours.__name__!r}", ours) if path.part else path.owner
            path = _Path(path.root, owner)
            if not _is_same_text(ours.__code__, theirs.__code__, node):
                raise _Different(path, "the notebook has it with another text than the cells have now.")
            parts = [*ast.walk(node)] if node is not None else []
            self._asks_for_identity |= any(map(_asks_for_identity, parts))
            self._asks_for_membership |= any(isinstance(part, ast.In | ast.NotIn) for part in parts)
            for name in annotated_names(node) if node is not None else ():
                if _LOST not in (pair := (_meaning(ours, name), _meaning(theirs, name))):
                    self._add(path.to(f" {name!r}"), *pair)
        elif ours.__globals__ is not theirs.__globals__:
            raise _Different(path, "it reads the names of another module.")
        if is_unguarded(ours) != is_unguarded(theirs):
            raise _Different(path, "it is marked as unguarded in one of notebook and module.")
        self._add_all(path, _defaults(ours), _defaults(theirs))
        self._add_all(path, _marks(ours), _marks(theirs))
        for name in _names(ours, theirs):
            self._add(path.to(f" {name!r}"), _meaning(ours, name), _meaning(theirs, name))

    def _compare_classes(self, path: _Path, ours: type, theirs: type) -> None:
        if not _is_of_notebook(ours) or ours.__name__ != theirs.__name__:
            raise _unlike(path, ours, theirs)
        path = _Path(path.root, _placed(f"Class {ours.__name__!r}", ours))
        self._add(path.to(" metaclass"), type(ours), type(theirs))
        self._add(path.to(" bases"), ours.__bases__, theirs.__bases__)
        self._add(path.to(" options"), _options(ours), _options(theirs))
        mine, others = _attributes(ours), _attributes(theirs)
        for part in sorted(mine.keys() | others.keys(), key=lambda name: (name.startswith("__"), name)):
            self._add(path.to(f" {part!r}"), mine.get(part, _LOST), others.get(part, _LOST))


def _bare(value: Any) -> Any:
    """Return the function of a node that does nothing else than call it; anything else as the notebook wrote it."""
    value = as_written(value)
    while type(value) is Node:
        value = as_written(value.func)
    return value


def _placed(what: str, value: Any) -> str:
    """Return how a reason calls an object, with its cell and line if it is a function or class of the notebook."""
    innermost = layers(_bare(value))[-1]
    if isinstance(innermost, types.FunctionType):
        return f"{what} ({place_of(innermost.__code__)})"
    statements = statements_of_class(value) if isinstance(value, type) else iter(())
    found = next((pair for pair in statements if _DRAFT not in pair[0]), None)
    return f"{what} ({place_in(found[0], found[1].lineno)})" if found else what


def _is_of_notebook(kind: type) -> bool:
    """Whether a class was defined in the notebook, or in a module that is no imported one, as that of a bundle."""
    return kind.__module__ == "__main__" or kind.__module__ not in sys.modules


def _side(is_notebook: bool) -> str:
    return "notebook" if is_notebook else "module"


def _unlike(path: _Path, ours: Any, theirs: Any) -> _Different:
    mine, others = reprlib.repr(ours), reprlib.repr(theirs)
    if mine == others or isinstance(ours, types.FunctionType | type):
        return _Different(path, f"{path.name} is something else by now than when the cells are run again.")
    return _Different(path, f"{path.name} is {mine} in the notebook and {others} in the module.")


# -- functions -------------------------------------------------------------------------------------------------------


def _node(code: types.CodeType) -> ast.FunctionDef | ast.Lambda | None:
    """Return the definition of some code; None if there is no text that compiles to it."""
    if code.co_name != "<lambda>":
        return definition_of(code)[1]
    _, nodes = lambdas_of(code)
    return nodes[0] if len({ast.dump(node) for node in nodes}) == 1 else None


def _is_same_text(code: types.CodeType, other: types.CodeType, node: ast.FunctionDef | ast.Lambda | None) -> bool:
    """Whether two functions have the same text over the same names; without a text, the same instructions."""
    second = _node(other)
    if node is None or second is None:
        return node is second and computes_the_same(code, other)
    # The annotations of a class inside are names only where they are not read late.
    return _spelled(node) == _spelled(second) and _has_same_names(code, other, {*annotated_names(node)})


def _spelled(node: ast.FunctionDef | ast.Lambda) -> list[object]:
    """Return what a definition says but for its name, decorators, defaults and annotations."""
    given = node.args
    every = ([*given.posonlyargs, None, *given.args], [given.vararg], given.kwonlyargs, [given.kwarg])
    names = [[argument and argument.arg for argument in part] for part in every]
    body: list[ast.stmt] = [ast.Return(node.body)] if isinstance(node, ast.Lambda) else node.body
    return [*names, *spelled_tree(ast.Module(body, []))]


def _has_same_names(code: types.CodeType, other: types.CodeType, but: set[str]) -> bool:
    """Whether the names of two functions of one text mean variables of the same kind; a captured one may be global."""
    mine, others = [*nested_codes(code)], [*nested_codes(other)]
    return len(mine) == len(others) and all(
        (one.co_varnames, sorted(one.co_cellvars), {*one.co_names, *one.co_freevars} - but)
        == (two.co_varnames, sorted(two.co_cellvars), {*two.co_names, *two.co_freevars} - but)
        for one, two in zip(mine, others, strict=True)
    )


def _asks_for_identity(node: ast.AST) -> bool:
    """Whether a part of a function may ask which one of two equal objects it has."""
    if isinstance(node, ast.Name):
        return node.id == "id"
    if not isinstance(node, ast.Compare) or not any(isinstance(one, ast.Is | ast.IsNot) for one in node.ops):
        return False
    return not any(isinstance(side, ast.Constant) for side in (node.left, *node.comparators))


def _defaults(function: types.FunctionType) -> dict[str, Any]:
    """Return the defaults of a function by how a reason calls them."""
    return {f" default of {name!r}": value for name, value in sorted(defaults_of(function).items())}


def _marks(function: Any) -> dict[str, Any]:
    """Return the attributes of a function but for the marks of EPypes and what functools.wraps copies."""
    found = {name: value for name, value in vars(function).items() if not name.startswith("__epypes_")}
    names = sorted(found.keys() - set(functools.WRAPPER_ASSIGNMENTS))
    if isinstance(function, types.FunctionType) and "__wrapped__" not in found:
        found["__doc__"] = function.__doc__
        names.append("__doc__")
        # The module may have it under another name, unlike one that was set later.
        if function.__name__ != function.__code__.co_name:
            found["__name__"] = function.__name__
            names.append("__name__")
    return {f" attribute {name!r}": found[name] for name in names}


def _names(ours: types.FunctionType, theirs: types.FunctionType) -> Iterator[str]:
    """Give the names that a function reads from outside: those that it has captured, then all others."""
    names = dict.fromkeys((*ours.__code__.co_freevars, *theirs.__code__.co_freevars))
    if ours.__code__ is not theirs.__code__:
        for code in nested_codes(ours.__code__):
            names |= dict.fromkeys(names_from_outside(code))
    yield from names


def _meaning(function: types.FunctionType, name: str) -> Any:
    """Return what a name means to a function; _LOST if nothing."""
    if name in function.__code__.co_freevars:
        cell = (function.__closure__ or ())[function.__code__.co_freevars.index(name)]
        return cell.cell_contents if cell != types.CellType() else _LOST
    return function.__globals__.get(name, getattr(builtins, name, _LOST))


# -- classes and other objects ---------------------------------------------------------------------------------------


def _attributes(kind: type) -> dict[str, Any]:
    """Return the attributes of a class but for those that follow from its other parts."""
    members = {*_ADDED_TO_CLASSES, *getattr(kind, "_member_map_", ())}
    found = {
        name: value
        for name, value in vars(kind).items()
        if name not in members and not isinstance(value, types.MemberDescriptorType | types.GetSetDescriptorType)
    }
    if "__dataclass_fields__" in found:
        # Of what dataclasses write, only the defaults may have been changed since.
        for name in _OF_DATACLASSES & found.keys():
            if isinstance(found[name], types.FunctionType) and _node(found[name].__code__) is None:
                found |= {f"{name}{part}": value for part, value in _defaults(found.pop(name)).items()}
    return found


def _options(kind: type) -> str:
    """Return the options of a dataclass as text; "" for any other class."""
    return repr(vars(kind).get("__dataclass_params__", ""))


def _bits(array: Any, with_layout: bool) -> tuple[object, ...]:
    return array.dtype, array.shape, array.strides if with_layout and array.size else (), array.tobytes()


def _parts(value: Any) -> dict[str, Any]:
    """Return the parts that an object is made of, by how a reason calls them.

    Raises
    ------
    TypeError
        It can't be seen through.
    """
    if type(value) is functools.partial:
        return {" function": value.func, " arguments": value.args, " keywords": value.keywords, **_marks(value)}
    if type(value) in _PARTS:
        return {f" {name}": getattr(value, name) for name in _PARTS[type(value)]}
    if isinstance(value, functools._lru_cache_wrapper):
        return {" parameters": value.cache_parameters(), " function": value.__wrapped__, **_marks(value)}
    if isinstance(value, weakref.WeakKeyDictionary | weakref.WeakValueDictionary):
        return {}  # a cache, as of functools.singledispatch
    if type(value) in (set, frozenset):
        return {" elements": [*value] if has_steady_order(value) else sorted(value, key=repr)}
    if type(value) in (tuple, list):
        return {f"[{number}]": part for number, part in enumerate(value)}
    if type(value) in (dict, types.MappingProxyType):
        return _of_mapping(value)
    if isinstance(value, CompGraph):
        return {" functions": dict(value.functions), " io": dict(value.func_io), " defaults": dict(value.defaults)}
    if isinstance(value, enum.Enum):
        return {" name": value.name, " value": value.value, **_own(value)}
    if isinstance(value, Node):
        return _of_node(value)
    if _is_of_notebook(type(value)):
        return {**_own(value), **_content(value)}
    return _of_library(value)


def _of_mapping(value: Mapping[Any, Any]) -> dict[str, Any]:
    if all(type(key) in _PLAIN for key in value):
        return {f"[{key!r}]": part for key, part in value.items()}
    return {" keys": [*value], " values": [*value.values()]}


def _of_node(node: Node) -> dict[str, Any]:
    """Return what a node was made with, and its own attributes but for those that a run sets."""
    found: dict[str, Any] = {" name": node.name}
    if isinstance(node, Pipeline):
        found |= {" graph": node.source_cg, " hyperparameters": dict(node.runner.hyperparameters)}
        found[" workers"] = node.runner.workers
    else:
        found[" function"] = node.func
    own = {name: value for name, value in vars(node).items() if not is_set_elsewhere(node, name)}
    return found | {f" attribute {name!r}": own[name] for name in sorted(own)}


def _own(value: Any) -> dict[str, Any]:
    """Return the attributes of an object, also those in slots."""
    found = {f" attribute {name!r}": part for name, part in sorted(getattr(value, "__dict__", {}).items())}
    return found | {f" attribute {name!r}": getattr(value, name, _LOST) for name in _slots(type(value))}


def _slots(kind: type) -> list[str]:
    parts = (vars(base).items() for base in kind.__mro__)
    return [name for each in parts for name, part in each if isinstance(part, types.MemberDescriptorType)]


def _content(value: Any) -> dict[str, Any]:
    """Return what an object of a class of the notebook has of a tuple, list, dict or number that it also is."""
    if isinstance(value, tuple | str | bytes | int | float | complex):
        kinds: tuple[Any, ...] = (tuple, str, bytes, int, float, complex)
        kind = next(kind for kind in kinds if isinstance(value, kind))
        return {" content": kind.__getnewargs__(value)}
    if isinstance(value, list):
        return {" content": [*list.__iter__(value)]}
    if isinstance(value, dict):
        return {" content": dict(dict.items(value))}
    # What C keeps in an object is seen only by a copy of it.
    is_plain = type(value).__basicsize__ <= object.__basicsize__ + _SLOT * (2 + len(_slots(type(value))))
    return {} if is_plain else _of_library(value)


def _of_library(value: Any) -> dict[str, Any]:
    """Return what a copy of an object is made of."""
    reduce = copyreg.dispatch_table.get(type(value))
    made = reduce(value) if reduce is not None else value.__reduce_ex__(4)
    if isinstance(made, str):
        raise TypeError(made)
    by, arguments, state, items, pairs = (*made, None, None, None)[:5]
    found = {" maker": by, " arguments": arguments, " state": state}
    return found | {" items": [*(items or ())], " entries": [*(pairs or ())]}


_PARTS: Final[Mapping[type, tuple[str, ...]]] = {
    types.MethodType: ("__func__", "__self__"),
    property: ("fget", "fset", "fdel"),
    staticmethod: ("__func__",),
    classmethod: ("__func__",),
    functools.cached_property: ("func", "attrname"),
    dataclasses.Field: _OF_FIELDS,
    Switch: ("branches",),
}
