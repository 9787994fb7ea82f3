"""Package data: the files that modules of the user's project read beside themselves.

A module names them by expressions of ``__file__`` or by ``importlib.resources``. Such expressions are evaluated here,
with the values that their names have, as far as they are made of paths, texts and functions for paths. An expression
that names a file takes it along; one that leads to a folder, or to nothing, is refused with its line, and so is a text
that names another file of this machine. What is executed counts: the top of a module, and functions that the graph
reaches.
"""

from __future__ import annotations

import ast
import importlib.resources
import os
import types
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any, Final

from epypes.bundle.file_access import ON_EVERY_MACHINE
from epypes.bundle.objects import INSTALLED, is_installed
from epypes.bundle.private_import import plain_name
from epypes.bundle.references import imports_in
from epypes.bundle.resolve import Definition, Refused, place_in
from epypes.bundle.side_effects import imported_by

_PICKLES: Final = frozenset({".pkl", ".pickle", ".joblib"})
_PATH_FUNCTIONS: Final[tuple[Any, ...]] = (
    *(Path, PurePath, type(Path()), str, os.fspath, importlib.resources.files),
    *(os.path.join, os.path.dirname, os.path.abspath, os.path.realpath, os.path.normpath),
)
_PATH_METHODS: Final = frozenset({"joinpath", "resolve", "absolute", "with_name", "with_suffix", "as_posix"})
# Functions of importlib.resources and pkgutil that take a package and a name.
_RESOURCE_READERS: Final = frozenset({"read_text", "read_binary", "open_text", "open_binary", "path", "get_data"})
_UNKNOWN: Final = object()


@dataclass(frozen=True, slots=True)
class OwnModule:
    """A module of the user's project.

    Attributes
    ----------
    name
        Its name as import statements have it.
    file
        Its file.
    root
        The folder in which its outermost package lies.
    text, tree
        Its text, and the syntax tree of that without what is executed only where the file is run as a program.
    names
        What its names mean by now; where it has not been imported, what import statements need.
    """

    name: str
    file: Path
    root: Path
    text: str
    tree: ast.Module
    names: Mapping[str, Any]

    @property
    def what(self) -> str:
        """How reasons call it."""
        return f"Module {self.name!r}"

    def place_in(self, node: ast.AST) -> str:
        """Return the place of a part of it."""
        return place_in(str(self.file), getattr(node, "lineno", 1))


