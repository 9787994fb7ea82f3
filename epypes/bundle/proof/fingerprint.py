"""Fingerprints: digests of a value or a function and of everything that it refers to.

A digest goes over what `objects` says that a value is made of, in an order that is the same in every process. Code
counts by its instructions: its text may not be there in another process, and `versions_of` adds the version of Python.
Installed packages count by name; `versions_of` adds their versions. Modules of the user count by what functions read of
them, also those that a function imports when it is called.

Two things a digest can't cover: an object that can't be described, such as a generator or an object of a C library, is
unknown; and what a function reads from files or the environment is not part of it. The digester names the first of
each, and then equal digests are no proof that nothing has changed.
"""

from __future__ import annotations

import hashlib
import re
import sys
import types
from collections.abc import Iterable, Mapping
from importlib import metadata
from pathlib import Path, PurePath
from typing import Any, Final

from epypes.bundle.private_import import plain_name
from epypes.bundle.requirements import bringing
from epypes.bundle.source.kept_files import READERS
from epypes.bundle.source.objects import (
    ATOMS,
    CACHED,
    Description,
    atom_content,
    describe,
    describe_message,
    is_installed,
    is_of_library,
    module_reads,
    will_be_installed,
    without_nodes,
)
from epypes.bundle.source.references import imported_modules, nested_codes

_DIGEST_BYTES: Final = 16
_OURS: Final = "epypes"
# Builtins by which code reads what its names don't say.
_BY_TEXT: Final = frozenset({"eval", "exec", "globals", "__import__"})
# Names by which code reads files or the environment.
_READERS: Final = READERS | {"environ", "environb", "getenv", "getenvb", "urlopen"}
# Objects of these have all their content in what pickle writes of them.
_DATA_MODULES: Final = frozenset(
    {"builtins", "collections", "datetime", "decimal", "fractions", "numpy", "pathlib", "uuid"}
)
# What these have is no data, whatever it is that has them.
_CODE: Final = (types.FunctionType, type, types.ModuleType)
# Whether equal ones are one object differs from process to process.
_IMMUTABLE: Final = ATOMS | {tuple, frozenset, types.CodeType}
_NAMED: Final = re.compile("'(.*)'$")


def combined_digest(*parts: bytes | memoryview | str) -> bytes:
    """Return a digest of several parts, each with its length, so that no two lists of parts have the same."""
    made = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    _add_parts(made, parts)
    return made.digest()


def file_digest(path: Path) -> str:
    """Return a digest of a file's content, and of its suffix, which decides how it is read; "" if it can't be read."""
    try:
        # To open a named pipe would wait for a process that writes into it.
        if not path.is_file():
            return ""
        with path.open("rb") as file:
            # The fastest one: processors have instructions for it.
            content = hashlib.file_digest(file, "sha256").digest()
    except OSError:
        return ""
    return combined_digest("file", path.suffix.lower(), content).hex()


def _add_parts(made: Any, parts: Iterable[bytes | memoryview | str]) -> None:
    for part in parts:
        raw = part.encode("utf-8", "surrogatepass") if isinstance(part, str) else part
        made.update(b"\0%d:" % len(raw))
        made.update(raw)


