"""How is the worker of a service doing, and when is the next one started?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

PAUSE_S: Final = 0.1
_LONGEST_PAUSE_S: Final = 10.0
# After so many good events the next death is a first one again.
GOOD_EVENTS: Final = 5
# A worker that ends by itself sooner than this after it was ready, or before, so often in a row, is a fault.
_SOON_S: Final = 1.0
DEATHS_BEFORE_FAULT: Final = 5
# After that it is tried again this much later, and twice as late each time.
_FAULT_PAUSE_S: Final = 5.0
_LONGEST_FAULT_PAUSE_S: Final = 60.0
# One that was ready for so long and then dies is started again without a long wait.
_STEADY_S: Final = 10.0


@dataclass(slots=True)
class Health:
    """How the worker that is served is doing; read and written with the dispatcher's lock held.

    Attributes
    ----------
    fault
        Why no event is taken until there is a worker again; empty if that is not so.
    is_final
        Whether none will be started any more.
    trouble
        Why there is none just now.
    stuck
        What has not returned in time, until the worker that replaces it is ready.
    restarts
        How often a worker was started again.
    deaths
        How often in a row one died by itself, with no event, as soon as it was ready or before.
    pauses
        How often in a row it was waited before a start, which is what each wait is twice as long for.
    ready_s
        Since when there is one that is ready; None while there is none.
    """

    fault: str = ""
    is_final: bool = False
    trouble: str = ""
    stuck: str = ""
    restarts: int = 0
    deaths: int = 0
    pauses: int = 0
    was_ready: bool = False
    ready_s: float | None = None

    def count_death(self, now_s: float, *, has_cause: bool) -> None:
        """Note that a worker has ended; ``has_cause``: for an event's sake, which will not come again for ever."""
        was_ready_for_s = 0.0 if self.ready_s is None else now_s - self.ready_s
        self.ready_s = None
        self.deaths = 0 if has_cause or was_ready_for_s >= _SOON_S else self.deaths + 1
        if was_ready_for_s >= _STEADY_S:
            self.pauses = 0

    def next_pause_s(self) -> float:
        """Return how long to wait before the next start."""
        if self.deaths >= DEATHS_BEFORE_FAULT:
            return min(_FAULT_PAUSE_S * 2.0 ** min(self.deaths - DEATHS_BEFORE_FAULT, 10), _LONGEST_FAULT_PAUSE_S)
        self.pauses += 1
        return min(PAUSE_S * 2.0 ** min(self.pauses - 1, 10), _LONGEST_PAUSE_S)