class PackageData:
    """The files that some modules read beside themselves.

    Parameters
    ----------
    modules
        The modules by name.

    Attributes
    ----------
    files
        What is taken along, by its path below the folder in which the outermost package of its module lies.
    """

    def __init__(self, modules: Mapping[str, OwnModule]) -> None:
        self.files: dict[str, Path] = {}
        # By module: its names for paths that are made of __file__.
        self._anchors = {name: {"__file__"} for name in modules}
        before = 0
        while before != (before := sum(map(len, self._anchors.values()))):
            for module in modules.values():
                self._find_anchors(module)

    def take_files(self, module: OwnModule, body: Sequence[ast.AST], found: Definition | None) -> None:
        """Take along the files that a function, or the top of a module, reads beside it."""
        names = {**module.names, **(imported_by(found) if found is not None else {})}
        nodes = [*_executed(body, into_functions=found is not None)]
        parents = {child: node for node in nodes for child in ast.iter_child_nodes(node)}
        anchors = set(self._anchors[module.name])
        if found is not None:
            for node in nodes:
                if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                    value, name = _path_value(node.value, names), node.targets[0].id
                    if isinstance(value, str | PurePath) and self._has_anchor(node.value, anchors, names):
                        if name in anchors and names[name] != value:
                            what = f"{module.what} has two paths by the name {name!r} ({module.place_in(node)})"
                            raise Refused(f"{what}, so that its text does not say which files it reads. Use two names.")
                        names[name] = value
                        anchors.add(name)
        is_named: set[ast.AST | None] = set()
        for node in nodes:
            if self._is_anchor(node, anchors, names):
                whole = node
                while isinstance(_path_value(_around(whole, parents), names), str | PurePath):
                    whole = _around(whole, parents)
                is_named.update(ast.walk(whole))
                if isinstance(_path_value(whole, names), str | PurePath):
                    self._take(whole, parents, module, names)
        # Docstrings; and texts of the module's constants, which count where a function reads them.
        unread = {node.value for node in nodes if isinstance(node, ast.Expr)} | is_named
        unread |= {node.value for node in nodes if found is None and isinstance(node, ast.Assign | ast.AnnAssign)}
        for node in nodes:
            text = getattr(node, "value", None) if isinstance(node, ast.Constant) else None
            text = names.get(node.id) if found is not None and isinstance(node, ast.Name) else text
            if type(text) is str and node not in unread:
                _check_text(text, module, module.place_in(node))

    def _find_anchors(self, module: OwnModule) -> None:
        """Find a module's names for paths that are made of ``__file__``, also those taken from other modules."""
        own = self._anchors[module.name]
        for node in module.tree.body:
            if isinstance(node, ast.ImportFrom):
                source = self._anchors.get(plain_name(next(iter(imports_in(node, module.names)), "")), set())
                own |= {alias.asname or alias.name for alias in node.names if alias.name in source}
            elif isinstance(node, ast.Assign) and self._has_anchor(node.value, own, module.names):
                own |= {target.id for target in node.targets if isinstance(target, ast.Name)}

    def _has_anchor(self, tree: ast.AST, anchors: Collection[str], names: Mapping[str, Any]) -> bool:
        return any(self._is_anchor(node, anchors, names) for node in ast.walk(tree))

    def _is_anchor(self, node: ast.AST, anchors: Collection[str], names: Mapping[str, Any]) -> bool:
        """Whether a part of an expression is a path of the module's own place, or a call that reads beside it."""
        match node:
            case ast.Name(id=name, ctx=ast.Load()):
                return name in anchors
            case ast.Attribute(value=inner, attr=name):
                home = _path_value(inner, names)
                is_own = isinstance(home, types.ModuleType)
                return is_own and name in self._anchors.get(plain_name(home.__name__), ())
            case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name)):
                return name in {*_RESOURCE_READERS, "files"} and isinstance(_path_value(node, names), PurePath)
        return False

    def _take(
        self, whole: ast.AST, parents: Mapping[ast.AST, ast.AST], module: OwnModule, names: Mapping[str, Any]
    ) -> None:
        path, place, parent = Path(_path_value(whole, names)), module.place_in(whole), parents.get(whole)
        # By a name whose uses are looked at, too; not as an attribute.
        is_kept = isinstance(parent, ast.Assign) and not isinstance(parents.get(parent), ast.ClassDef)
        is_kept &= all(isinstance(target, ast.Name) for target in getattr(parent, "targets", ()))
        is_search_path = isinstance(parent, ast.Call) and ast.unparse(parent.func).startswith("sys.path.")
        if is_search_path or (path.is_dir() and is_kept):
            return
        what = f"{module.what} reads files beside itself ({place}: {ast.unparse(whole)})"
        if path.is_dir():
            raise Refused(
                f"{what}, and its text does not say which of {path}. Write the name of each, as in "
                'Path(__file__).parent / "x.npy", or pass the content in as a token.'
            )
        if not path.is_file():
            raise Refused(f"{what}: {path}, which is not there. Make the file, or pass its content in as a token.")
        # The project may lie behind a link, which a function has resolved.
        roots = [root for root in (module.root, module.root.resolve()) if path.is_relative_to(root)]
        if not roots:
            raise Refused(f"{what}: {path} is outside of {module.root}. Put it beside the module, or make it a token.")
        if path.suffix.lower() in _PICKLES:
            raise Refused(f"{what}: {path} is a pickle, which no bundle holds. Save its arrays by numpy.savez.")
        if path != module.file:
            self.files[path.relative_to(roots[0]).as_posix()] = path


def _check_text(text: str, module: OwnModule, place: str) -> None:
    """Refuse a text that names a file of this machine, which is not there, or another one, where the bundle runs."""
    path = PurePath(text)
    # A folder such as /tmp or /data is on every machine.
    is_here = path.parts[2:] and not text.startswith(ON_EVERY_MACHINE) if path.is_absolute() else path.suffix
    if is_here and INSTALLED.isdisjoint(path.parts) and os.path.exists(text):
        what = f"{module.what} names {text!r}{'' if path.is_absolute() else ', a file in the current folder'} ({place})"
        way_out = f"Put it beside the module and write Path(__file__).parent / {path.name!r}"
        raise Refused(f"{what}, which a service has not. {way_out}, or pass its content in as a token.")


