"""Finding the running service of a bundle, and calling it: one event, one answer."""

from __future__ import annotations

import queue
import threading
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, perf_counter_ns
from typing import TYPE_CHECKING, Any, Self

from epypes.bundle.adapters import REQUEST, in_order
from epypes.bundle.manifest import SETTINGS
from epypes.bundle.settings import read_settings
from epypes.errors import RemoteFailure, ServiceError
from epypes.service.state_file import ServiceState, read_states
from epypes.transport import Publisher, Subscriber
from epypes.transport.address import parse_address

if TYPE_CHECKING:
    from epypes.transport import Keys
    from epypes.transport.address import Address
    from epypes.transport.zeromq.curve import PublicKey
    from epypes.wire import Envelope

# How often a call looks, while it waits for an answer, whether the service still runs.
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
        The run's time in the service, and the graph's part of it; None if an f_out of the bundle's own leaves them out.
    round_trip_ns
        From sending to receiving, on the caller's clock.
    revision
        Of the hyperparameters that it was computed with: how often they were changed.
    bundle_digest
        Of the bundle that the service serves.
    """

    tokens: Mapping[str, Any]
    timings_ns: Mapping[str, int]
    total_ns: int | None
    overhead_ns: int | None
    round_trip_ns: int
    revision: int
    bundle_digest: str


class Client:
    """A connection to the service of a bundle; use it in a ``with`` statement. Threads that share one take turns.

    Parameters
    ----------
    path
        The bundle's folder.
    timeout_s
        How long connecting, and each call, may take, in seconds.
    keys
        The caller's own pair of CURVE keys, or the path of its .key_secret file, where the service has keys.
    allow
        With keys: the service's public key, or its .key file.
    sub, pub
        The addresses that the service was given: for a service that no state file names, as one on another machine or
        one in C++; or where a broker needs a password, which the state file leaves out.

    Raises
    ------
    ServiceError
        No service runs, or it can't be reached.
    KeysError
        If keys can't be read, or the service's is not given.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        timeout_s: float = 10.0,
        keys: Keys | str | Path | None = None,
        allow: PublicKey | Collection[PublicKey] | None = None,
        sub: str = "",
        pub: str = "",
    ) -> None:
        self.path, self.timeout_s = path, timeout_s
        self._has_keys = keys is not None
        self._turn = threading.Lock()
        # Otherwise nothing on this machine says whether it still runs.
        self._has_state = not (sub and pub)
        if self._has_state:
            try:
                state = _running(path)
            except ServiceError as error:
                if not (sub or pub):
                    raise
                missing = "pub" if sub else "sub"
                text = f"{missing} (--{missing}) is missing: give both addresses of a service that has no state here."
                raise ServiceError(path, f"{error} {text}") from None
            sub, pub = sub or state.sub, pub or state.pub
        self._sub, self._pub = parse_address(sub), parse_address(pub)
        _check_answerable(path, self._sub)
        _check_answerable(path, self._pub)
        self._rgb = read_settings(Path(path) / SETTINGS).rgb
        self._requests: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._subscriber = _subscriber_to(path, pub, self._answers, keys=keys, allow=allow)
        self._publisher = Publisher(sub, self._requests, bind=False, keys=keys, allow=allow)

    def __enter__(self) -> Self:
        deadline = monotonic() + self.timeout_s
        try:
            self._subscriber.start()
            self._publisher.start()
            is_heard = self._subscriber.wait_joined(self.timeout_s)
            if not (is_heard and self._publisher.wait_for_subscriber(max(deadline - monotonic(), 0.0))):
                text = f"The service of {self.path} can't be reached within {self.timeout_s:g} s."
                raise ServiceError(self.path, f"{text} {self._why_unreachable(is_heard)}")
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *exception: object) -> None:
        self._publisher.stop()
        self._subscriber.stop()

    def _why_unreachable(self, is_heard: bool) -> str:
        is_sent = self._publisher.wait_for_subscriber(0.0)
        sides = (is_heard, "publishes", self._pub), (is_sent, "subscribes", self._sub)
        missing = [(verb, address) for is_there, verb, address in sides if not is_there]
        if any(address.is_zeromq for _, address in missing):
            return why_unreachable(self._has_keys)
        texts = [
            f"There is no connection to the broker of {address}."
            if address.is_broker
            else f"Nothing {verb} to {address}."
            for verb, address in missing
        ]
        return " ".join([*texts, "The addresses must be those that epypes serve was given."])

    def _lost(self) -> int:
        return sum(self._subscriber.lost.values())

    def call(self, payload: Mapping[str, Any]) -> Answer:
        """Send one event and wait for its answer.

        Parameters
        ----------
        payload
            The input tokens by name, images in the order of their token's colours.

        Raises
        ------
        ServiceError
            The service ended, or did not answer in time.
        RemoteFailure
            A function failed on this event.
        """
        from epypes.wire import Envelope

        request = Envelope(type=REQUEST, parts=payload, source="epypes call", rgb=self._rgb)
        with self._turn:
            return self._exchange(request)

    def _exchange(self, request: Envelope) -> Answer:
        from epypes.wire import Envelope

        deadline = monotonic() + self.timeout_s
        refused, lost = self._publisher.rejected, self._lost()
        start_ns = perf_counter_ns()
        self._requests.put(request)
        while (left_s := deadline - monotonic()) > 0:
            try:
                answer = self._answers.get(timeout=min(_LOOK_S, left_s))
            except queue.Empty:
                self._check_alive(refused)
                continue
            if isinstance(answer, Envelope) and answer.correlation_id == request.id:
                return _read(self.path, answer, perf_counter_ns() - start_ns, self._rgb)
        text = f"The service of {self.path} did not answer within {self.timeout_s:g} s."
        lost = self._lost() - lost
        raise ServiceError(self.path, f"{text} {lost} answers were lost on the way meanwhile." if lost else text)

    def _check_alive(self, refused_before: Counter[str]) -> None:
        refused = self._publisher.rejected - refused_before
        if refused:
            raise ServiceError(self.path, f"The event could not be sent: {', '.join(refused)}.")
        if self._has_state and not read_states(self.path):
            raise ServiceError(self.path, f"The service of {self.path} ended before it answered. Look at its log.")


