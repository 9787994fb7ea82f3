"""The modules of the user's project that a bundle takes along: found, checked, copied as they are.

A module belongs to the project if it is neither Python's nor installed: a file beside the notebook, in a folder that a
cell puts on ``sys.path``, or in an editable install. It comes with every module of the project that its import
statements name, and with the files that it reads beside itself, as far as expressions of ``__file__`` or
``importlib.resources`` say which.

The checks name the line, before anything is executed: functions that the graph reaches must be those of the file as it
is now, may not write to what outlives a call, and may read no file that the text does not name.
"""

from __future__ import annotations

import ast
import importlib.resources
import importlib.util
import itertools
import os
import shutil
import sys
import types
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from inspect import CO_ASYNC_GENERATOR, CO_COROUTINE
from pathlib import Path, PurePath
from typing import Any, Final

from epypes.bundle.file_access import ON_EVERY_MACHINE
from epypes.bundle.manifest import OWN_MODULES
from epypes.bundle.objects import ATOMS, describe, is_installed, is_of_library, module_reads, without_nodes
from epypes.bundle.private_import import loaded_module, plain_name
from epypes.bundle.references import captured_by, imports_in, is_main_guard, namespace_of
from epypes.bundle.resolve import Definition, Refused, definition_of, place_in
from epypes.bundle.side_effects import (
    Patches,
    check_notebook_name,
    check_reads,
    check_state,
    imported_by,
    patches_in,
)
from epypes.run.guard import is_plain_array

_INSTALLED: Final = frozenset({"site-packages", "dist-packages"})
_PYTHON: Final = Path(os.__file__).resolve().parent
# What lies beside EPypes is of its own project.
_BESIDE_EPYPES: Final = Path(__file__).resolve().parents[2]
_PICKLES: Final = frozenset({".pkl", ".pickle", ".joblib"})
_RESTART: Final = "Restart the kernel, or call importlib.reload() with it, and run the cells again"
_PATH_FUNCTIONS: Final[tuple[Any, ...]] = (
    *(Path, PurePath, type(Path()), str, os.fspath, importlib.resources.files),
    *(os.path.join, os.path.dirname, os.path.abspath, os.path.realpath, os.path.normpath),
)
_PATH_METHODS: Final = frozenset({"joinpath", "resolve", "absolute", "with_name", "with_suffix", "as_posix"})
# Functions of importlib.resources and pkgutil that take a package and a name.
_RESOURCE_READERS: Final = frozenset({"read_text", "read_binary", "open_text", "open_binary", "path", "get_data"})
_UNKNOWN: Final = object()


@dataclass(frozen=True, slots=True)
class _OwnModule:
    """A module of the project: its plain name, its file, the folder above its outermost package, and its text."""

    name: str
    file: Path
    root: Path
    text: str
    tree: ast.Module
    names: Mapping[str, Any]

    @property
    def what(self) -> str:
        return f"Module {self.name!r}"

    def place_in(self, node: ast.AST) -> str:
        return place_in(str(self.file), getattr(node, "lineno", 1))


