"""Queries of completed runs: the graph, pictures of tokens, values; all of the last completed run of any slot.

A thread of its own answers, and makes each picture once per run, so that a page that asks often costs little. Only what
runs the user's functions again is done by a slot, so that no more of them run at once than there are slots.
"""

from __future__ import annotations

import json
import queue
import threading
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final
from weakref import ref

from epypes.errors import EpypesError, MessageError, NotComputed, UnknownName
from epypes.graph import colour_order
from epypes.run import CompGraphRunner, Run
from epypes.service.supervision.frame_socket import FrameSocket, WorkerMessage
from epypes.service.supervision.packing import BytesLike, pack
from epypes.wire import Envelope, encode
from epypes.wording import error_message

if TYPE_CHECKING:
    from epypes.display import Figure, Preview
    from epypes.service.worker.slots import SlotParameters

VALUES: Final = "epypes.values"
# More than any page asks for at once; beyond it, queries are refused.
_MOST_WAITING: Final = 64
# Pictures that are kept of one run.
_MOST_KEPT: Final = 64
_SIDES_PX: Final = (16, 2048)
_MOST_PICTURE_BYTES: Final = 8_000_000

# Contents of an answer, and its frames.
AnswerParts = tuple[dict[str, Any], Sequence[BytesLike]]


class QueryRefused(Exception):
    """A query can't be answered; ``reason`` is a short key."""

    def __init__(self, reason: str, text: str) -> None:
        self.reason, self.text = reason, text
        super().__init__(text)


@dataclass(frozen=True, slots=True, eq=False)
class CompletedRun:
    """A completed run, the id of its event, the revision of its parameters, and the state that it began with."""

    run: Run
    event_id: str
    revision: int
    state: Mapping[str, Any] | None = None


