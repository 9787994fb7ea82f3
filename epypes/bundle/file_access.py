"""File access of a bundle while it is replayed: the files outside of it that its functions read.

A relative path is found by the replay itself, whose working folder is another one. For absolute paths, an audit hook
hears of every file that Python opens. Libraries in C open files without it; their names are looked for in the text of
the module and in the values of hyperparameters.
"""

from __future__ import annotations

import ast
import os
import sys
import sysconfig
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Final, Self

_SYSTEM: Final = ("/bin", "/boot", "/dev", "/etc", "/lib", "/lib32", "/lib64", "/proc", "/run", "/sbin", "/sys", "/usr")
_SYSTEM_TOO: Final = ("/System", "/Library", "/var/cache", "/var/lib")
_EVENTS: Final = frozenset({"open", "os.listdir", "os.scandir", "sqlite3.connect"})
_WAY_OUT: Final = (
    "The bundle is not alone with it. Pass its content in as a token, keep it in a variable of the notebook, or put "
    "it into the data of a package that is installed and read it with importlib.resources."
)
_LONGEST: Final = 1000


@dataclass(frozen=True, slots=True)
class Named:
    """A text that may name a file, and where it stands."""

    text: str
    what: str


class FileAccess:
    """While its block runs, it is noted which files the bundle's functions open.

    Parameters
    ----------
    folder
        The bundle.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._is_on = False
        self._files: dict[str, str] = {}
        self._made: set[str] = set()

    def __enter__(self) -> Self:
        self._is_on = True
        sys.addaudithook(self._on_event)  # which can't be taken away again
        self._before = {named: _state(named.text) for named in _named_in(self._folder)}
        return self

    def __exit__(self, *exception: object) -> None:
        self._is_on = False

    def also_in(self, values: Mapping[str, Any]) -> None:
        """Look for names of files in values of hyperparameters too."""
        for token, value in values.items():
            named = (Named(text, f"Hyperparameter {token!r} (pipeline.toml)") for text in _texts_in(value))
            self._before |= {text: _state(text.text) for text in named}

    @property
    def files(self) -> tuple[str, ...]:
        """Why the bundle is not alone: a sentence for each file that is not its own."""
        own = self._own_places()
        opened = {path: what for path, what in self._files.items() if not _is_in(path, own) and path not in self._made}
        found = [f"{what} opens {path}. {_WAY_OUT}" for path, what in opened.items()]
        for named, before in self._before.items():
            path = os.path.realpath(named.text)
            # What is another one now was written, not read.
            if before is None or path in opened or _is_in(path, own) or _state(named.text) != before:
                continue
            found.append(f"{named.what} names {named.text}, which is there. {_WAY_OUT}")
        return tuple(found)

    def _own_places(self) -> tuple[str, ...]:
        """Return the folders whose files are there wherever the bundle's requirements are."""
        packages = [folder for module in [*sys.modules.values()] for folder in _folders_of(module)]
        installed = [sys.prefix, sys.base_prefix, sys.exec_prefix, *sysconfig.get_paths().values()]
        home = Path("~").expanduser()
        caches = [os.environ.get("XDG_CACHE_HOME", ""), home / ".cache", os.environ.get("XDG_CONFIG_HOME", "")]
        places = [self._folder, os.getcwd(), *installed, *packages, *caches, home / ".config", *_SYSTEM, *_SYSTEM_TOO]
        return tuple(
            {os.path.realpath(str(place)) for place in places if str(place)} - {os.sep, os.path.realpath(home)}
        )

    def _on_event(self, event: str, given: tuple[Any, ...]) -> None:
        if not self._is_on or event not in _EVENTS or not isinstance(given[0], str | bytes | os.PathLike):
            return
        what = self._function_at_work()
        if not what:
            return
        path = os.path.realpath(os.fsdecode(given[0]))
        flags = given[2] if event == "open" and isinstance(given[2], int) else 0
        if flags & os.O_TRUNC or not os.path.exists(path):
            self._made.add(path)
        elif not flags & os.O_WRONLY:
            self._files.setdefault(path, what)

    def _function_at_work(self) -> str:
        """Return which function of the bundle is at work; "" if none is, or a module is being imported by it."""
        frame: FrameType | None = sys._getframe(2)
        while frame is not None:
            file = frame.f_code.co_filename
            if file.startswith("<frozen importlib"):
                return ""
            if Path(file).parent == self._folder:
                return _place(frame.f_code.co_name, Path(file).name, frame.f_lineno)
            frame = frame.f_back
        return ""


def named_here(folder: Path) -> list[str]:
    """Return a sentence for each text of a bundle that names a file in the current folder, which a replay has not."""
    return [
        f"{named.what} names {named.text!r}, a file in the current folder here. The current folder is another one "
        f"there. {_WAY_OUT}"
        for named in _named_in(folder)
        if _is_file_here(named.text)
    ]


def _named_in(folder: Path) -> list[Named]:
    """Return the texts in a bundle's module, which may name a file."""
    module = folder / "pipeline.py"
    try:
        return [*_texts(ast.parse(module.read_bytes()), "<module>", module.name)]
    except (OSError, SyntaxError, ValueError):
        return []


def _texts(node: ast.AST, function: str, file: str) -> Iterator[Named]:
    """Give the strings in a module, but for those that nothing reads, as docstrings."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
            continue
        if isinstance(child, ast.Constant) and isinstance(child.value, str) and child.value[:_LONGEST] == child.value:
            if child.value.isprintable():
                yield Named(child.value, _place(function, file, child.lineno))
            continue
        yield from _texts(child, child.name if isinstance(child, ast.FunctionDef | ast.ClassDef) else function, file)


def _texts_in(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | tuple | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _texts_in(part)


def _place(function: str, file: str, line: int) -> str:
    return f"The module ({file}, line {line})" if function == "<module>" else f"{function}() ({file}, line {line})"


def _state(path: str) -> tuple[int, ...] | None:
    """Return what changes when a file is written; None for what is no file with an absolute path, or that all have."""
    try:
        found = os.stat(path)
    except (OSError, ValueError):
        return None
    is_common = len(Path(path).parts) < 3 or os.path.realpath(path) == os.path.realpath(tempfile.gettempdir())
    return None if is_common or not os.path.isabs(path) else (found.st_ino, found.st_size, found.st_mtime_ns)


def _is_file_here(text: str) -> bool:
    """Whether a text is the relative path of a file, or of a folder with a slash in its name."""
    try:
        is_there = os.path.isfile(text) or (os.sep in text and os.path.isdir(text))
    except ValueError:
        return False
    return is_there and not os.path.isabs(text) and bool(text.strip(". /"))


def _folders_of(module: Any) -> list[str]:
    """Return the folders of a package; a module outside of one has none of its own."""
    name = getattr(module, "__name__", "")
    is_top = isinstance(name, str) and "." not in name
    return [str(folder) for folder in getattr(module, "__path__", ())] if is_top else []


def _is_in(path: str, places: tuple[str, ...]) -> bool:
    return any(path == place or path.startswith(place.rstrip(os.sep) + os.sep) for place in places)
