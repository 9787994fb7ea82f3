"""Who asks, who answers, and where do they meet?"""

from __future__ import annotations

import json
import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from types import ModuleType
from typing import Protocol

import numpy as np

from tests.brokers.fleet import fleet

DEADLINE_S = 60.0
PREFETCH = 8
# Events of one asker that are on their way at a time; enough that no replica ever waits for one.
OUTSTANDING = 24
GROUP = "bench"


@dataclass(frozen=True)
class Meeting:
    """Where events are put, and where their answers: two names at one broker, or two addresses of ZeroMQ."""

    events: str
    answers: str
    port: int = 0
    user: str = ""
    password: str = ""


class Asker(Protocol):
    """Who sends events and takes their answers; used by one thread."""

    def ask(self, image: np.ndarray) -> np.ndarray:
        """Send one event and return its answer."""

    def ask_many(self, image: np.ndarray, count: int) -> None:
        """Send so many events, some of which are always on their way, and return when all are answered."""

    def close(self) -> None:
        """End its connections."""


@contextmanager
def replicas(module: ModuleType, meeting: Meeting, count: int) -> Iterator[None]:
    """Run processes that answer as a module does; they end, at the latest, when this one does."""
    command = ["-m", "tests.benchmarks.brokers.replica", module.__name__, json.dumps(asdict(meeting))]
    with fleet([command] * count):
        yield


def keep_busy(senders: Sequence[Callable[[], object]], receive: Callable[[], object], count: int) -> None:
    """Call the senders, each on a thread of its own, so often in all, and ``receive`` as often on this one."""
    room, left = threading.Semaphore(OUTSTANDING), queue.SimpleQueue[int]()
    for number in range(count):
        left.put(number)

    def send_on(send: Callable[[], object]) -> None:
        while room.acquire(timeout=DEADLINE_S):
            try:
                left.get_nowait()
            except queue.Empty:
                return
            send()

    threads = [threading.Thread(target=send_on, args=(send,), daemon=True) for send in senders]
    for thread in threads:
        thread.start()
    for _ in range(count):
        receive()
        room.release()
    room.release(len(threads))
    for thread in threads:
        thread.join(DEADLINE_S)
