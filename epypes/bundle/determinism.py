"""What a bundle computes depends on its tokens alone: the conditions under which that is tried, and what is watched.

A replay under another condition shows what depends on it. A relative path is found by another working folder. For
absolute ones, an audit hook receives every file that Python opens. Libraries in C open files without it, so their names
are looked for in the text of the module and in the values of hyperparameters.
"""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import sysconfig
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any, Final, Self

_VARIABLE: Final = re.compile(r"[A-Z][A-Z0-9_]*")
_SYSTEM: Final = (
    *("/bin", "/boot", "/dev", "/etc", "/lib", "/lib32", "/lib64", "/proc", "/run", "/sbin", "/sys", "/usr"),
    *("/System", "/Library", "/var/cache", "/var/lib"),
)
_EVENTS: Final = frozenset({"open", "os.listdir", "os.scandir", "sqlite3.connect"})
_WAY_OUT: Final = (
    "The bundle is not alone with it. Pass its content in as a token, keep it in a variable of the notebook, or put "
    "it into the data of a package that is installed and read it with importlib.resources."
)


# -- conditions ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Condition:
    """One thing about the surroundings of a process.

    Attributes
    ----------
    name
        What a result depends on: "the hash seed (PYTHONHASHSEED)".
    way_out
        What to change in the function, as a sentence.
    environment
        The variables of the environment under the other condition; None for one that is not there.
    is_folder
        Whether it is the working folder.
    """

    name: str
    way_out: str
    environment: Mapping[str, str | None] = field(default_factory=dict)
    is_folder: bool = False


CALL: Final = Condition(
    "when, how often and in which order function {function!r} is called",
    "Pass a seed as a token and make the random generator of it, as in np.random.default_rng(seed), or call "
    "cv2.setRNGSeed(seed) inside the function. Pass a time, and what it remembers from call to call, as tokens. Round "
    "noise of threads away before it decides anything.",
)
PROCESS: Final = Condition(
    "the process that computes it",
    "It may use random numbers, the time, the process id or an address in memory. Pass it in as a token.",
)
UNKNOWN: Final = Condition(
    "what only the notebook has, or on several conditions at once",
    "If an array was written into after the run, run the graph again. A file, the current folder, or what a function "
    "remembers is to be a token.",
)


def other_conditions(module: Path) -> tuple[Condition, ...]:
    """Return the conditions that a second process has otherwise than this one and its children.

    Variables of the environment that a module names as texts are not there, or "1" if they are not here. The others
    are as they are here: libraries need them.
    """
    texts = (node.value for node in ast.walk(ast.parse(module.read_bytes())) if isinstance(node, ast.Constant))
    named = {text for text in texts if isinstance(text, str) and _VARIABLE.fullmatch(text)}
    threads = "1" if os.environ.get("OMP_NUM_THREADS", str(os.cpu_count())) != "1" else "3"
    return (
        Condition(
            "the variables of the environment",
            "Read them in the notebook, and make what is read a token.",
            {"EPYPES_PROOF": "1", **{name: None if name in os.environ else "1" for name in sorted(named)}},
        ),
        Condition(
            "the hash seed (PYTHONHASHSEED)",
            "The order of a set of strings is another one in each process: sort it, as in sorted(names).",
            {"PYTHONHASHSEED": "12345"},
        ),
        Condition(
            "the working folder",
            "Pass the folder in as a token, or use absolute paths of what is installed.",
            is_folder=True,
        ),
        Condition(
            "the time zone (TZ)",
            "Use UTC: datetime.now(UTC), time.gmtime().",
            {"TZ": "<+1337>-13:37"},
        ),
        Condition(
            "the locale (LC_ALL)",
            "Format and parse without locale.setlocale(), as f-strings and float() do.",
            {"LC_ALL": _another_locale()},
        ),
        Condition(
            "the number of threads (OMP_NUM_THREADS, cv2.setNumThreads)",
            "Compute it in one thread, or round the noise away before it decides anything.",
            # OpenCV reads the last one as what cv2.setNumThreads would set.
            dict.fromkeys(
                ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), threads
            ),
        ),
    )


