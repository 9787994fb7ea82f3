"""Running the paper's experiment: the robot, which announces requests and takes the times of their answers."""

from __future__ import annotations

import math
import queue
import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from epypes.acquisition.cameras import LAST_DEVICE
from epypes.errors import ExperimentError, MessageError
from epypes.experiment.layouts import LAYOUTS, TRANSPORTS, running
from epypes.experiment.nodes import REQUEST, T_VREQ, Settings, decode_keypoints
from epypes.experiment.results import Results, row_of, table_of
from epypes.wire import Envelope, Event, JustBytes, add_attribute, attributes, parsed

# Requests that come first and are not counted: they fill caches, and from its fourth run on a graph is compiled.
_WARM_UP: Final = 5
# After so many requests in a row without an answer, none is expected any more.
_MAX_MISSING: Final = 3


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """The outcome of one request.

    Attributes
    ----------
    id
        Of the request.
    t_trip
        From the request to its answer, in seconds, by the robot's clock; nan if there was none.
    attributes
        Of the answer: the time of the request, and the times of both components.
    keypoints
        The matched coordinates in it, float32, (at most 20, 4); None if there was no answer.
    failure
        What failed; empty if nothing did.
    is_missing
        Whether neither an answer nor a failure came within the time-out.
    """

    id: str
    t_trip: float = math.nan
    attributes: Mapping[str, Any] = field(default_factory=dict, repr=False)
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
        Whether contents that are a pickle are read; see `decode_keypoints`.

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
        """Announce a request, and return its outcome within the time-out.

        Parameters
        ----------
        at
            The time whose images are wanted: Unix time in seconds; default: now.

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
        """Return the outcome if the item is that of the request; else count the item."""
        if isinstance(item, ExperimentError):
            raise item
        if isinstance(item, Envelope):
            text = _describe_failure(item)
            if item.correlation_id == request_id:
                return Answer(request_id, failure=text)
            self.counts["late failure" if item.correlation_id else text] += 1
            return None
        try:
            message = parsed(JustBytes, item)
        except MessageError as error:
            self.counts[f"message that is no answer ({error.reason})"] += 1
            return None
        if message.id != request_id:
            self.counts["late answer"] += 1
            return None
        try:
            keypoints = decode_keypoints(message.contents, unsafe_pickle=self.unsafe_pickle)
            return Answer(request_id, t_trip, attributes(message), keypoints)
        except MessageError as error:
            return Answer(request_id, failure=f"robot: {error}")


def _describe_failure(event: Envelope) -> str:
    """Return the text of a failure event, on one line."""
    failure = event.failure
    if failure is None:
        return f"{event.source}: an event of type {event.type!r} came for an answer"
    return " ".join(f"{event.source}, {failure.function}: {failure.exception}: {failure.message}".split())


def run_experiment(
    layout: str = "paper",
    *,
    requests: int = 500,
    experiments: int = 5,
    workers: int = 1,
    fps: float = 5.0,
    unsafe_pickle: bool = False,
    progress: Callable[[int, int], None] | None = None,
    cameras: Sequence[str | Path | int] = (),
    timeout_s: float = 5.0,
    transport: str = "zeromq",
) -> Results:
    """Run the paper's experiment: a robot asks, acquisition finds the images, vision finds the keypoints.

    Parameters
    ----------
    layout
        How the nodes are spread: ``"paper"`` (the robot here, acquisition and vision in another process), ``"one"``
        (all of them here), ``"three"`` (a process each).
    requests
        How many requests are made in each experiment, one after another.
    experiments
        How often it is repeated; everything is started anew each time.
    workers
        How many functions of the graph may run at once.
    fps
        Frames per second of cameras that are files.
    unsafe_pickle
        Whether the contents of answers are pickled, as in 2019, and read. The sender of an answer could then run
        code here.
    progress
        Called with the requests made so far and those of all experiments, between two requests.
    cameras
        Two sources as `epypes.camera` takes them, each a path, an address or the number of a device; without, the
        stereo pair that comes with scikit-image.
    timeout_s
        Longest wait for one answer.
    transport
        What carries the messages: ``"zeromq"``, ``"dds"`` or ``"zenoh"``.

    Returns
    -------
    Results
        Its ``table`` has a row per request.

    Raises
    ------
    ExperimentError
        An option makes no sense, a process has ended, or there are no answers any more.

    Notes
    -----
    Semeniuta and Falkman 2019, "Evaluation" (Figures 12 to 16).
    """
    _check_choices({"layout": (layout, LAYOUTS), "transport": (transport, TRANSPORTS)})
    _check_numbers(
        {"requests": requests, "experiments": experiments, "workers": workers}, {"fps": fps, "timeout_s": timeout_s}
    )
    settings = Settings(_checked_cameras(cameras), fps, workers, unsafe_pickle)
    rows: list[dict[str, Any]] = []
    counts: Counter[str] = Counter()
    cpu_s = 0.0
    for experiment in range(experiments):
        with running(LAYOUTS[layout], settings, transport) as system:
            robot = Robot(system.requests, system.inbox, timeout_s=timeout_s, unsafe_pickle=settings.unsafe_pickle)
            missing = 0
            for request in range(-_WARM_UP, requests):
                if request == 0:
                    cpu_s -= system.cpu_s
                answer = robot.ask()
                missing = missing + 1 if answer.is_missing else 0
                if missing >= _MAX_MISSING:
                    text = f"None of {missing} requests in a row was answered within {timeout_s:g} s each."
                    raise ExperimentError("robot", text)
                if request < 0:
                    continue
                rows.append(row_of(answer, experiment, request))
                if progress is not None:
                    progress(len(rows), requests * experiments)
            cpu_s += system.cpu_s
        counts += robot.counts
    return Results(layout, table_of(rows), counts, transport, cpu_s)


def _check_choices(choices: Mapping[str, tuple[Any, Iterable[str]]]) -> None:
    for name, (value, known) in choices.items():
        if value not in list(known):
            raise ExperimentError(name, f"There is no {name} {value!r}. There are: {', '.join(known)}.")


def _check_numbers(counts: Mapping[str, Any], times: Mapping[str, Any]) -> None:
    for name, count in counts.items():
        if type(count) is not int or count < 1:
            raise ExperimentError(name, f"{name} must be a whole number from 1, not {count!r}.")
    for name, number in times.items():
        # No wait takes a longer time.
        if not isinstance(number, int | float) or not 0 < number <= threading.TIMEOUT_MAX:
            text = f"{name} must be a number above 0, and at most {threading.TIMEOUT_MAX:.0f}, not {number!r}."
            raise ExperimentError(name, text)


def _checked_cameras(cameras: Sequence[str | Path | int]) -> tuple[str | int, ...]:
    """Return the sources, paths as text."""
    given = [cameras] if isinstance(cameras, str | Path | int) else list(cameras)
    if len(given) not in (0, 2) or any(not isinstance(source, str | Path | int) for source in given):
        raise ExperimentError("cameras", f"cameras must be two, each a path or the number of a device, not {given!r}.")
    for source in given:
        if isinstance(source, int) and not 0 <= source <= LAST_DEVICE:
            raise ExperimentError("cameras", f"No camera has the number {source}. They go from 0 to {LAST_DEVICE}.")
    return tuple(source if isinstance(source, int) else str(source) for source in given)
