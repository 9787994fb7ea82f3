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
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any, Final

from epypes.bundle.file_access import ON_EVERY_MACHINE
from epypes.bundle.objects import INSTALLED, is_installed
from epypes.bundle.private_import import plain_name
from epypes.bundle.resolve import Definition, Refused, imports_in, place_in
from epypes.bundle.side_effects import imported_by

_PICKLES: Final = frozenset({".pkl", ".pickle", ".joblib"})
_PATH_FUNCTIONS: Final[tuple[Any, ...]] = (
    *(Path, PurePath, type(Path()), str, os.fspath, importlib.resources.files),
    *(os.path.join, os.path.dirname, os.path.abspath, os.path.realpath, os.path.normpath),
)
_PATH_METHODS: Final = frozenset({"joinpath", "resolve", "absolute", "with_name", "with_suffix", "as_posix"})
# Functions of importlib.resources and pkgutil that take a package and a name.
_RESOURCE_READERS: Final = frozenset({"read_text", "read_binary", "open_text", "open_binary", "path", "get_data"})


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
        anchors = set(self._anchors[module.name])
        for node, parent in _outermost_paths(body, names, into_functions=found is not None):
            value, is_own = _path_value(node, names), self._has_anchor(node, anchors, names)
            place = module.place_in(node)
            if is_own and found is not None and isinstance(parent, ast.Assign):
                for name in (target.id for target in parent.targets if isinstance(target, ast.Name)):
                    if name in anchors and names[name] != value:
                        what = f"{module.what} has two paths by the name {name!r} ({place})"
                        raise Refused(f"{what}, so that its text does not say which files it reads. Use two names.")
                    names[name] = value
                    anchors.add(name)
            # Texts of the module's constants count where a function reads them.
            is_unread = isinstance(parent, ast.Assign | ast.AnnAssign) or isinstance(node, ast.Name)
            if is_own:
                self._take(Path(value), node, parent, module, place)
            elif type(value) is str and (found is not None or not is_unread):
                _check_text(value, module, place)

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

    def _take(self, path: Path, node: ast.AST, parent: ast.AST | None, module: OwnModule, place: str) -> None:
        # A folder by a name, whose uses are looked at too.
        is_kept = isinstance(parent, ast.Assign) and all(isinstance(target, ast.Name) for target in parent.targets)
        is_search_path = isinstance(parent, ast.Call) and ast.unparse(parent.func).startswith("sys.path.")
        if is_search_path or (path.is_dir() and is_kept):
            return
        what = f"{module.what} reads files beside itself ({place}: {ast.unparse(node)})"
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


# -- paths -------------------------------------------------------------------------------------------------------------


def _outermost_paths(
    body: Sequence[ast.AST], names: Mapping[str, Any], *, into_functions: bool
) -> Iterator[tuple[ast.AST, ast.AST | None]]:
    """Give the outermost expressions of paths and texts in what is executed, each with the statement or call it is of.

    What assigns to the attributes of a class is none; docstrings are left out. ``names`` may be added to meanwhile.
    """
    waiting: list[tuple[ast.AST, ast.AST | None]] = [(node, None) for node in reversed(body)]
    while waiting:
        node, parent = waiting.pop()
        if isinstance(node, ast.expr) and isinstance(_path_value(node, names), str | PurePath):
            yield node, parent
            continue
        parts = [*ast.iter_child_nodes(node)]
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) and not into_functions:
            parts = [node.args, *getattr(node, "decorator_list", [])]
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            parts = []
        is_of_class = isinstance(parent, ast.ClassDef) and isinstance(node, ast.Assign)
        waiting += [(part, None if is_of_class else node) for part in reversed(parts)]


def _path_value(node: ast.AST, names: Mapping[str, Any]) -> Any:
    """Return the value of an expression that makes a path of names, texts and functions for paths; else None."""
    try:
        return _evaluated(node, names)
    except Refused:
        raise
    except Exception:  # whatever a function for paths raises for what is no path
        return None


def _evaluated(node: ast.AST, names: Mapping[str, Any]) -> Any:
    match node:
        case ast.Constant(value=str() | int() as value):
            return value
        case ast.Name(id=name):
            return {"str": str, **names}[name]
        case ast.Attribute(value=inner, attr=name):
            value = _evaluated(inner, names)
            if isinstance(value, types.ModuleType) or (isinstance(value, PurePath) and name[:6] == "parent"):
                return getattr(value, name)
        case ast.Subscript(value=inner, slice=index):
            return _evaluated(inner, names)[_evaluated(index, names)]
        case ast.BinOp(left=left, op=ast.Div() | ast.Add() as operator, right=right):
            one, other = _evaluated(left, names), _evaluated(right, names)
            if isinstance(one, str if isinstance(operator, ast.Add) else PurePath):
                return one + other if isinstance(operator, ast.Add) else one / other
        case ast.FormattedValue(value=inner, conversion=-1, format_spec=None):
            return str(_evaluated(inner, names))
        case ast.JoinedStr(values=values):
            return "".join(_evaluated(value, names) for value in values)
        case ast.Call(keywords=[]):
            return _called(node, [_evaluated(argument, names) for argument in node.args], names)
    raise ValueError("no path")


def _called(node: ast.Call, arguments: list[Any], names: Mapping[str, Any]) -> Any:
    if isinstance(node.func, ast.Attribute) and node.func.attr in _PATH_METHODS:
        value = _path_value(node.func.value, names)
        if isinstance(value, PurePath):
            return getattr(value, node.func.attr)(*arguments)
    function = _evaluated(node.func, names)
    home = str(getattr(function, "__module__", ""))
    is_reader = home.startswith(("importlib.resources", "pkgutil")) and function.__name__ in _RESOURCE_READERS
    if not is_reader and not any(function is one for one in _PATH_FUNCTIONS):
        raise ValueError("no function for paths")
    if is_reader or function is importlib.resources.files:
        package, *parts = arguments
        if isinstance(node.args[0], ast.Constant) and not is_installed(package):
            what = f"Module {plain_name(str(names['__name__']))!r} reads files by {ast.unparse(node)}"
            place = place_in(str(names.get("__file__")), node.lineno)
            way_out = f"Write {ast.unparse(node.func)}(__package__), and the rest of the path behind it."
            raise Refused(f"{what} ({place}), which a bundle has under another name. {way_out}")
        function, arguments = importlib.resources.files(package).joinpath, parts
    return function(*arguments)
