"""The health of the worker, and the pauses before it is started again: back-off of restarts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

RESTART_PAUSE_S: Final = 0.1
_LONGEST_PAUSE_S: Final = 10.0
# After this many answered events the restart pause begins at its shortest again.
_GOOD_EVENTS: Final = 5
# The service is FAULTED after DEATHS_BEFORE_FAULT workers in a row ended before they were ready, or within this time
# after. Then a worker is started after _FAULT_PAUSE_S, and twice as late each time.
_SOON_S: Final = 1.0
DEATHS_BEFORE_FAULT: Final = 5
_FAULT_PAUSE_S: Final = 5.0
_LONGEST_FAULT_PAUSE_S: Final = 60.0
# A worker that was ready for so long and then dies is started again without a long wait.
_STEADY_S: Final = 10.0


@dataclass(slots=True)
class WorkerHealth:
    """Facts about the worker; read and written with the dispatcher's lock held.

    Attributes
    ----------
    fault
        Why no event is taken until there is a worker again; empty otherwise.
    is_final
        Whether no worker will be started any more.
    trouble
        Why there is none just now.
    stuck
        Which function has not returned in time, until the worker that replaces it is ready.
    restarts
        How often a worker was started again.
    deaths
        How often in a row a worker died by itself, with no event, as soon as it was ready or before.
    pauses
        How often in a row there was a pause before a start; each pause is twice as long.
    was_ready
        Whether there has been a worker that was ready.
    ready_s
        Since when the worker is ready; None while there is none.
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

    def count_death(self, now_s: float, answered: int, *, has_cause: bool) -> None:
        """Note that a worker has ended.

        Parameters
        ----------
        answered
            How many events were answered since the last death.
        has_cause
            Whether an event caused the end: the worker died while it had one, or was killed because one hung. Such an
            event is retried a limited number of times.
        """
        was_ready_for_s = 0.0 if self.ready_s is None else now_s - self.ready_s
        self.ready_s = None
        if answered:
            self.deaths = 0
        self.deaths = 0 if has_cause or was_ready_for_s >= _SOON_S else self.deaths + 1
        if was_ready_for_s >= _STEADY_S or answered >= _GOOD_EVENTS:
            self.pauses = 0

    def next_pause_s(self) -> float:
        """Return how long to wait before the next start."""
        if self.deaths >= DEATHS_BEFORE_FAULT:
            return min(_FAULT_PAUSE_S * 2.0 ** min(self.deaths - DEATHS_BEFORE_FAULT, 10), _LONGEST_FAULT_PAUSE_S)
        self.pauses += 1
        return min(RESTART_PAUSE_S * 2.0 ** min(self.pauses - 1, 10), _LONGEST_PAUSE_S)