class OwnModules:
    """The modules that a bundle takes along.

    Parameters
    ----------
    names
        The modules that its ``pipeline.py`` imports, by the names that Python knows them by; those that are installed
        are passed over.

    Attributes
    ----------
    refusals
        Why they can't be taken along.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self.refusals: list[str] = []
        self._files: dict[str, bytes | Path] = {}
        self._modules: dict[str, _OwnModule] = {}
        self._seen: set[str] = set()
        # By module: its names for paths that are made of __file__.
        self._anchors: dict[str, set[str]] = {}
        self._collect(names)

    def _collect(self, names: Iterable[str]) -> None:
        """Take modules along, and what they import."""
        waiting = [*names]
        while waiting:
            # With its packages, whose __init__ is executed first.
            for name in itertools.accumulate(waiting.pop().split("."), "{}.{}".format):
                if name not in self._seen:
                    self._seen.add(name)
                    try:
                        waiting += self._add(name)
                    except Refused as refusal:
                        self.refusals.append(str(refusal))

    def _add(self, full: str) -> list[str]:
        """Take a module along if it is one of the project; return the names of the modules that it imports."""
        name, path = plain_name(full), _location(full)
        if path is None:
            _check_is_known(name, full)
            return []
        root = _root(name, path)
        if name == full[: len(name)] and name.partition(".")[0] in ("epypes", "epypes_widgets"):
            return []
        if not _is_of_project(path, root):
            if name.rpartition(".")[0] in self._modules:
                top = name.partition(".")[0]
                raise Refused(f"Package {top!r} is here in part and installed in part ({path}). Rename the one here.")
            return []
        if name.partition(".")[0] in sys.stdlib_module_names:
            text = f"Module {name!r} ({path}) has the name of a module of Python, which others would get in its place"
            raise Refused(f"{text}. Rename it.")
        if path.is_dir():
            return []
        try:
            source = path.read_bytes()
            text = importlib.util.decode_source(source)
            tree = ast.parse(text)
        except (OSError, SyntaxError, ValueError) as error:
            what = f"Module {name!r} is no file of Python text ({path}: {error})"
            raise Refused(f"{what}. Install its package with pip, not as editable.") from error
        relative = f"{name.replace('.', '/')}{'/__init__' if path.name == '__init__.py' else ''}.py"
        if root / relative != path or path.suffix != ".py":
            raise Refused(f"Module {name!r} is not at the place that its name says: {path}. Put it there.")
        tree.body = [node for node in tree.body if not is_main_guard(node)]
        package = full if path.name == "__init__.py" else full.rpartition(".")[0]
        self._put(relative, source, f"Module {name!r}", path)
        names = getattr(loaded_module(full), "__dict__", {"__name__": full, "__package__": package})
        self._modules[name] = _OwnModule(name, path, root, text, tree, names)
        return imports_in(tree, names)

    def _put(self, relative: str, content: bytes | Path, what: str, path: Path) -> None:
        if self._files.setdefault(relative, content) != content:
            text = f"{what} ({path}) is there twice, with another content"
            raise Refused(f"{text}. Give one of the two another name.")

    def write(self, bundle: Path) -> None:
        """Write the modules, and the files that they read, into a bundle."""
        for relative, content in self._files.items():
            path = bundle / OWN_MODULES / relative
            path.parent.mkdir(parents=True, exist_ok=True)
            if isinstance(content, Path):
                shutil.copyfile(content, path)
            else:
                path.write_bytes(content)

    # -- checks ------------------------------------------------------------------------------------------------------

    def check(self, values: Iterable[Any], patches: Patches) -> None:
        """Check the code that some values reach, and note the refusals.

        Parameters
        ----------
        values
            The functions of the graph, and what else the bundle is made of.
        patches
            What the notebook has changed in libraries.
        """
        if not self._modules:
            return
        functions = sorted(_reached(values), key=lambda function: function.__code__.co_filename)
        # A package may import what a function needs only when it is asked for, by a name that no text has.
        homes = {str(function.__globals__.get("__name__")): function.__globals__ for function in functions}
        loaded = {name: loaded_module(name) for name in homes if name != "__main__"}
        self._collect(name for name, module in loaded.items() if module and vars(module) is homes[name])
        by_file = {str(module.file): module for module in self._modules.values()}
        own_patches = {
            key: place
            for module in self._modules.values()
            for key, place in patches_in([(str(module.file), module.text)], module.names).items()
            if is_installed(str(getattr(key[0], "__module__", None) or key[0].__name__))
        }
        known = {**patches, **own_patches}
        self._anchors = self._find_anchors()
        checks: list[tuple[Sequence[ast.AST], Definition | None, _OwnModule]]
        checks = [(module.tree.body, None, module) for module in self._modules.values()]
        for function in functions:
            home = by_file.get(function.__code__.co_filename)
            if home is None or function.__code__.co_flags & (CO_COROUTINE | CO_ASYNC_GENERATOR):
                continue
            try:
                found = _definition(function, home)
                check_state(found)
                check_reads(found, known)
                for name in found.reads():
                    if not name.startswith("__") and name not in home.names:
                        check_notebook_name(name, found)
                checks.append(([found.node], found, home))
            except Refused as refusal:
                self.refusals.append(str(refusal))
        for body, definition, module in checks:
            try:
                self._take_files(module, body, definition)
            except Refused as refusal:
                self.refusals.append(str(refusal))
        self.refusals = list(dict.fromkeys(self.refusals))

    def _take_files(self, module: _OwnModule, body: Sequence[ast.AST], found: Definition | None) -> None:
        """Take along the files that a function, or the top of a module, reads beside it."""
        names = {**module.names, **(imported_by(found) if found is not None else {})}
        nodes = [*_executed(body, into_functions=found is not None)]
        parents = {child: node for node in nodes for child in ast.iter_child_nodes(node)}
        anchors = set(self._anchors[module.name])
        if found is not None:
            for node in nodes:
                if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                    value, name = _path_value(node.value, names), node.targets[0].id
                    names |= {name: value} if isinstance(value, str | PurePath) else {}
                    anchors |= {name} if self._has_anchor(node.value, anchors, names) else set()
        is_named: set[ast.AST | None] = set()
        for node in nodes:
            if self._is_anchor(node, anchors, names):
                whole = node
                while isinstance(_path_value(_around(whole, parents), names), str | PurePath):
                    whole = _around(whole, parents)
                is_named.update(ast.walk(whole))
                if isinstance(_path_value(whole, names), str | PurePath):
                    self._take(whole, parents.get(whole), module, names)
        # Docstrings; and texts of the module's constants, which count where a function reads them.
        unread = {node.value for node in nodes if isinstance(node, ast.Expr)} | is_named
        unread |= {node.value for node in nodes if found is None and isinstance(node, ast.Assign | ast.AnnAssign)}
        for node in nodes:
            text = getattr(node, "value", None) if isinstance(node, ast.Constant) else None
            text = names.get(node.id) if found is not None and isinstance(node, ast.Name) else text
            if type(text) is str and node not in unread:
                _check_text(text, module, module.place_in(node))

    def _find_anchors(self) -> dict[str, set[str]]:
        """Return by module the names of paths that are made of ``__file__``, also those taken from other modules."""
        found = {name: {"__file__"} for name in self._modules}
        self._anchors, before = found, 0
        while before != (before := sum(map(len, found.values()))):
            for module in self._modules.values():
                own = found[module.name]
                for node in module.tree.body:
                    if isinstance(node, ast.ImportFrom):
                        source = found.get(plain_name(imports_in(ast.Module([node], []), module.names)[0]), set())
                        own |= {alias.asname or alias.name for alias in node.names if alias.name in source}
                    elif isinstance(node, ast.Assign | ast.AnnAssign) and self._has_anchor(
                        node.value, own, module.names
                    ):
                        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                        own |= {target.id for target in targets if isinstance(target, ast.Name)}
        return found

    def _has_anchor(self, tree: ast.AST | None, anchors: Collection[str], names: Mapping[str, Any]) -> bool:
        return tree is not None and any(self._is_anchor(node, anchors, names) for node in ast.walk(tree))

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

    def _take(self, whole: ast.AST, parent: ast.AST | None, module: _OwnModule, names: Mapping[str, Any]) -> None:
        path, place = Path(_path_value(whole, names)), module.place_in(whole)
        is_kept = isinstance(parent, ast.Assign | ast.AnnAssign)
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
            self._put(path.relative_to(roots[0]).as_posix(), path, "File", path)


def _check_is_known(name: str, full: str) -> None:
    top = name.partition(".")[0]
    if top == "__main__":
        raise Refused("A module imports the notebook itself, as '__main__'. Pass what it needs in as an argument.")
    if name == top and loaded_module(full) is not None and top not in sys.stdlib_module_names:
        raise Refused(f"Module {name!r} has no file: it was made by a call. Write it into a file, and import that.")


def _check_text(text: str, module: _OwnModule, place: str) -> None:
    """Refuse a text that names a file of this machine, which is not there, or another one, where the bundle runs."""
    path = PurePath(text)
    # A folder such as /tmp or /data is on every machine.
    is_here = path.parts[2:] and not text.startswith(ON_EVERY_MACHINE) if path.is_absolute() else path.suffix
    if is_here and _INSTALLED.isdisjoint(path.parts) and os.path.exists(text):
        what = f"{module.what} names {text!r}{'' if path.is_absolute() else ', a file in the current folder'} ({place})"
        way_out = f"Put it beside the module and write Path(__file__).parent / {path.name!r}"
        raise Refused(f"{what}, which a service has not. {way_out}, or pass its content in as a token.")


def _definition(function: types.FunctionType, module: _OwnModule) -> Definition:
    """Return the definition of a function in the file of its module as it is now."""
    code = function.__code__
    what = f"Function {code.co_qualname!r} of module {module.name!r}"
    lines, node = definition_of(code)
    if node is None:
        place = place_in(code.co_filename, code.co_firstlineno)
        raise Refused(f"{what} is not what its file says ({place}): the file was changed since. {_RESTART}.")
    if isinstance(node, ast.Lambda):
        node = ast.copy_location(ast.FunctionDef("<lambda>", node.args, [ast.Return(node.body)], []), node)
        ast.fix_missing_locations(node)
    return Definition(what, node, code.co_filename, lines, namespace_of(function), function, captured_by(function), ())


def _reached(values: Iterable[Any]) -> Iterator[types.FunctionType]:
    """Give the user's functions that values refer to, each once."""
    waiting, seen = [*values], dict[int, Any]()
    while waiting:
        value = without_nodes(waiting.pop())
        if type(value) in ATOMS or is_plain_array(value) or id(value) in seen:
            continue
        seen[id(value)] = value
        with suppress(Exception):  # whatever an object raises that can't be described
            waiting += [part for _, part in describe(value).parts]
        if isinstance(value, types.FunctionType) and not is_of_library(value):
            yield value
            waiting += [part for _, part in module_reads(value)]