def _executed(body: Iterable[ast.AST], *, into_functions: bool) -> Iterator[ast.AST]:
    """Give the nodes of some statements; those in functions only if asked for."""
    waiting = [*body][::-1]
    while waiting:
        node = waiting.pop()
        yield node
        parts = [*ast.iter_child_nodes(node)]
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) and not into_functions:
            parts = [node.args, *getattr(node, "decorator_list", [])]
        waiting += reversed(parts)


# -- paths -------------------------------------------------------------------------------------------------------------


def _around(node: ast.AST, parents: Mapping[ast.AST, ast.AST]) -> Any:
    """Return the expression around one; around what a method is called on, the call."""
    parent = parents.get(node)
    is_method = isinstance(parent, ast.Attribute) and parent.attr in _PATH_METHODS
    return parents.get(parent) if is_method and parent is not None else parent


def _path_value(node: ast.AST | None, names: Mapping[str, Any]) -> Any:
    """Return the value of an expression that makes a path of names, texts and functions for paths; else _UNKNOWN."""
    try:
        return _evaluated(node, names)
    except Refused:
        raise
    except Exception:  # whatever a function for paths raises for what is no path
        return _UNKNOWN


def _evaluated(node: ast.AST | None, names: Mapping[str, Any]) -> Any:
    match node:
        case ast.Constant(value=str() | int() as value):
            return value
        case ast.Name(id=name):
            return str if name == "str" and name not in names else names.get(name, _UNKNOWN)
        case ast.Attribute(value=inner, attr=name):
            value = _evaluated(inner, names)
            is_open = isinstance(value, types.ModuleType) or (isinstance(value, PurePath) and name[:6] == "parent")
            return getattr(value, name, _UNKNOWN) if is_open else _UNKNOWN
        case ast.Subscript(value=inner, slice=index):
            return _evaluated(inner, names)[_evaluated(index, names)]
        case ast.BinOp(left=left, op=ast.Div() | ast.Add() as operator, right=right):
            one, other = _evaluated(left, names), _evaluated(right, names)
            is_sum = isinstance(operator, ast.Add) and isinstance(one, str)
            return one + other if is_sum else one / other if isinstance(one, PurePath) else _UNKNOWN
        case ast.FormattedValue(value=inner, conversion=-1, format_spec=None):
            return str(_known(_evaluated(inner, names)))
        case ast.JoinedStr(values=values):
            return "".join(_known(_evaluated(value, names)) for value in values)
        case ast.Call(keywords=[]):
            return _called(node, [_known(_evaluated(argument, names)) for argument in node.args], names)
    return _UNKNOWN


def _known(value: Any) -> Any:
    if value is _UNKNOWN:
        raise ValueError
    return value


def _called(node: ast.Call, arguments: list[Any], names: Mapping[str, Any]) -> Any:
    if isinstance(node.func, ast.Attribute) and node.func.attr in _PATH_METHODS:
        value = _evaluated(node.func.value, names)
        if isinstance(value, PurePath):
            return getattr(value, node.func.attr)(*arguments)
    function = _evaluated(node.func, names)
    home = str(getattr(function, "__module__", ""))
    is_reader = home.startswith(("importlib.resources", "pkgutil")) and function.__name__ in _RESOURCE_READERS
    if not is_reader and not any(function is one for one in _PATH_FUNCTIONS):
        return _UNKNOWN
    if is_reader or function is importlib.resources.files:
        package, *parts = arguments
        if isinstance(node.args[0], ast.Constant) and not is_installed(package):
            what = f"Module {plain_name(str(names['__name__']))!r} reads files by {ast.unparse(node)}"
            place = place_in(str(names.get("__file__")), node.lineno)
            way_out = f"Write {ast.unparse(node.func)}(__package__), and the rest of the path behind it."
            raise Refused(f"{what} ({place}), which a bundle has under another name. {way_out}")
        found = importlib.resources.files(package)
        return found.joinpath(*parts) if parts else found
    return function(*arguments)