def usual_environment() -> dict[str, str]:
    """Return the environment of a replay under usual conditions: this one, without what changes Python itself."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    return {**kept, "PYTHONHASHSEED": "0"}


@cache
def _another_locale() -> str:
    """Return an installed locale that writes numbers and dates otherwise than this one, as far as there is one."""
    try:
        done = subprocess.run(["locale", "-a"], capture_output=True, timeout=10, check=False)  # noqa: S607
        installed = done.stdout.decode(errors="replace").split()
    except (OSError, subprocess.TimeoutExpired):
        installed = []
    now = next((os.environ[name] for name in ("LC_ALL", "LC_CTYPE", "LANG") if os.environ.get(name)), "C")
    others = (name for name in installed if not name.startswith(("C", "POSIX", "en", now[:2])))
    return next(others, "C.UTF-8" if now in ("C", "POSIX") else "C")


def library_settings() -> dict[str, str]:
    """Return how libraries are set in this process, where that changes what functions compute."""
    found: dict[str, str] = {}
    numpy, cv2, decimal = (sys.modules.get(name) for name in ("numpy", "cv2", "decimal"))
    if numpy is not None:
        raising = {error: way for error, way in numpy.geterr().items() if way not in ("ignore", "warn", "print", "log")}
        found["numpy.seterr"] = f"{raising or 'no errors are raised'}"
    if cv2 is not None:
        found["cv2.setUseOptimized"] = f"{cv2.useOptimized()}"
    if decimal is not None:
        context = decimal.getcontext()
        found["decimal.getcontext"] = f"prec={context.prec}, rounding={context.rounding}"
    return found


# -- files -----------------------------------------------------------------------------------------------------------


class FileAccess:
    """Notes, while its block runs, which files outside of a bundle its functions open.

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
        # By path: what names it, and when it was written last.
        self._named: dict[str, tuple[str, int]] = {}

    def __enter__(self) -> Self:
        self._is_on = True
        sys.addaudithook(self._on_event)  # which can't be taken away again
        return self

    def __exit__(self, *exception: object) -> None:
        self._is_on = False

    def note_names(self, hyperparameters: Mapping[str, Any]) -> None:
        """Note the files that the text of the module and values of hyperparameters name by an absolute path."""
        named = [*_texts_of(self._folder)]
        for token, value in hyperparameters.items():
            named += [(text, f"Hyperparameter {token!r} (pipeline.toml)") for text in _texts_in(value)]
        for text, what in named:
            # A folder such as /tmp or /data is on every machine, or is part of a longer name.
            if os.path.isabs(text) and Path(text).parts[2:] and os.path.exists(text):
                self._named.setdefault(text, (what, os.stat(text).st_mtime_ns))

    @property
    def files(self) -> tuple[str, ...]:
        """Why the bundle is not alone: a sentence for each file that is not its own."""
        found = {path: f"{what} opens {path}." for path, what in self._opened.items() if path not in self._made}
        for text, (what, written_ns) in self._named.items():
            # A file that has changed meanwhile was written, not read.
            if os.path.exists(text) and os.stat(text).st_mtime_ns == written_ns:
                found.setdefault(os.path.realpath(text), f"{what} names {text}, which is there.")
        own = self._own_folders()
        return tuple(
            f"{reason} {_WAY_OUT}"
            for path, reason in found.items()
            if os.path.exists(path) and not own & {path, *map(str, Path(path).parents)}
        )

    def _own_folders(self) -> set[str]:
        """Return the folders whose files are there wherever the bundle's requirements are."""
        home = Path("~").expanduser()
        packages = (module for name, module in [*sys.modules.items()] if "." not in name)
        folders = [
            *(self._folder, os.getcwd(), sys.prefix, sys.base_prefix, sys.exec_prefix, *sysconfig.get_paths().values()),
            *(folder for module in packages for folder in getattr(module, "__path__", ())),
            *(os.environ.get("XDG_CACHE_HOME", home / ".cache"), os.environ.get("XDG_CONFIG_HOME", home / ".config")),
            *_SYSTEM,
        ]
        return {os.path.realpath(folder) for folder in folders} - {os.sep, os.path.realpath(home)}

    def _on_event(self, event: str, given: tuple[Any, ...]) -> None:
        if not self._is_on or event not in _EVENTS or not isinstance(given[0], str | bytes | os.PathLike):
            return
        if what := self._running_function():
            path = os.path.realpath(os.fsdecode(given[0]))
            flags = given[2] if event == "open" and isinstance(given[2], int) else 0
            if flags & os.O_CREAT or not os.path.exists(path):
                self._made.add(path)
            else:
                self._opened.setdefault(path, what)

    def _running_function(self) -> str:
        """Return which function of the bundle is running; "" if none is, or it is importing a module."""
        frame: FrameType | None = sys._getframe(2)
        while frame is not None and not frame.f_code.co_filename.startswith("<frozen importlib"):
            file, name = Path(frame.f_code.co_filename), frame.f_code.co_name
            if file.parent == self._folder:
                return f"{'The module' if name == '<module>' else f'{name}()'} ({file.name}, line {frame.f_lineno})"
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
    module = folder / "pipeline.py"
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
