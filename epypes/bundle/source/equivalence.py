"""The comparison of a notebook's objects with those that a bundle's module makes.

The module is emitted by simple rules and executed once. Then one walk goes over the notebook's objects and the module's
objects side by side, by what `objects` says that each is made of: from every function over its text, defaults, closure
and attributes to every global that its code names. The same text over the same data computes the same on every input,
whatever the notebook has rebound meanwhile. A difference is a refusal that names the object, its cell and line.

The module is executed in the promoting process, because only there can its objects be compared with the notebook's.
What its decorators, classes and factories do when they are called, they do once more, with objects of the module. All
checks that need no execution are made before.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import linecache
import reprlib
import tempfile
import traceback
import types
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path, PurePath
from typing import Any, Final

from epypes.bundle.arrays import ArrayFiles
from epypes.bundle.manifest import MODULE, OWN_MODULES
from epypes.bundle.private_import import PrivateImport, plain_name
from epypes.bundle.source.clone import is_set_by_runs
from epypes.bundle.source.expressions import is_data
from epypes.bundle.source.objects import (
    ANNOTATION,
    ATOMS,
    CODE,
    describe,
    is_installed,
    is_of_library,
    module_reads,
    without_nodes,
)
from epypes.bundle.source.own_modules import OwnModules
from epypes.bundle.source.references import meanings_of, nested_codes
from epypes.bundle.source.resolve import (
    annotated_names,
    definition_of,
    layers,
    place_in,
    place_of,
    spelled_tree,
    statements_of_class,
)
from epypes.pipeline import Node
from epypes.run import CompGraphRunner
from epypes.run.snapshot import cached_properties

# By these a function reads annotations or docstrings, which otherwise change nothing.
_READS_ANNOTATIONS: Final = frozenset(
    {
        "__annotations__",
        "__doc__",
        "get_annotations",
        "get_type_hints",
        "getdoc",
        "getfullargspec",
        "signature",
        "fields",
    }
)
_DRAFT: Final = "epypes-draft-"
_WAY_OUT: Final = (
    "The bundle has what the text of the cells makes by now. Run the cells that make it again, or make it a token. "
    "After a change of a module's file, restart the kernel first."
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
_Definition = ast.FunctionDef | ast.Lambda


def refusal(text: str, pairs: Callable[[Any], Iterable[Pair]], *files: ArrayFiles | OwnModules) -> str:
    """Execute a module that was emitted, and return why its objects are not the notebook's; "" if they are.

    Parameters
    ----------
    text
        The module.
    pairs
        Returns of the module what is compared: how a reason calls an object, the notebook's object and the module's.
    files
        What it reads and imports from the bundle.
    """
    with tempfile.TemporaryDirectory(prefix=_DRAFT) as folder:
        path = Path(folder) / MODULE
        path.write_text(text, encoding="utf-8")
        for each in files:
            each.write(path.parent)
        try:
            return _refusal(path, pairs)
        finally:
            for file in [file for file in linecache.cache if file.startswith(folder)]:
                del linecache.cache[file]


def _refusal(path: Path, pairs: Callable[[Any], Iterable[Pair]]) -> str:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the notebook has shown them
            module = PrivateImport(path.parent).execute(path)
    except (Exception, SystemExit) as error:  # whatever the notebook's own code raises
        frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
        where = f", at {str(frames[0].line)!r}" if frames else ""
        return f"The module fails when it is imported{where}: {type(error).__name__}: {error}. {_WAY_OUT}"
    walk = _Walk(path.parent / OWN_MODULES)
    walk.waiting.extend((_Path(what, _placed(what, ours)), ours, theirs) for what, ours, theirs in pairs(module))
    try:
        walk.finish()
    except _Different as found:
        return f"{found} {_WAY_OUT}"
    return ""


class _Walk:
    """A walk over two graphs of objects that compares each pair of objects once.

    Parameters
    ----------
    modules
        The folder of the modules that the draft has taken along.
    """

    def __init__(self, modules: Path) -> None:
        self._modules = modules
        self.waiting: deque[tuple[_Path, Any, Any]] = deque()
        # The objects by their ids. They are kept here, so that no id is used again.
        self._seen: dict[tuple[int, int], tuple[Any, Any]] = {}
        self._partners: tuple[dict[int, Any], dict[int, Any]] = {}, {}
        self._divided: dict[bool, _Different] = {}
        self._asks_for_identity = self._asks_for_membership = self._asks_for_annotations = False
        self._last: _Different | None = None  # raised if there is no other one
        # The annotations and docstrings of pairs of objects, which count only where a function reads them.
        self._annotations: list[tuple[_Path, dict[str, Any], dict[str, Any]]] = []

    def finish(self) -> None:
        """Compare all that is waiting and what it reaches; raise at the first difference."""
        while self.waiting or (self._asks_for_annotations and self._annotations):
            if not self.waiting:
                self._add_all(*self._annotations.pop())
                continue
            path, ours, theirs = self.waiting.popleft()
            ours, theirs = without_nodes(ours), without_nodes(theirs)
            if isinstance(theirs, str | PurePath) and type(ours) is type(theirs) and self._is_moved(ours, theirs):
                continue
            self._compare_identity(path, ours, theirs)
            if ours is not theirs and (id(ours), id(theirs)) not in self._seen:
                self._seen[id(ours), id(theirs)] = ours, theirs
                self._compare(path, ours, theirs)
        for has_equals, difference in self._divided.items():
            if self._asks_for_identity or (self._asks_for_membership and not has_equals):
                raise difference
        if self._last is not None:
            raise self._last

    def _is_moved(self, ours: Any, theirs: Any) -> bool:
        """Whether these are the name, or the path, of one module or of a file beside it, here and in the draft."""
        if isinstance(theirs, str) and plain_name(theirs) != theirs:
            return plain_name(theirs) == plain_name(ours)
        if not PurePath(theirs).is_relative_to(self._modules):
            return False
        parts = PurePath(theirs).relative_to(self._modules).parts
        return PurePath(ours).is_absolute() and (not parts or PurePath(ours).parts[-len(parts) :] == parts)

    def _compare_identity(self, path: _Path, ours: Any, theirs: Any) -> None:
        """Note an object of one side that is several objects of the other."""
        is_atom = type(ours) in ATOMS
        if is_atom and ours == ours:
            return
        has_equals = is_data(ours) and not is_atom
        for side, (one, other) in enumerate(((ours, theirs), (theirs, ours))):
            if self._partners[side].setdefault(id(one), other) is not other:
                where, elsewhere = _side(side == 0), _side(side == 1)
                text = f"{path.name} is one object in the {where} and several in the {elsewhere}, and a function"
                self._divided.setdefault(
                    has_equals, _Different(path, f"{text} compares by 'is' or 'in', or copies deeply.")
                )

    def _compare(self, path: _Path, ours: Any, theirs: Any) -> None:
        """Compare two objects but for their parts, which are then waiting."""
        try:
            is_installed_module = isinstance(ours, types.ModuleType) and is_installed(ours.__name__)
            if is_installed_module or isinstance(ours, CompGraphRunner):
                raise TypeError("what a module holds, and a runner's last run, is no part of its description")
            _compute_cached(ours, theirs)
            mine, others = describe(ours), describe(theirs)
        except Exception as error:  # whatever an object of a library raises that can't be copied
            text = f"{path.name} is a {type(ours).__name__!r}, made anew in the module, which can't be compared."
            raise _Different(path, f"{text} Make it inside the function.") from error
        if isinstance(ours, functools._lru_cache_wrapper):
            # It may hold what the function computed with other constants, which no module could make.
            ours.cache_clear()
        if mine[:2] != others[:2] or (mine.kind == "array" and not _is_laid_out_as(ours, theirs)):
            raise _unlike(path, ours, theirs)
        has_nan = mine.kind in ("dict", "set", "frozenset") and any(map(_has_nan, ours))
        if has_nan and [*map(id, ours)] != [*map(id, theirs)]:
            text = f"{path.name} has a key that is NaN, which is found by its identity alone. Use None in its place."
            self._last = self._last or _Different(path, text)
        left_out: tuple[str, ...] = (ANNOTATION,)
        if isinstance(ours, types.FunctionType) and ours.__code__ is not theirs.__code__:
            node = definition_of(ours.__code__)[1]
            if path.part and node is not None:
                path = _Path(path.root, _placed(f"Function {ours.__name__!r}", ours))
            left_out += self._compare_code(path, node, ours, theirs)
        elif isinstance(ours, type):
            path = _Path(path.root, _placed(f"Class {ours.__name__!r}", ours))
        elif isinstance(ours, Node):
            nodes = ours, theirs
            names = [name for node in nodes for name in vars(node) if is_set_by_runs(node, name)]
            left_out += tuple(f" attribute {name!r}" for name in names)
        parts, others_parts = dict(mine.parts), dict(others.parts)
        self._add_all(path, _without(parts, left_out), _without(others_parts, left_out))
        self._annotations.append((path, _annotations_in(parts), _annotations_in(others_parts)))
        if isinstance(ours, types.FunctionType) and not is_of_library(ours):
            read, others_read = ({f" {name!r}": part for name, part in module_reads(one)} for one in (ours, theirs))
            # Of a package, the notebook may have modules that no code of the bundle imports.
            extra = {name for name in read.keys() - others_read if isinstance(read[name], types.ModuleType)}
            self._add_all(path, {name: part for name, part in read.items() if name not in extra}, others_read)

    def _add_all(self, path: _Path, mine: Mapping[str, Any], others: Mapping[str, Any]) -> None:
        """Add parts by name, which must be the same in the same order."""
        if [*mine] != [*others]:
            only = sorted(mine.keys() ^ others.keys())
            if not only:
                raise _Different(path, f"{path.name} has another order in the module.")
            raise _Different(path, f"{path.name} has {only[0].strip()} only in the {_side(only[0] in mine)}.")
        self.waiting.extend((path.to(part), value, others[part]) for part, value in mine.items())

    def _compare_code(
        self, path: _Path, node: _Definition | None, ours: types.FunctionType, theirs: types.FunctionType
    ) -> tuple[str, ...]:
        """Compare two functions by their texts; return which parts that covers. Without a text it covers none."""
        other = definition_of(theirs.__code__)[1]
        if node is None and other is None:
            return ()
        if node is None or other is None or not _is_same_text(ours.__code__, node, theirs.__code__, other):
            raise _Different(path, "the notebook has it with another text than the cells have now.")
        parts = [*ast.walk(node)]
        self._asks_for_annotations |= not _READS_ANNOTATIONS.isdisjoint(_names(ours.__code__))
        self._asks_for_identity |= any(map(_asks_for_identity, parts))
        self._asks_for_membership |= any(isinstance(part, ast.In | ast.NotIn) for part in parts)
        # What an annotation names need not be there, and is not in the instructions where annotations are read late.
        names = {*annotated_names(node)}
        mine, others = meanings_of(ours, names), meanings_of(theirs, names)
        both = sorted(mine.keys() & others.keys())
        self.waiting.extend((path.to(f" {name!r}"), mine[name], others[name]) for name in both)
        return CODE, *(f" {name!r}" for name in names)


def _placed(what: str, value: Any) -> str:
    """Return how a reason calls an object, with its cell and line if it is a function or class of the notebook."""
    innermost = layers(without_nodes(value))[-1]
    if isinstance(innermost, types.FunctionType):
        return f"{what} ({place_of(innermost.__code__)})"
    statements = statements_of_class(value) if isinstance(value, type) else iter(())
    found = next((pair for pair in statements if _DRAFT not in pair[0]), None)
    return f"{what} ({place_in(found[0], found[1].lineno)})" if found else what


def _side(is_notebook: bool) -> str:
    return "notebook" if is_notebook else "module"


def _unlike(path: _Path, ours: Any, theirs: Any) -> _Different:
    mine, others = reprlib.repr(ours), reprlib.repr(theirs)
    if mine == others or isinstance(ours, types.FunctionType | type):
        return _Different(path, f"{path.name} is something else by now than when the cells are run again.")
    return _Different(path, f"{path.name} is {mine} in the notebook and {others} in the module.")


def _is_laid_out_as(ours: Any, theirs: Any) -> bool:
    """Whether two equal arrays lie in memory alike, which decides about the last digits of sums."""
    # A view with gaps is whole in the file that the module reads it from.
    is_whole = ours.flags.c_contiguous or ours.flags.f_contiguous
    return not is_whole or not ours.size or ours.strides == theirs.strides


def _without(parts: Mapping[str, Any], left_out: tuple[str, ...]) -> dict[str, Any]:
    return {label: part for label, part in parts.items() if not label.startswith(left_out)}


def _annotations_in(parts: Mapping[str, Any]) -> dict[str, Any]:
    return {label: part for label, part in parts.items() if label.startswith(ANNOTATION)}


def _compute_cached(ours: Any, theirs: Any) -> None:
    """Have an object of the module compute what the notebook's has kept of its cached properties."""
    if not is_installed(type(ours).__module__):
        for name in cached_properties(type(ours)) & getattr(ours, "__dict__", {}).keys():
            getattr(theirs, name)


