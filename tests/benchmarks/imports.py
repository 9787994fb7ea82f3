"""What does ``import epypes`` cost above bare Python?"""

from __future__ import annotations

import subprocess
import sys

from tests.benchmarks.row import OURS, Goal, Row, row
from tests.benchmarks.timing import Effort


def _python(code: str) -> None:
    subprocess.run([sys.executable, "-I", "-c", code], check=True)


def rows(effort: Effort) -> list[Row]:
    contenders = {"bare Python": lambda: _python("pass"), OURS: lambda: _python("import epypes")}
    times = effort.measure(contenders, 20)
    return [row("bare Python, and with import epypes", times, goal=Goal("above", 60e6), limit="bare Python")]
