"""The conditions of a replay: what the surroundings of a process may change, and nothing that a bundle computes.

A promotion replays under usual conditions and, at the same time, in a second process where all of them are others. If
that computes something else, one replay for each condition finds the one that changes it.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Final

_THREAD_VARIABLES: Final = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",  # what cv2.setNumThreads would set
)


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
        The variables of the environment under the other condition; "" for none.
    is_folder
        Whether it is the working folder.
    """

    name: str
    way_out: str
    environment: Mapping[str, str]
    is_folder: bool = False


CALL: Final = Condition(
    "how often and in which order it is called",
    "Make what it keeps from call to call a token; pass a seed as a token and make the generator of it.",
    {},
)
PROCESS: Final = Condition(
    "the process that computes it",
    "It may use random numbers, the time, the process id or an address in memory. Pass it in as a token.",
    {},
)


def other_conditions() -> tuple[Condition, ...]:
    """Return the conditions that a second process has otherwise than this one and its children."""
    count = "1" if _threads() != 1 else "3"
    return (
        Condition(
            "the hash seed (PYTHONHASHSEED)",
            "The order of a set of strings is another one in each process: sort it, as in sorted(names).",
            {"PYTHONHASHSEED": "12345"},
        ),
        Condition(
            "the working folder",
            "Pass the folder in as a token, or use absolute paths of what is installed.",
            {},
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
            dict.fromkeys(_THREAD_VARIABLES, count),
        ),
    )


def usual_environment() -> dict[str, str]:
    """Return the environment of a replay under usual conditions: this one, without what changes Python itself."""
    return {**without_python(), "PYTHONHASHSEED": "0"}


def without_python() -> dict[str, str]:
    """Return the environment without the variables that Python reads."""
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}


def _threads() -> int:
    given = next((os.environ[name] for name in _THREAD_VARIABLES if os.environ.get(name, "").isdigit()), "")
    return int(given) if given else os.cpu_count() or 1


@cache
def _another_locale() -> str:
    """Return an installed locale that writes numbers and dates otherwise than this one, as far as there is one."""
    try:
        done = subprocess.run(["locale", "-a"], capture_output=True, timeout=10, check=False)  # noqa: S607
        installed = done.stdout.decode(errors="replace").split()
    except (OSError, subprocess.TimeoutExpired):
        installed = []
    now = next((os.environ[name] for name in ("LC_ALL", "LC_CTYPE", "LANG") if os.environ.get(name)), "C")
    plain = "C.UTF-8" if now in ("C", "POSIX") else "C"
    others = (name for name in installed if not name.startswith(("C", "POSIX", "en", now[:2])))
    return next(others, plain)


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
