"""What has a service shown with which hyperparameters?

A service can't be run on other values on the side: what it has shown with them is all there is to compare with.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from typing import Any, Final

from epypes.run import Run

_MOST_RUNS: Final = 32
_MOST_BYTES: Final = 128 * 1024**2


class SeenRuns:
    """The last run with each of the values that were seen last; the first of all is kept."""

    def __init__(self) -> None:
        self._runs: OrderedDict[str, tuple[Run, int]] = OrderedDict()
        self._first = ""

    def add(self, run: Run) -> None:
        """Keep a run; what was seen long ago is dropped."""
        key = _key(run.hyperparameters)
        self._first = self._first or key
        before = self._runs.pop(key, None)
        # The first picture is what "default" means: the runs after it are those of other frames.
        kept = before if before is not None and key == self._first and _holds(before[0], run) else None
        self._runs[key] = kept or (run, _bytes(run))
        while len(self._runs) > _MOST_RUNS or sum(size for _, size in self._runs.values()) > _MOST_BYTES:
            oldest = next((key for key in self._runs if key not in (self._first, _key(run.hyperparameters))), None)
            if oldest is None:
                break
            del self._runs[oldest]

    def find(self, values: Mapping[str, Any]) -> Run | None:
        """Return the run with these values; None if none was seen."""
        found = self._runs.get(_key(values))
        return None if found is None else found[0]


def _key(values: Mapping[str, Any]) -> str:
    return repr(sorted(values.items()))


def _holds(run: Run, other: Run) -> bool:
    return set(other) <= set(run)


def _bytes(run: Run) -> int:
    return sum(int(getattr(value, "nbytes", 0)) for value in run.record[0])
