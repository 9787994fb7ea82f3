"""The modules of the user's project that a bundle takes along: found, checked, copied as they are.

A module belongs to the project if it is neither Python's nor installed: a file beside the notebook, in a folder that a
cell puts on ``sys.path``, or in an editable install. It comes with every module of the project that its import
statements name, and with the files that it reads beside itself, as far as expressions of ``__file__`` or
``importlib.resources`` say which. Such expressions are evaluated, with the values that their names have, as far as they
are made of paths, texts and functions for paths. One that names a file takes it along; one that leads to a folder, or
to nothing, is refused with its line, and so is a text that names another file of this machine. What is executed counts:
the top of a module, and functions that the graph reaches.

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
from importlib.machinery import ModuleSpec, PathFinder
from inspect import CO_ASYNC_GENERATOR, CO_COROUTINE
from pathlib import Path, PurePath
from typing import Any, Final

from epypes.bundle.manifest import OWN_MODULES
from epypes.bundle.private_import import loaded_module, plain_name
from epypes.bundle.proof.file_access import ON_EVERY_MACHINE
from epypes.bundle.source.objects import (
    ATOMS,
    INSTALLED,
    describe,
    is_installed,
    is_of_library,
    module_reads,
    without_nodes,
)
from epypes.bundle.source.references import captured_by, is_main_guard, namespace_of
from epypes.bundle.source.resolve import (
    Definition,
    Refused,
    as_function,
    definition_of,
    imports_in,
    noted_refusals,
    place_in,
)
from epypes.bundle.source.side_effects import (
    Patches,
    check_notebook_name,
    check_reads,
    check_state,
    imported_by,
    patches_in,
)
from epypes.errors import InvalidValue
from epypes.run.guard import is_plain_array

_PYTHON: Final = Path(os.__file__).resolve().parent
# What lies beside EPypes is of its own project.
_BESIDE_EPYPES: Final = Path(__file__).resolve().parents[3]
_OURS: Final = ("epypes", "epypes_widgets")
_RESTART: Final = "Restart the kernel, or call importlib.reload() with it, and run the cells again"

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
    registering
        Those that no import statement of the others names, by the names that Python knows them by: what they have was
        registered with the others, or is imported only when it is asked for.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self.refusals: list[str] = []
        self.registering: list[str] = []
        self._files: dict[str, bytes | Path] = {}
        self._modules: dict[str, OwnModule] = {}
        self._seen: set[str] = set()
        self._is_own: dict[str, bool] = {}
        self._collect(names)

    def _collect(self, names: Iterable[str]) -> None:
        """Take modules along, and what they import."""
        waiting = [*names]
        while waiting:
            # With its packages, whose __init__ is executed first.
            for name in itertools.accumulate(waiting.pop().split("."), "{}.{}".format):
                if name not in self._seen:
                    self._seen.add(name)
                    with noted_refusals(self.refusals):
                        waiting += self._add(name)

    def _add(self, full: str) -> list[str]:
        """Take a module along if it is one of the project; return the names of the modules that it imports."""
        name, path = plain_name(full), _location(full)
        if path is None:
            _check_is_known(name, full)
            return []
        root, top = _root(name, path), name.partition(".")[0]
        if path.is_dir() or top in _OURS:
            return []
        is_own = _is_of_project(path, root)
        if self._is_own.setdefault(top, is_own) != is_own:
            text = f"Package {top!r} is in part of the project and in part installed: {name!r} is {path}"
            raise Refused(f"{text}. Give that of the project another name.")
        if not is_own:
            return []
        if top in sys.stdlib_module_names:
            text = f"Module {name!r} ({path}) has the name of a module of Python, which others would get in its place"
            raise Refused(f"{text}. Rename it.")
        try:
            source = path.read_bytes()
            text = importlib.util.decode_source(source)
            tree = ast.parse(text)
        except (OSError, SyntaxError, ValueError) as error:
            what = f"Module {name!r} is no file of Python text ({path}: {error})"
            way_out = "Restore it; if it is compiled, install its package with pip, and not as editable"
            raise Refused(f"{what}. {way_out}.") from error
        relative = f"{name.replace('.', '/')}{'/__init__' if path.name == '__init__.py' else ''}.py"
        if root / relative != path or path.suffix != ".py":
            raise Refused(f"Module {name!r} is not at the place that its name says: {path}. Put it there.")
        tree.body = [node for node in tree.body if not is_main_guard(node)]
        package = full if path.name == "__init__.py" else full.rpartition(".")[0]
        self._put(relative, source, f"Module {name!r}", path)
        names = getattr(loaded_module(full), "__dict__", {"__name__": full, "__package__": package})
        self._modules[name] = OwnModule(name, path, root, text, tree, names)
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

    def check(self, reached: Iterable[types.FunctionType], patches: Patches) -> None:
        """Check the code that the graph reaches, and note the refusals.

        Parameters
        ----------
        reached
            The user's functions that the graph, and what else the bundle is made of, refer to.
        patches
            What the notebook has changed in libraries.
        """
        if not self._modules:
            return
        functions = sorted(reached, key=lambda function: function.__code__.co_filename)
        # What a module has registered, or a package imports only when it is asked for, has a home that no text names.
        homes = {str(function.__globals__.get("__name__")): function.__globals__ for function in functions}
        loaded = {name: loaded_module(name) for name in homes if name != "__main__"}
        named = {*self._modules}
        self._collect(name for name, module in loaded.items() if module and vars(module) is homes[name])
        self.registering += [name for name in loaded if plain_name(name) in self._modules.keys() - named]
        by_file = {str(module.file): module for module in self._modules.values()}
        own_patches = {
            key: place
            for file, module in by_file.items()
            for key, place in patches_in([(file, module.text)], module.names).items()
            if is_installed(str(getattr(key[0], "__module__", None) or key[0].__name__))
        }
        known, data = {**patches, **own_patches}, PackageData(self._modules)
        for module in self._modules.values():
            with noted_refusals(self.refusals):
                data.take_files(module, module.tree.body, None)
        for function in functions:
            home = by_file.get(function.__code__.co_filename)
            if home is not None and not function.__code__.co_flags & (CO_COROUTINE | CO_ASYNC_GENERATOR):
                with noted_refusals(self.refusals):
                    found = _definition(function, home)
                    check_state(found)
                    check_reads(found, known)
                    for name in found.reads():
                        if not name.startswith("__") and name not in home.names:
                            check_notebook_name(name, found)
                    data.take_files(home, [found.node], found)
        for relative, path in data.files.items():
            with noted_refusals(self.refusals):
                self._put(relative, path, "File", path)
        self.refusals = list(dict.fromkeys(self.refusals))


def _check_is_known(name: str, full: str) -> None:
    top = name.partition(".")[0]
    if top == "__main__":
        raise Refused("A module imports the notebook itself, as '__main__'. Pass what it needs in as an argument.")
    if name == top and loaded_module(full) is not None and top not in sys.stdlib_module_names:
        raise Refused(f"Module {name!r} has no file: it was made by a call. Write it into a file, and import that.")


def _definition(function: types.FunctionType, module: OwnModule) -> Definition:
    """Return the definition of a function in the file of its module as it is now."""
    code = function.__code__
    what = f"Function {code.co_qualname!r} of module {module.name!r}"
    lines, node = definition_of(code)
    if node is None:
        place = place_in(code.co_filename, code.co_firstlineno)
        raise Refused(f"{what} is not what its file says ({place}): the file was changed since. {_RESTART}.")
    node = as_function(node) if isinstance(node, ast.Lambda) else node
    return Definition(what, node, code.co_filename, lines, namespace_of(function), function, captured_by(function), ())


def functions_reached_by(values: Iterable[Any]) -> Iterator[types.FunctionType]:
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


# -- the files that modules read ---------------------------------------------------------------------------------------


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
            if is_own:
                self._take(Path(value), node, parent, module, place)
                continue
            # Texts of the module's constants count where a function reads them.
            is_unread = found is None and isinstance(parent, ast.Assign | ast.AnnAssign)
            for part in ast.walk(node):
                text = getattr(part, "value", None) if isinstance(part, ast.Constant) and not is_unread else None
                text = names.get(part.id) if found is not None and isinstance(part, ast.Name) else text
                if type(text) is str:
                    _check_text(text, module, place)

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
            return names[name] if name != "str" or name in names else str
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
    raise InvalidValue("no path")


def _called(node: ast.Call, arguments: list[Any], names: Mapping[str, Any]) -> Any:
    if isinstance(node.func, ast.Attribute) and node.func.attr in _PATH_METHODS:
        value = _path_value(node.func.value, names)
        if isinstance(value, PurePath):
            return getattr(value, node.func.attr)(*arguments)
    function = _evaluated(node.func, names)
    home = str(getattr(function, "__module__", ""))
    is_reader = home.startswith(("importlib.resources", "pkgutil")) and function.__name__ in _RESOURCE_READERS
    if not is_reader and not any(function is one for one in _PATH_FUNCTIONS):
        raise InvalidValue("no function for paths")
    if is_reader or function is importlib.resources.files:
        package, *parts = arguments
        if isinstance(node.args[0], ast.Constant) and not is_installed(package):
            what = f"Module {plain_name(str(names['__name__']))!r} reads files by {ast.unparse(node)}"
            place = place_in(str(names.get("__file__")), node.lineno)
            way_out = f"Write {ast.unparse(node.func)}(__package__), and the rest of the path behind it."
            raise Refused(f"{what} ({place}), which a bundle has under another name. {way_out}")
        function, arguments = importlib.resources.files(package).joinpath, parts
    return function(*arguments)


# -- places ------------------------------------------------------------------------------------------------------------


def _location(full: str) -> Path | None:
    """Return the file of a module, or the folder of a package without one; None if it has neither, or is not there."""
    loaded = loaded_module(full)
    if loaded is not None:
        places = [getattr(loaded, "__file__", None), *getattr(loaded, "__path__", ())]
    else:
        spec = _spec(full)
        places = [spec.origin if spec.has_location else None, *(spec.submodule_search_locations or ())] if spec else []
    return next((Path(place) for place in places if isinstance(place, str)), None)


def _spec(full: str) -> ModuleSpec | None:
    """Return how a module would be imported, without an import of the packages around it."""
    parent = full.rpartition(".")[0]
    with suppress(ImportError, ValueError):
        if not parent:
            return importlib.util.find_spec(full)
        above = loaded_module(parent) or _spec(parent)
        path = getattr(above, "__path__", None) or getattr(above, "submodule_search_locations", None)
        return PathFinder.find_spec(full, [*path]) if path else None
    return None


def _root(name: str, path: Path) -> Path:
    """Return the folder in which the outermost package of a module lies."""
    depth = name.count(".") + (path.name == "__init__.py" or path.is_dir())
    return path.parents[min(depth - path.is_dir(), len(path.parents) - 1)]


def _is_of_project(path: Path, root: Path) -> bool:
    whole = path.resolve()
    is_installed = not INSTALLED.isdisjoint(path.parts) or not INSTALLED.isdisjoint(whole.parts)
    return not is_installed and not whole.is_relative_to(_PYTHON) and root.resolve() != _BESIDE_EPYPES