class Digester:
    """The digest of a value and of all that it refers to, in an order that is the same in every process.

    An object that comes again counts by the number that it got the first time, so cycles end, and the time is linear
    in what there is. Immutable values and arrays are written each time.

    Parameters
    ----------
    of_data
        Whether objects of installed packages are unknown unless they are plain data or a message can carry them: what
        pickle writes of a shared memory or a stored array is its name, and not its content.

    Attributes
    ----------
    code, state
        Two digests: of functions, classes and immutable values; and of what is in lists, dicts, arrays and objects,
        which a call may change.
    modules, state_modules
        The names of the modules that were met in each of the two.
    unknown
        The first object that can't be described, as text; "" if there is none.
    reader
        The first name by which a function reads files or the environment; "" if there is none.
    """

    def __init__(self, *, of_data: bool = False) -> None:
        self.code = hashlib.blake2b(digest_size=_DIGEST_BYTES)
        self.state = hashlib.blake2b(digest_size=_DIGEST_BYTES)
        self.modules: set[str] = set()
        self.state_modules: set[str] = set()
        self.unknown = ""
        self.reader = ""
        self._into, self._met = self.code, self.modules
        # With the objects themselves, so that no other gets the identity of one.
        self._numbers: dict[int, tuple[int, Any]] = {}
        self._path: list[str] = []
        self._of_data = of_data

    def digest(self) -> bytes:
        """Return one digest of code and state."""
        return combined_digest(self.code.digest(), self.state.digest())

    def add(self, value: Any) -> None:
        """Add a value, and all that it refers to."""
        try:
            self._add(value)
        except RecursionError:
            self._add_unknown(value)

    def _put(self, *parts: str | bytes | memoryview) -> None:
        _add_parts(self._into, parts)

    def _add_unknown(self, value: Any, what: str = "") -> None:
        kind = type(value).__qualname__
        self._put("unknown", kind)
        names = (found[1] for label in reversed(self._path) if (found := _NAMED.search(label)))
        name = next(names, "")
        self.unknown = self.unknown or (what or f"a {kind!r}") + (f" as {name!r}" if name else "")

    def _add(self, value: Any) -> None:
        if type(value) in ATOMS:
            self._put(type(value).__name__, atom_content(value))
            return
        value = without_nodes(value)
        if id(value) in self._numbers:
            self._put("again", str(self._numbers[id(value)][0]))
            return
        made = self._described(value)
        if made is None:
            self._add_unknown(value)
            return
        if type(value) not in _IMMUTABLE and made.kind not in ("array", "installed"):
            self._numbers[id(value)] = len(self._numbers), value
        before = self._into, self._met, self._of_data
        if made.is_state:
            self._into, self._met = self.state, self.state_modules
        self._of_data = self._of_data and not isinstance(value, _CODE)
        if made.module:
            self._met.add(made.module)
        self._put(made.kind, *made.content)
        parts = [(label, part) for label, part in made.parts if not label.startswith(CACHED)]
        if isinstance(value, PurePath):
            self._put(file_digest(Path(value)))
        elif isinstance(value, types.FunctionType) and not is_of_library(value):
            parts += self._read_elsewhere(value, dict(parts))
        elif made.kind == "module" and value.__name__ == "__main__":
            self._add_unknown(value)
        self._put(str(len(parts)))
        for label, part in parts:
            self._put(label)
            self._path.append(label)
            self._add(part)
            self._path.pop()
        self._into, self._met, self._of_data = before

    def _described(self, value: Any) -> Description | None:
        """Return what a value is made of; None if its content can't be described."""
        try:
            made, home = describe(value), type(value).__module__
            if self._of_data and made.is_pickled and is_installed(home) and home.partition(".")[0] not in _DATA_MODULES:
                made = describe_message(value)
        except RecursionError:
            raise
        except Exception:  # whatever an object raises
            return None
        return made

    def _read_elsewhere(self, function: types.FunctionType, parts: Mapping[str, Any]) -> list[tuple[str, Any]]:
        """Return what a function reads of the user's modules, by name; note what it reads by text or from files."""
        codes = [*nested_codes(function.__code__)]
        used = {name for code in codes for name in code.co_names}
        waiting = [(label.strip(" '"), value) for label, value in parts.items()]
        by_text = min(_BY_TEXT.intersection(dict(waiting)) - function.__globals__.keys(), default="")
        if by_text or "import_module" in used:
            self._add_unknown(function, f"a call of {by_text or 'import_module'!r}")
        self._met.update(filter(will_be_installed, imported_modules(function)))
        found = module_reads(function)
        waiting += found
        own_functions = {name.rpartition(".")[2] for name, value in waiting if isinstance(value, types.FunctionType)}
        self.reader = self.reader or min(_READERS & used - own_functions, default="")
        return found


# -- modules ---------------------------------------------------------------------------------------------------------


def versions_of(modules: Iterable[str]) -> list[str]:
    """Return a line for each of these modules: the versions of its distributions, or the digest of its own file."""
    found = {"python": sys.version}
    for name in modules:
        if plain_name(name) != name:
            continue  # a bundle's own module, whose number is another one in each process
        top, file = name.partition(".")[0], getattr(sys.modules.get(name), "__file__", None)
        if top == _OURS:
            found[top] = metadata.version(_OURS)
        elif top not in sys.modules or is_installed(name):
            found[top] = ", ".join(f"{one}=={metadata.version(one)}" for one in bringing(top))
        elif file:
            found[name] = file_digest(Path(file))
    return sorted(f"{name} {version}" for name, version in found.items())
