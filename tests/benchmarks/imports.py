"""What does ``import epypes`` cost above bare Python?"""

from __future__ import annotations

import subprocess
import sys

from tests.benchmarks.timing import Row, interleaved


def _python(code: str) -> None:
    subprocess.run([sys.executable, "-I", "-c", code], check=True)


def rows() -> list[Row]:
    bare, ours = interleaved(lambda: _python("pass"), lambda: _python("import epypes"), 15)
    return [Row("bare Python, and with import epypes", bare, ours, "60 ms more at most")]
