"""What does the robot do? It announces a request, waits for the answer, and takes the time."""

from __future__ import annotations

import queue
import time
import uuid
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Final

from epypes.errors import ExperimentError, MessageError
from epypes.experiment.messages import REQUEST, T_VREQ, keypoints_of
from epypes.wire import Envelope, Event, JustBytes, add_attribute, attributes, parsed

_NOTHING: Final[Mapping[str, Any]] = MappingProxyType({})


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """What came of one request.

    Attributes
    ----------
    id
        Of the request.
    t_trip
        From the request to its answer, in seconds, by the robot's clock; nan if there was none.
    attributes
        Of the answer: the time of the request, and the times of both components.
    contents
        The bytes of the answer.
    keypoints
        The matched coordinates in them, float32, (at most 20, 4); None if there was no answer.
    failure
        What failed; empty if nothing did.
    is_missing
        Whether nobody said anything within the time-out.
    """

    id: str
    t_trip: float = float("nan")
    attributes: Mapping[str, Any] = field(default_factory=lambda: _NOTHING, repr=False)
    contents: bytes = field(default=b"", repr=False)
    keypoints: Any = field(default=None, repr=False)
    failure: str = ""
    is_missing: bool = False


class Robot:
    """Announces requests one by one, and waits for the answer of each.

    Parameters
    ----------
    requests
        The queue that takes Events.
    inbox
        The queue that gives answers (bytes), failures (Envelopes) and errors that end the experiment.
    timeout_s
        Longest wait for one answer, in seconds.
    unsafe_pickle
        Whether contents that are a pickle are read; see `keypoints_of`.

    Attributes
    ----------
    counts
        What came besides the answers that were waited for: late ones of earlier requests, messages that are no
        answers, failures of no request. They are ignored, but counted.
    """

    def __init__(self, requests: Any, inbox: Any, *, timeout_s: float = 5.0, unsafe_pickle: bool = False) -> None:
        self.requests, self.inbox, self.timeout_s, self.unsafe_pickle = requests, inbox, timeout_s, unsafe_pickle
        self.counts: Counter[str] = Counter()

    def ask(self, at: float | None = None) -> Answer:
        """Announce a request, and return what comes of it within the time-out.

        Parameters
        ----------
        at
            The time whose images are wanted: Unix time in seconds; now, without.

        Raises
        ------
        ExperimentError
            A process has ended.
        """
        request_id = uuid.uuid4().hex
        start = time.perf_counter()
        event = Event(type=REQUEST, id=request_id)
        add_attribute(event, T_VREQ, time.time() if at is None else float(at))
        self.requests.put(event)
        deadline = start + self.timeout_s
        while True:
            try:
                item = self.inbox.get(timeout=max(0.0, deadline - time.perf_counter()))
            except queue.Empty:
                return Answer(request_id, failure=f"no answer within {self.timeout_s:g} s", is_missing=True)
            end = time.perf_counter()
            answer = self._read(item, request_id, end - start)
            if answer is not None:
                return answer

    def _read(self, item: Any, request_id: str, t_trip: float) -> Answer | None:
        """Return the answer if this is the one that is waited for."""
        if isinstance(item, ExperimentError):
            raise item
        try:
            if isinstance(item, Envelope):
                return self._failure(item, request_id)
            message = parsed(JustBytes, item)
            if message.id == request_id:
                return self._answer(message, t_trip)
            self.counts["late answer"] += 1
        except MessageError as error:
            self.counts[f"message that is no answer ({error.reason})"] += 1
        return None

    def _failure(self, event: Envelope, request_id: str) -> Answer | None:
        if event.correlation_id == request_id:
            return Answer(request_id, failure=failure_text(event))
        self.counts["late failure" if event.correlation_id else failure_text(event)] += 1
        return None

    def _answer(self, message: JustBytes, t_trip: float) -> Answer:
        try:
            keypoints = keypoints_of(message.contents, unsafe_pickle=self.unsafe_pickle)
        except MessageError as error:
            return Answer(message.id, failure=f"robot: {error}")
        return Answer(message.id, t_trip, attributes(message), message.contents, keypoints)


def failure_text(event: Envelope) -> str:
    """Return what a failure event says, on one line."""
    failure = event.failure
    if failure is None:
        return f"{event.source}: an event of type {event.type!r} came for an answer"
    text = f"{failure.function}: {failure.exception}: {failure.message}"
    return " ".join(f"{event.source}, {text}".split())