def _has_nan(key: Any) -> bool:
    """Whether a key of a dict or an element of a set is NaN, or a tuple with one."""
    if type(key) in (tuple, frozenset):
        return any(map(_has_nan, key))
    return type(key) in ATOMS and key != key


# -- functions -------------------------------------------------------------------------------------------------------


def _is_same_text(code: types.CodeType, node: _Definition, other_code: types.CodeType, other: _Definition) -> bool:
    """Whether two functions have the same text, and the same names to Python."""
    # In a class Python calls what begins with two underscores otherwise. What is captured may be global elsewhere; the
    # annotations of a class inside are names only where they are not read late.
    but = {*annotated_names(node)}
    return _spelled(node) == _spelled(other) and _names(code) - but == _names(other_code) - but


def _spelled(node: _Definition) -> list[object]:
    """Return what a definition says but for its name, decorators, defaults and annotations."""
    given = node.args
    every = ([*given.posonlyargs, None, *given.args], [given.vararg], given.kwonlyargs, [given.kwarg])
    names = [[argument and argument.arg for argument in part] for part in every]
    body: list[ast.stmt] = [ast.Return(node.body)] if isinstance(node, ast.Lambda) else node.body
    return [*names, *spelled_tree(ast.Module(body, []))]


def _names(code: types.CodeType) -> set[str]:
    return {
        name
        for inner in nested_codes(code)
        for name in (*inner.co_names, *inner.co_freevars, *inner.co_varnames, *inner.co_cellvars)
    }


def _asks_for_identity(node: ast.AST) -> bool:
    """Whether a part of a function may ask which one of two equal objects it has."""
    if isinstance(node, ast.Name | ast.Attribute):
        return (node.id if isinstance(node, ast.Name) else node.attr) in ("id", "deepcopy", "is_", "is_not")
    if not isinstance(node, ast.Compare) or not any(isinstance(one, ast.Is | ast.IsNot) for one in node.ops):
        return False
    return not any(isinstance(side, ast.Constant) for side in (node.left, *node.comparators))
