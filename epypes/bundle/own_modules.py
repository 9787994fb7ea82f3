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
from collections.abc import Iterable, Iterator
from contextlib import suppress
from importlib.machinery import ModuleSpec, PathFinder
from inspect import CO_ASYNC_GENERATOR, CO_COROUTINE
from pathlib import Path
from typing import Any, Final

from epypes.bundle.manifest import OWN_MODULES
from epypes.bundle.objects import ATOMS, INSTALLED, describe, is_installed, is_of_library, module_reads, without_nodes
from epypes.bundle.package_data import OwnModule, PackageData
from epypes.bundle.private_import import loaded_module, plain_name
from epypes.bundle.references import captured_by, is_main_guard, namespace_of
from epypes.bundle.resolve import Definition, Refused, as_function, definition_of, imports_in, noted_refusals, place_in
from epypes.bundle.side_effects import (
    Patches,
    check_notebook_name,
    check_reads,
    check_state,
    patches_in,
)
from epypes.run.guard import is_plain_array

_PYTHON: Final = Path(os.__file__).resolve().parent
# What lies beside EPypes is of its own project.
_BESIDE_EPYPES: Final = Path(__file__).resolve().parents[2]
_OURS: Final = ("epypes", "epypes_widgets")
_RESTART: Final = "Restart the kernel, or call importlib.reload() with it, and run the cells again"


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
        functions = sorted(functions_reached_by(values), key=lambda function: function.__code__.co_filename)
        # A package may import what a function needs only when it is asked for, by a name that no text has.
        homes = {str(function.__globals__.get("__name__")): function.__globals__ for function in functions}
        loaded = {name: loaded_module(name) for name in homes if name != "__main__"}
        self._collect(name for name, module in loaded.items() if module and vars(module) is homes[name])
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
