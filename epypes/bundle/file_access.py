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
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import Any, Final, Self

_SYSTEM: Final = (
    *("/bin", "/boot", "/dev", "/etc", "/lib", "/lib32", "/lib64", "/proc", "/run", "/sbin", "/sys", "/usr"),
    *("/System", "/Library", "/var/cache", "/var/lib"),
)
_EVENTS: Final = frozenset({"open", "os.listdir", "os.scandir", "sqlite3.connect"})
_WAY_OUT: Final = (
    "The bundle is not alone with it. Pass its content in as a token, keep it in a variable of the notebook, or put "
    "it into the data of a package that is installed and read it with importlib.resources."
)
_LONGEST: Final = 1000
# A text that may name a file, and what has it.
_Named = tuple[str, str]


class FileAccess:
    """Notes, while its block runs, which files the bundle's functions open.

    Parameters
    ----------
    folder
        The bundle.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._is_on = False
        self._opened: dict[str, str] = {}
        self._made: set[str] = set()
        self._before: dict[_Named, tuple[int, ...] | None] = {}

    def __enter__(self) -> Self:
        self._is_on = True
        sys.addaudithook(self._on_event)  # which can't be taken away again
        self._note(_texts_of(self._folder))
        return self

    def __exit__(self, *exception: object) -> None:
        self._is_on = False

    def also_in(self, values: Mapping[str, Any]) -> None:
        """Look for names of files in values of hyperparameters too."""
        for token, value in values.items():
            self._note((text, f"Hyperparameter {token!r} (pipeline.toml)") for text in _texts_in(value))

    def _note(self, named: Iterable[_Named]) -> None:
        self._before |= {entry: _state(entry[0]) for entry in named}

    @property
    def files(self) -> tuple[str, ...]:
        """Why the bundle is not alone: a sentence for each file that is not its own."""
        own = self._own_folders()
        found = {
            path: f"{what} opens {path}. {_WAY_OUT}"
            for path, what in self._opened.items()
            if path not in self._made and not _is_in(path, own)
        }
        for (text, what), before in self._before.items():
            path = os.path.realpath(text) if before else ""
            # A file that has changed meanwhile was written, not read.
            if path and not _is_in(path, own) and _state(text) == before:
                found.setdefault(path, f"{what} names {text}, which is there. {_WAY_OUT}")
        return tuple(found.values())

    def _own_folders(self) -> set[str]:
        """Return the folders whose files are there wherever the bundle's requirements are."""
        home = Path("~").expanduser()
        packages = (module for name, module in [*sys.modules.items()] if "." not in name)
        folders = [
            *(self._folder, os.getcwd(), sys.prefix, sys.base_prefix, sys.exec_prefix, *sysconfig.get_paths().values()),
            *(folder for module in packages for folder in getattr(module, "__path__", ())),
            *(home / ".cache", home / ".config", *_SYSTEM),
            *filter(None, (os.environ.get(name) for name in ("XDG_CACHE_HOME", "XDG_CONFIG_HOME"))),
        ]
        return {os.path.realpath(folder) for folder in folders} - {os.sep, os.path.realpath(home)}

    def _on_event(self, event: str, given: tuple[Any, ...]) -> None:
        if not self._is_on or event not in _EVENTS or not isinstance(given[0], str | bytes | os.PathLike):
            return
        what = self._running_function()
        if not what:
            return
        path = os.path.realpath(os.fsdecode(given[0]))
        flags = given[2] if event == "open" and isinstance(given[2], int) else 0
        if flags & os.O_TRUNC or not os.path.exists(path):
            self._made.add(path)
        elif not flags & os.O_WRONLY:
            self._opened.setdefault(path, what)

    def _running_function(self) -> str:
        """Return which function of the bundle is running; "" if none is, or it is importing a module."""
        frame: FrameType | None = sys._getframe(2)
        while frame is not None:
            file = frame.f_code.co_filename
            if file.startswith("<frozen importlib"):
                return ""
            if Path(file).parent == self._folder:
                name = frame.f_code.co_name
                return (
                    f"{'The module' if name == '<module>' else f'{name}()'} ({Path(file).name}, line {frame.f_lineno})"
                )
            frame = frame.f_back
        return ""


def named_here(folder: Path) -> list[str]:
    """Return a sentence for each text of a bundle that names a file in the current folder, which a replay has not."""
    return [
        f"{what} names {text!r}, a file in the current folder here. The current folder is another one there. {_WAY_OUT}"
        for text, what in _texts_of(folder)
        if text.strip("./ ") and not os.path.isabs(text)
        if os.path.isfile(text) or (os.sep in text and os.path.isdir(text))
    ]


def _texts_of(folder: Path) -> Iterator[_Named]:
    """Give the strings in a bundle's module with the function that has each; not those that nothing reads."""
    module = folder / "pipeline.py"
    try:
        tree = ast.parse(module.read_bytes())
    except (OSError, SyntaxError, ValueError):
        return
    functions: dict[ast.AST, str] = {}
    for node in ast.walk(tree):  # a function before the functions in it
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            functions |= dict.fromkeys(ast.walk(node), f"{node.name}()")
    unread = {node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if not isinstance(node, ast.Constant) or node in unread or not isinstance(node.value, str):
            continue
        if len(node.value) <= _LONGEST and node.value.isprintable():
            yield node.value, f"{functions.get(node, 'The module')} ({module.name}, line {node.lineno})"


def _texts_in(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | tuple | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _texts_in(part)


def _state(path: str) -> tuple[int, ...] | None:
    """Return what changes when a file is written; None for what is no file with an absolute path, or that all have."""
    try:
        found = os.stat(path)
    except (OSError, ValueError):
        return None
    is_common = len(Path(path).parts) < 3 or os.path.realpath(path) == os.path.realpath(tempfile.gettempdir())
    return None if is_common or not os.path.isabs(path) else (found.st_ino, found.st_size, found.st_mtime_ns)


def _is_in(path: str, folders: Iterable[str]) -> bool:
    return any(path == folder or path.startswith(folder.rstrip(os.sep) + os.sep) for folder in folders)
