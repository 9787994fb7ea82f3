"""The import system of one bundle: modules of the user's project that no other code finds, and that find each other.

A bundle holds such modules verbatim. Two bundles in one process may have two versions of a module, and the notebook a
third one. So all code of a bundle has builtins of its own, whose ``__import__`` looks among the bundle's modules first,
also in an import statement inside a function, and leaves everything else to Python.

Python knows the module ``mylib.edges`` of a bundle as ``epypes_bundle_1.mylib.edges``. It is in ``sys.modules`` only
while an import statement of its bundle runs: classes look for their module there when they are made, and modules that
import each other. Afterwards the bundle's functions alone keep it alive. Bytecode, which no manifest covers, is neither
read nor written.
"""

from __future__ import annotations

import builtins
import importlib
import importlib.util
import itertools
import sys
import threading
import types
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.machinery import ModuleSpec, SourceFileLoader
from pathlib import Path, PurePosixPath
from typing import Any, Final
from weakref import WeakValueDictionary

from epypes.bundle.manifest import OWN_MODULES

_PREFIX: Final = "epypes_bundle_"
# What pipeline.py is called among the modules of its bundle; no module of a project has this name.
_PIPELINE: Final = "__pipeline__"
_NUMBERS: Final = itertools.count(1)


class PrivateImport:
    """The ``__import__`` of one bundle.

    Parameters
    ----------
    folder
        The bundle. Its modules are read here, and executed when they are imported.

    Attributes
    ----------
    name
        What the names of its modules begin with.
    modules
        Those that were imported, by the name that Python knows them by.
    """

    def __init__(self, folder: Path) -> None:
        self.name = f"{_PREFIX}{next(_NUMBERS)}"
        self._root = folder / OWN_MODULES
        files = [path for path in self._root.rglob("*") if path.is_file() and path.suffix != ".pyc"]
        self._sources = {_below(self._root, path): path.read_bytes() for path in files if path.suffix == ".py"}
        self._folders = {str(parent) for path in files for parent in PurePosixPath(_below(self._root, path)).parents}
        package = types.ModuleType(self.name)
        package.__path__ = [str(self._root)]
        self.modules: dict[str, types.ModuleType] = {self.name: package}
        self.builtins: Mapping[str, Any] = {**vars(builtins), "__import__": self}
        self._lock, self._depth = threading.RLock(), 0
        _IMPORTS[self.name] = self
        if _Finder not in sys.meta_path:
            sys.meta_path.insert(0, _Finder)

    def execute(self, path: Path) -> types.ModuleType:
        """Execute the text of ``pipeline.py``, which is at a path, as a module."""
        module = types.ModuleType(f"{self.name}.{_PIPELINE}")
        module.__file__ = str(path)
        vars(module)["__builtins__"] = self.builtins
        with self._registered():
            sys.modules[module.__name__] = module
            try:
                exec(compile(path.read_bytes(), str(path), "exec", dont_inherit=True), vars(module))  # noqa: S102
            finally:
                del sys.modules[module.__name__]
        return module

    def name_of(self, module: str) -> str:
        """Return the name by which Python knows a module that an absolute import of the bundle's code names."""
        top = module.partition(".")[0]
        return f"{self.name}.{module}" if top in self._folders or f"{top}.py" in self._sources else module

    def __call__(
        self,
        name: str,
        globals: Mapping[str, Any] | None = None,  # noqa: A002 - an import statement passes them by these names
        locals: Mapping[str, Any] | None = None,  # noqa: A002
        fromlist: Sequence[str] | None = (),
        level: int = 0,
    ) -> types.ModuleType:
        """Import as ``builtins.__import__`` does."""
        package = (globals or {}).get("__package__")
        full = importlib.util.resolve_name("." * level + name, package) if level else self.name_of(name)
        if not full.startswith(f"{self.name}."):
            return __import__(name, globals, locals, fromlist or (), level)
        top = ".".join(full.split(".")[:2])
        known = self.modules.get(full if fromlist else top)
        if known and full in self.modules and all(each != "*" and hasattr(known, each) for each in fromlist or ()):
            return known
        try:
            with self._registered():
                module: types.ModuleType = importlib.__import__(full, fromlist=fromlist or ("__name__",))
                return module if fromlist else sys.modules[top]
        except ModuleNotFoundError as error:
            if error.name and error.name.startswith(f"{self.name}."):
                missing = plain_name(error.name)
                raise ModuleNotFoundError(f"No module named {missing!r}", name=missing) from error
            raise

    @contextmanager
    def _registered(self) -> Iterator[None]:
        """Have the modules of the bundle among those of Python."""
        with self._lock:
            sys.modules.update(self.modules)
            self._depth += 1
            try:
                yield
            finally:
                self._depth -= 1
                if not self._depth:
                    names = [name for name in [*sys.modules] if name.partition(".")[0] == self.name]
                    self.modules = {name: sys.modules.pop(name) for name in names}

    def spec_of(self, full: str) -> ModuleSpec | None:
        """Return how a module of the bundle is loaded; None if it has none of this name."""
        place = full[len(self.name) + 1 :].replace(".", "/") or "."
        is_package = f"{place}/__init__.py" in self._sources
        if not is_package and f"{place}.py" in self._sources:
            path = str(self._root / f"{place}.py")
            return importlib.util.spec_from_file_location(full, path, loader=_Loader(self, full, path))
        if place not in self._folders:
            return None
        path = str(self._root / place / "__init__.py")
        # Also the folder itself, which all names begin with.
        spec = ModuleSpec(full, _Loader(self, full, path), origin=path if is_package else None, is_package=True)
        spec.has_location = is_package
        spec.submodule_search_locations = [str(self._root / place)]
        return spec

    def source_of(self, path: str) -> bytes:
        """Return the text of a module as it was when the bundle was read; a package without one has none."""
        return self._sources.get(_below(self._root, Path(path)), b"")