# -- places ------------------------------------------------------------------------------------------------------------


def _location(full: str) -> Path | None:
    """Return the file of a module, or the folder of a package without one; None if it has neither, or is not there."""
    loaded = loaded_module(full)
    parent, _, last = full.rpartition(".")
    if loaded is not None:
        places = [getattr(loaded, "__file__", None), *getattr(loaded, "__path__", ())]
        return next((Path(place) for place in places if isinstance(place, str)), None)
    if not parent:
        try:
            spec = importlib.util.find_spec(full)
        except (ImportError, ValueError):
            return None
        places = [spec.origin if spec.has_location else None, *(spec.submodule_search_locations or ())] if spec else []
        return next((Path(place) for place in places if place), None)
    above = _location(parent)
    if above is None or not (above.is_dir() or above.name == "__init__.py"):
        return None
    folder = above if above.is_dir() else above.parent
    candidates = [folder / last / "__init__.py", folder / f"{last}.py", *folder.glob(f"{last}.*.so"), folder / last]
    return next((path for path in candidates if path.exists()), None)


def _root(name: str, path: Path) -> Path:
    """Return the folder in which the outermost package of a module lies."""
    depth = name.count(".") + (path.name == "__init__.py" or path.is_dir())
    return path.parents[min(depth - path.is_dir(), len(path.parents) - 1)]


def _is_of_project(path: Path, root: Path) -> bool:
    whole = path.resolve()
    is_installed = not _INSTALLED.isdisjoint(path.parts) or not _INSTALLED.isdisjoint(whole.parts)
    return not is_installed and not whole.is_relative_to(_PYTHON) and root.resolve() != _BESIDE_EPYPES


def _executed(body: Iterable[ast.AST], *, into_functions: bool) -> Iterator[ast.AST]:
    """Give the nodes of some statements; those in functions only if asked for."""
    for node in body:
        yield node
        parts = [*ast.iter_child_nodes(node)]
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) and not into_functions:
            parts = [node.args, *getattr(node, "decorator_list", [])]
        yield from _executed(parts, into_functions=into_functions)


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
