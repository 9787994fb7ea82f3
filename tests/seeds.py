"""What does a program print under different hash seeds?"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterable


def printed(code: str, seeds: Iterable[str] = ("0", "12345")) -> set[str]:
    """Run the program in a process for each seed of PYTHONHASHSEED; return the texts that are not the same."""
    return {
        subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in seeds
    }