class QueryAnswerer:
    """Answers the queries of the front.

    Parameters
    ----------
    front
        Where answers go.
    parameters
        Of the slots, with a pipeline that runs a payload again without publishing anything.
    """

    def __init__(self, front: FrameSocket, parameters: SlotParameters) -> None:
        self._front, self._parameters = front, parameters
        self._completed: CompletedRun | None = None
        # The last completed run, and its payload run again with other parameters, until an event comes.
        self._again: tuple[CompletedRun, CompletedRun] | None = None
        self._queue: queue.SimpleQueue[WorkerMessage] = queue.SimpleQueue()
        self._made_of_run: tuple[Callable[[], Run | None], dict[Hashable, Any]] = lambda: None, {}

    def start(self) -> None:
        """Begin to answer."""
        threading.Thread(target=self._answer_all, name="epypes queries", daemon=True).start()

    def note(self, completed: CompletedRun) -> None:
        """Make the run of an event the last completed one."""
        self._completed, self._again = completed, None

    def put(self, query: WorkerMessage) -> None:
        """Take a query; returns at once."""
        if self._queue.qsize() >= _MOST_WAITING:
            text = "The worker has more queries than it can answer. Ask less often."
            self._send(query, lambda: _refuse("busy", text))
        else:
            self._queue.put(query)

    def _answer_all(self) -> None:
        while True:
            query = self._queue.get()
            self._send(query, lambda: self._answer(query.content))  # noqa: B023 - called before the next is taken

    def answer_by_rerun(self, query: WorkerMessage) -> None:
        """Answer a query of values with a revision, on a slot's thread: the last payload may be run again."""
        self._send(query, lambda: self._values_of_revision(query.content))

    def _send(self, query: WorkerMessage, made: Callable[[], AnswerParts]) -> None:
        """Send an answer, or why there is none."""
        content: dict[str, Any]
        frames: Sequence[BytesLike] = ()
        try:
            content, frames = made()
        except BaseException as error:  # previews and values are of the user's classes
            content = _refusal(error)
        try:
            self._front.send(WorkerMessage("answer", query.number, content, frames))
        except MessageError as error:
            self._front.send(WorkerMessage("answer", query.number, _refusal(error)))
        except EOFError:
            return

    # -- pictures -----------------------------------------------------------------------------------------------

    def _answer(self, query: Mapping[str, Any]) -> AnswerParts:
        completed = self._completed
        if query.get("what") == "run":
            return _values(completed, query)
        run = None if completed is None else completed.run
        if self._made_of_run[0]() is not run or run is None:
            # The run itself is large, so it is not kept for later queries.
            self._made_of_run = (lambda: None) if run is None else ref(run), {}
        key = query.get("what"), query.get("token"), query.get("max_side_px")
        content, frames = self._kept(key, lambda: self._made(query, run))
        return {**content, **_origin(completed)}, frames

    def _kept(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """Return what was made for this run before, or make it."""
        kept = self._made_of_run[1]
        if key not in kept:
            if len(kept) >= _MOST_KEPT:
                kept.clear()
            kept[key] = make()
        return kept[key]

    def _made(self, query: Mapping[str, Any], run: Run | None) -> AnswerParts:
        what, runner = query.get("what"), self._parameters.trial.runner
        if what == "preview":
            return _preview(run, runner, query)
        if what not in ("view", "svg"):
            raise QueryRefused("unknown query", f"A worker has no answer to {what!r:.40}.")
        figure = self._kept("figure", lambda: _figure(runner if run is None else run))
        if what == "svg":
            return {"media_type": "image/svg+xml"}, [figure.svg.encode()]
        return {"media_type": "application/json"}, [_json_of(figure)]

    # -- values -------------------------------------------------------------------------------------------------

    def _values_of_revision(self, query: Mapping[str, Any]) -> AnswerParts:
        """Return values of the last completed run; of its payload run again if that had earlier parameters."""
        completed, revision = self._completed, self._parameters.revision
        if completed is None or completed.revision >= query["revision"]:
            return _values(completed, query)
        if revision < query["revision"]:
            text = f"The parameters have revision {revision}, not {query['revision']} yet."
            raise QueryRefused("unknown revision", text)
        of, again = self._again or (None, None)
        if again is None or of is not completed or again.revision != revision:
            runner = self._parameters.trial.runner
            payload = {token: completed.run[token] for token in runner.free_source_tokens}
            # It begins with the state that the event began with: only the parameters differ.
            run = runner.trial({}, payload=payload, state=completed.state)
            if run.failure is not None:
                raise QueryRefused("failed", str(run.failure))
            again = CompletedRun(run, completed.event_id, revision, completed.state)
            self._again = completed, again
        return _values(again, query)


def _values(completed: CompletedRun | None, query: Mapping[str, Any]) -> AnswerParts:
    if completed is None:
        raise _nothing_yet()
    run, tokens = completed.run, query.get("tokens") or completed.run.cg.sink_tokens
    for token in tokens:
        run.cg.require_token(token)
    values = Envelope(
        type=VALUES,
        parts={token: run[token] for token in tokens},
        correlation_id=completed.event_id,
        revision=completed.revision,
        timings=run.report.durations_ns,
        rgb=[token for token in tokens if colour_order(run.cg, token) == "rgb"],
    )
    return _origin(completed), [pack(encode(values))]


def _figure(shown: Run | CompGraphRunner) -> Figure:
    from epypes.display import Figure, view

    # Without its run, which is large.
    return Figure(view(shown))


def _json_of(figure: Figure) -> bytes:
    from epypes.display.views.graphview import to_json

    return json.dumps(to_json(figure.view)).encode()


def _preview(run: Run | None, runner: CompGraphRunner, query: Mapping[str, Any]) -> AnswerParts:
    """Return a token as a picture, or as text."""
    from epypes.display import scene_of, scene_picture
    from epypes.display.previews.preview import preview

    token, side_px = query["token"], min(max(int(query["max_side_px"]), _SIDES_PX[0]), _SIDES_PX[1])
    runner.cg.require_token(token)
    if run is None:
        if token not in runner.hyperparameters:
            raise _nothing_yet()
        return _text(preview(runner.hyperparameters[token]))
    scene = scene_of(run, token)
    if scene is None:
        return _text(preview(run[token], colour_order(run.cg, token)))
    picture = scene_picture(scene, side_px, _MOST_PICTURE_BYTES)
    size = {"width": picture.width, "height": picture.height}
    return {"media_type": picture.media_type, **size}, [picture.data]


def _text(shown: Preview) -> AnswerParts:
    lines = [shown.text, *([shown.detail] if shown.detail != shown.text else []), *shown.rows]
    return {"media_type": "text/plain"}, ["\n".join(lines).encode()]


def _origin(completed: CompletedRun | None) -> dict[str, Any]:
    return {} if completed is None else {"event_id": completed.event_id, "revision": completed.revision}


def _nothing_yet() -> QueryRefused:
    return QueryRefused("not computed", "No event has been completed yet. Send one first.")


def _refuse(reason: str, text: str) -> AnswerParts:
    raise QueryRefused(reason, text)


def _refusal(error: BaseException) -> dict[str, Any]:
    """Return the contents in place of an answer."""
    if isinstance(error, QueryRefused):
        return {"error": error.text, "reason": error.reason}
    if isinstance(error, MessageError):
        return {"error": str(error), "reason": error.reason}
    reasons: tuple[tuple[type, str], ...] = ((UnknownName, "unknown token"), (NotComputed, "not computed"))
    reason = next((key for kind, key in reasons if isinstance(error, kind)), "failed")
    text = str(error) if isinstance(error, EpypesError) else f"{type(error).__name__}: {error_message(error):.500}"
    return {"error": text, "reason": reason}