# Weak: a bundle that nobody uses any more goes, with its modules.
_IMPORTS: Final[WeakValueDictionary[str, PrivateImport]] = WeakValueDictionary()


class _Loader(SourceFileLoader):
    """Loads a module of a bundle from the text that was read with it; one that was loaded before as it is."""

    def __init__(self, own: PrivateImport, full: str, path: str) -> None:
        super().__init__(full, path)
        self._own = own

    def create_module(self, spec: ModuleSpec) -> types.ModuleType | None:
        return self._own.modules.get(spec.name)

    def get_code(self, fullname: str) -> types.CodeType:
        code: types.CodeType = compile(self._own.source_of(self.path), self.path, "exec", dont_inherit=True)
        return code

    def exec_module(self, module: types.ModuleType) -> None:
        if module.__name__ not in self._own.modules:
            vars(module)["__builtins__"] = self._own.builtins
            super().exec_module(module)


class _Finder:
    """The finder of the modules of all bundles, by the names that no import statement has.

    ``importlib.resources`` asks for one when a function calls it; from then on that is in ``sys.modules``.
    """

    @staticmethod
    def find_spec(fullname: str, path: object = None, target: object = None) -> ModuleSpec | None:
        own = _IMPORTS.get(fullname.partition(".")[0])
        return own.spec_of(fullname) if own is not None else None


def _below(root: Path, path: Path) -> str:
    return path.relative_to(root).as_posix()


# -- names -------------------------------------------------------------------------------------------------------------


def plain_name(module: str) -> str:
    """Return the name of a module as import statements have it."""
    top, _, name = module.partition(".")
    return name if top.startswith(_PREFIX) and name else module


def loaded_module(module: str) -> types.ModuleType | None:
    """Return the module of a name, also one of a bundle; None if it was not imported."""
    own = _IMPORTS.get(module.partition(".")[0])
    return (own.modules.get(module) if own is not None else None) or sys.modules.get(module)


def import_module(module: str) -> types.ModuleType:
    """Import a module by its name, also one of a bundle."""
    own = _IMPORTS.get(module.partition(".")[0])
    return importlib.import_module(module) if own is None else own(plain_name(module), fromlist=("__name__",))


def name_meant(module: str, names: Mapping[str, Any]) -> str:
    """Return the name by which Python knows a module that an import statement in a namespace names."""
    own = _IMPORTS.get(str(names.get("__name__")).partition(".")[0])
    return module if own is None else own.name_of(module)
