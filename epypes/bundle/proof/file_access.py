"""File access: which files outside of a bundle its functions open or name."""

from __future__ import annotations

import ast
import os
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import Any, Final

from epypes.bundle.manifest import MODULE

ON_EVERY_MACHINE: Final = (
    *("/bin", "/boot", "/dev", "/etc", "/lib", "/lib32", "/lib64", "/proc", "/run", "/sbin", "/sys", "/usr"),
    *("/System", "/Library", "/var/cache", "/var/lib"),
)
_EVENTS: Final = frozenset({"open", "os.listdir", "os.scandir", "sqlite3.connect"})
_WAY_OUT: Final = (
    "The bundle is not alone with it. Pass its content in as a token, keep it in a variable of the notebook, or put "
    "it into the data of a package that is installed and read it with importlib.resources."
)


class FileAccess:
    """Notes from now on which files outside of a bundle its functions open.

    An audit hook receives every file that Python opens. Libraries in C open files without it, so their names are looked
    for in the text of the module and in the values of hyperparameters.

    Parameters
    ----------
    folder
        The bundle.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._opened: dict[str, str] = {}
        # What this run has made, what earlier ones have, and what of that was read.
        self._made: set[str] = set()
        self._made_before: set[str] = set()
        self._kept: dict[str, str] = {}
        # By path: what names it, and when it was written last.
        self._named: dict[str, tuple[str, int]] = {}
        sys.addaudithook(self._on_event)

    def note_names(self, hyperparameters: Mapping[str, Any]) -> None:
        """Note the files that the text of the module and values of hyperparameters name by an absolute path."""
        named = [*_texts_of(self._folder)]
        for token, value in hyperparameters.items():
            named += [(text, f"Hyperparameter {token!r} (pipeline.toml)") for text in _texts_in(value)]
        for text, what in named:
            # A folder such as /tmp or /data is on every machine, or is part of a longer name.
            if os.path.isabs(text) and Path(text).parts[2:] and os.path.exists(text):
                self._named.setdefault(text, (what, os.stat(text).st_mtime_ns))

    def begin_run(self) -> None:
        """Note that what was made up to now is of earlier runs: what this one reads of it is state."""
        self._made_before |= self._made
        self._made.clear()

    @property
    def files(self) -> tuple[str, ...]:
        """Why the bundle is not alone: a sentence for each file that is not its own."""
        found = {path: f"{what} opens {path}." for path, what in self._opened.items()}
        for text, (what, written_ns) in self._named.items():
            # A file that has changed meanwhile was written, not read.
            if os.path.exists(text) and os.stat(text).st_mtime_ns == written_ns:
                found.setdefault(os.path.realpath(text), f"{what} names {text}, which is there.")
        own = self._own_folders()
        outside = [
            f"{reason} {_WAY_OUT}"
            for path, reason in found.items()
            if os.path.exists(path) and not own & {path, *map(str, Path(path).parents)}
        ]
        own.discard(os.path.realpath(os.getcwd()))
        kept = [
            f"{what} reads {path}, which an earlier call has written: no answer may depend on an earlier event. "
            "Pass it in as a token."
            for path, what in self._kept.items()
            if not own & {path, *map(str, Path(path).parents)}
        ]
        return (*outside, *kept)

    def _own_folders(self) -> set[str]:
        """Return the folders whose files are there wherever the bundle's requirements are."""
        home = Path("~").expanduser()
        packages = (module for name, module in [*sys.modules.items()] if "." not in name)
        folders = [
            *(self._folder, os.getcwd(), sys.prefix, sys.base_prefix, *ON_EVERY_MACHINE),
            *(folder for module in packages for folder in getattr(module, "__path__", ())),
            *(os.environ.get("XDG_CACHE_HOME", home / ".cache"), os.environ.get("XDG_CONFIG_HOME", home / ".config")),
        ]
        return {os.path.realpath(folder) for folder in folders} - {os.sep, os.path.realpath(home)}

    def _on_event(self, event: str, given: tuple[Any, ...]) -> None:
        if event not in _EVENTS or not isinstance(given[0], str | bytes | os.PathLike):
            return
        if what := self._running_function():
            path = os.path.realpath(os.fsdecode(given[0]))
            flags = given[2] if event == "open" and isinstance(given[2], int) else 0
            if flags & os.O_TRUNC or not os.path.exists(path):
                self._made.add(path)
            elif not flags & os.O_WRONLY and path not in self._made:
                (self._kept if path in self._made_before else self._opened).setdefault(path, what)

    def _running_function(self) -> str:
        """Return which function of the bundle is running; "" if none is, or it is importing a module."""
        frame: FrameType | None = sys._getframe(2)
        while frame is not None and not frame.f_code.co_filename.startswith("<frozen importlib"):
            file, name = Path(frame.f_code.co_filename), frame.f_code.co_name
            if file.is_relative_to(self._folder):
                where = f"{file.relative_to(self._folder).as_posix()}, line {frame.f_lineno}"
                return f"{'The module' if name == '<module>' else f'{name}()'} ({where})"
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


def _texts_of(folder: Path) -> Iterator[tuple[str, str]]:
    """Give the strings in a bundle's module with the function that has each; not those that nothing reads."""
    module = folder / MODULE
    tree = ast.parse(module.read_bytes())
    functions: dict[ast.AST, str] = {}
    unread: set[ast.AST] = set()
    for node in ast.walk(tree):  # a function before the functions in it
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            functions |= dict.fromkeys(ast.walk(node), f"{node.name}()")
        elif isinstance(node, ast.Expr):  # a docstring is one
            unread.add(node.value)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in unread:
            yield node.value, f"{functions.get(node, 'The module')} ({module.name}, line {node.lineno})"


def _texts_in(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | tuple | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _texts_in(part)