def call(
    path: str | Path,
    payload: Mapping[str, Any],
    *,
    timeout_s: float = 10.0,
    keys: Keys | str | Path | None = None,
    allow: PublicKey | Collection[PublicKey] | None = None,
) -> Answer:
    """Send one event to the service of a bundle and wait for its answer; see Client."""
    with Client(path, timeout_s=timeout_s, keys=keys, allow=allow) as client:
        return client.call(payload)


def why_unreachable(has_keys: bool) -> str:
    """Return what may keep a peer from a service that runs: a key that it does not know is refused in silence."""
    if has_keys:
        return (
            "It may have been started without this side's .key file under --allow, or without --keys; "
            "or --allow here may not be its .key file."
        )
    return "If it was started with --keys, give --keys and --allow here too: epypes keys makes them."


def _running(path: str | Path) -> ServiceState:
    state = next(iter(read_states(path)), None)
    if state is None:
        raise ServiceError(path, f"No service runs for {path}. Start one: epypes serve {path}")
    for address in (state.sub, state.pub):
        # The address of a broker has no such prefix: service and callers connect to it alike.
        if address.startswith("connect:"):
            text = f"The service of {path} connects to {address.removeprefix('connect:')}; send your events there."
            raise ServiceError(path, text)
    return state


def _check_answerable(path: str | Path, address: Address) -> None:
    """Raise ServiceError for an address whose messages do not say which event an answer is to."""
    if "type" in address.options:
        text = (
            f"The service of {path} has messages of ROS 2 at {address}. They do not say which event an answer is to: "
            "send the event with ep.Publisher, and read the answers with ep.Subscriber."
        )
        raise ServiceError(path, text)


def _subscriber_to(path: str | Path, address: str, answers: Any, **secured: Any) -> Subscriber:
    """Return the subscriber to the answers of a service; ServiceError where it would take them from other readers."""
    place = parse_address(address)
    if place.is_broker and place.kind == "queue":
        text = (
            f"The answers of the service of {path} go to the queue {place}, where each is for one reader: a call would "
            "take answers from it. Send the event with ep.Publisher, and read the answers where you read the others; "
            "or serve it with --pub ...?kind=broadcast, which every reader hears."
        )
        raise ServiceError(path, text)
    return Subscriber(place, answers, acknowledge="received", **secured)


def _read(path: str | Path, answer: Envelope, round_trip_ns: int, rgb: Collection[str]) -> Answer:
    if answer.failure is not None:
        failure = answer.failure
        raise RemoteFailure(path, failure.function, failure.exception, failure.message)
    return Answer(
        in_order(answer, rgb),
        dict(answer.timings),
        answer.attributes.get("total_ns"),
        answer.attributes.get("overhead_ns"),
        round_trip_ns,
        answer.revision,
        answer.bundle_digest,
    )
