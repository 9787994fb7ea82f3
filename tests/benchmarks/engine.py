"""What does a graph cost above code written by hand?"""

from __future__ import annotations

from tests.benchmarks import build, edges, functions, orb, rerun, workers
from tests.benchmarks.row import Row
from tests.benchmarks.timing import Effort

_MODULES = (functions, rerun, build, edges, orb, workers)


def rows(effort: Effort) -> list[Row]:
    return [row for module in _MODULES for row in module.rows(effort)]
