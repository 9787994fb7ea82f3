"""Times of ``import epypes`` and of ``--help``, above bare Python."""

from __future__ import annotations

import subprocess
import sys

from tests.benchmarks.row import OURS, Goal, Row, row
from tests.benchmarks.timing import Effort

_BARE = "bare Python"
# The group, the command with the most options, and the one of the room with the most libraries.
_HELP = ("", "serve", "experiment")


def _python(*arguments: str) -> None:
    subprocess.run([sys.executable, "-I", *arguments], check=True, stdout=subprocess.DEVNULL)


def rows(effort: Effort) -> list[Row]:
    """Return a row for the import, and one for each help."""
    contenders = {_BARE: lambda: _python("-c", "pass"), OURS: lambda: _python("-c", "import epypes")}
    times = effort.measure(contenders, 20)
    found = [row("bare Python, and with import epypes", times, goal=Goal("above", 60e6), limit=_BARE)]
    for command in _HELP:
        arguments = ["-m", "epypes", *command.split(), "--help"]
        contenders[OURS] = lambda arguments=arguments: _python(*arguments)
        times = effort.measure(contenders, 20)
        name = " ".join(["bare Python, and epypes", *arguments[2:]])
        found.append(row(name, times, goal=Goal("above", 250e6), limit=_BARE))
    return found
