"""How is a running service called, once?"""

from __future__ import annotations

import queue
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, perf_counter_ns
from typing import TYPE_CHECKING, Any

from epypes.bundle.ports import REQUEST
from epypes.errors import RemoteFailure, ServiceError
from epypes.service.state import ServiceState, read_state
from epypes.transport import ZMQPublisher, ZMQSubscriber

if TYPE_CHECKING:
    from epypes.wire import Envelope

_LOOK_S = 0.2


@dataclass(frozen=True, slots=True)
class Answer:
    """What a service answered.

    Attributes
    ----------
    tokens
        The output tokens by name.
    timings_ns
        Nanoseconds by function.
    total_ns, overhead_ns
        The run's time in the service, and the graph's part of it.
    round_trip_ns
        From sending to receiving, on the caller's clock.
    """

    tokens: Mapping[str, Any]
    timings_ns: Mapping[str, int]
    total_ns: int
    overhead_ns: int
    round_trip_ns: int


def call(path: str | Path, payload: Mapping[str, Any], *, timeout_s: float = 10.0) -> Answer:
    """Send one event to the service of a bundle and wait for its answer.

    Parameters
    ----------
    path
        The bundle's folder.
    payload
        The input tokens by name.
    timeout_s
        How long to wait, in seconds.

    Raises
    ------
    ServiceError
        No service runs, it ended, or it did not answer in time.
    RemoteFailure
        A function failed on this event.
    """
    state = _running(path)
    deadline = monotonic() + timeout_s
    requests: queue.SimpleQueue[Any] = queue.SimpleQueue()
    answers: queue.SimpleQueue[Any] = queue.SimpleQueue()
    with (
        ZMQSubscriber(state.pub, answers) as subscriber,
        ZMQPublisher(state.sub, requests, bind=False) as publisher,
    ):
        joined = subscriber.wait_joined(deadline - monotonic())
        if not joined or not publisher.wait_for_subscriber(deadline - monotonic()):
            raise ServiceError(path, f"The service at {state.sub} can't be reached within {timeout_s:g} s.")
        return _exchange(path, payload, requests, answers, deadline, timeout_s)


def _running(path: str | Path) -> ServiceState:
    state = read_state(path)
    if state is None:
        raise ServiceError(path, f"No service runs for {path}. Start one: epypes serve {path}")
    for address in (state.sub, state.pub):
        if address.startswith("connect:"):
            text = f"The service of {path} connects to {address.removeprefix('connect:')}; send your events there."
            raise ServiceError(path, text)
    return state


def _exchange(
    path: str | Path, payload: Mapping[str, Any], requests: Any, answers: Any, deadline: float, timeout_s: float
) -> Answer:
    from epypes.wire import Envelope

    request = Envelope(type=REQUEST, parts=payload, source="epypes call")
    start_ns = perf_counter_ns()
    requests.put(request)
    while monotonic() < deadline:
        try:
            answer = answers.get(timeout=min(_LOOK_S, max(deadline - monotonic(), 0.001)))
        except queue.Empty:
            if read_state(path) is None:
                raise ServiceError(path, f"The service of {path} ended before it answered. Look at its log.") from None
            continue
        if isinstance(answer, Envelope) and answer.correlation_id == request.id:
            return _read(path, answer, perf_counter_ns() - start_ns)
    raise ServiceError(path, f"The service of {path} did not answer within {timeout_s:g} s.")


def _read(path: str | Path, answer: Envelope, round_trip_ns: int) -> Answer:
    if answer.failure is not None:
        failure = answer.failure
        raise RemoteFailure(path, failure.function, failure.exception, failure.message)
    return Answer(
        answer.parts,
        answer.timings,
        int(answer.attributes["total_ns"]),
        int(answer.attributes["overhead_ns"]),
        round_trip_ns,
    )
