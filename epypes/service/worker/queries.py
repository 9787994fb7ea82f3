"""Answers of a worker to queries: its graph, pictures of tokens, values; all of the last completed run of any slot.

A thread of its own answers, and makes each picture once per run, so that a page that asks often costs little.
"""

from __future__ import annotations

import json
import queue
import threading
from collections.abc import Callable, Hashable, Mapping, Sequence
from time import monotonic
from typing import TYPE_CHECKING, Any, Final
from weakref import ref

from epypes.errors import EpypesError, MessageError, NotComputed, UnknownName
from epypes.graph import colour_order
from epypes.pipeline import Pipeline
from epypes.run import CompGraphRunner, Run
from epypes.service.packing import BytesLike, pack
from epypes.service.worker.inputs import InputQueue, Job
from epypes.service.worker.slots import CompletedRun
from epypes.service.worker_connection import FrameSocket
from epypes.wire import Envelope, encode

if TYPE_CHECKING:
    from epypes.display import Figure, Preview

VALUES: Final = "epypes.values"
# More than any page asks for at once; beyond it, queries are refused.
_MOST_WAITING: Final = 64
# Pictures that are kept of one run.
_MOST_KEPT: Final = 64
_SIDES_PX: Final = (16, 2048)
_MOST_PICTURE_BYTES: Final = 8_000_000
# If an event came so lately, the next one may come in time: then nothing is run for the query.
_ALIVE_S: Final = 0.5
_MOMENT_S: Final = 0.1

# Contents of an answer, and its frames.
AnswerParts = tuple[dict[str, Any], Sequence[BytesLike]]


class QueryRefused(Exception):
    """A query can't be answered; ``reason`` is a short key."""

    def __init__(self, reason: str, text: str) -> None:
        self.reason, self.text = reason, text
        super().__init__(text)


class LatestRun:
    """The last completed run, and the threads that wait for another.

    Attributes
    ----------
    completed
        The run of an event; None as long as none has completed.
    again
        Its payload run again with other parameters, for a query; None if there was none.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._changed, self._waiting = threading.Condition(self._lock), 0
        self.completed: CompletedRun | None = None
        self.again: CompletedRun | None = None
        self._when_s = 0.0

    def put(self, completed: CompletedRun) -> None:
        """Make a run the last completed one."""
        with self._lock:
            self.completed, self.again, self._when_s = completed, None, monotonic()
            if self._waiting:
                self._changed.notify_all()

    def keep_again(self, again: CompletedRun, of: CompletedRun | None) -> None:
        """Keep a run of the last payload with other parameters until an event comes."""
        with self._lock:
            if self.completed is of:
                self.again = again

    def of_revision(self, revision: int) -> CompletedRun | None:
        """Return a run with this revision or a later one, if there is one or it comes within a moment."""
        moment_s = _MOMENT_S if monotonic() - self._when_s < _ALIVE_S else 0.0
        with self._lock:
            self._waiting += 1
            is_there = self._changed.wait_for(lambda: self._is_of(revision), moment_s)
            self._waiting -= 1
            return self.completed if is_there else None

    def _is_of(self, revision: int) -> bool:
        return self.completed is not None and self.completed.revision >= revision


class QueryAnswerer:
    """Answers the queries of the front.

    Parameters
    ----------
    front
        Where answers go.
    inputs
        Where work is put that runs the user's functions, so that no more of them run at once than there are slots.
    latest
        The last completed run.
    tried
        A pipeline with the parameters of the slots: it runs a payload again without publishing anything.
    revision
        Returns the revision of the parameters.
    """

    def __init__(
        self, front: FrameSocket, inputs: InputQueue, latest: LatestRun, tried: Pipeline, revision: Callable[[], int]
    ) -> None:
        self._front, self._inputs, self._latest = front, inputs, latest
        self._tried, self._revision = tried, revision
        self._queue: queue.SimpleQueue[Mapping[str, Any]] = queue.SimpleQueue()
        self._made_of_run: tuple[Callable[[], Run | None], dict[Hashable, Any]] = lambda: None, {}

    def start(self) -> None:
        """Begin to answer."""
        threading.Thread(target=self._answer_all, name="epypes queries", daemon=True).start()

    def put(self, ask: Mapping[str, Any]) -> None:
        """Take a query; returns at once."""
        if self._queue.qsize() >= _MOST_WAITING:
            self._send(ask, lambda: _refuse("busy", "The worker has more queries than it can answer. Ask less often."))
        else:
            self._queue.put(ask)

    def _answer_all(self) -> None:
        while True:
            ask = self._queue.get()
            if ask.get("what") == "run":
                self._answer_run(ask)
            else:
                self._send(ask, lambda: self._answer(ask))  # noqa: B023 - called before the next is taken
            del ask

    def _send(self, ask: Mapping[str, Any], made: Callable[[], AnswerParts]) -> None:
        """Send an answer, or why there is none."""
        header: dict[str, Any] = {"kind": "answer", "ask": ask.get("ask"), "what": ask.get("what")}
        frames: Sequence[BytesLike] = ()
        try:
            content, frames = made()
            header |= content
        except BaseException as error:  # previews and values are of the user's classes
            header |= _refusal(error)
        try:
            self._front.send(header, frames)
        except MessageError as error:
            self._front.send({**header, **_refusal(error)})
        except EOFError:
            return

    # -- of the last completed run ------------------------------------------------------------------------------

    def _answer(self, ask: Mapping[str, Any]) -> AnswerParts:
        what = ask.get("what")
        completed = self._latest.completed
        run = None if completed is None else completed.run
        if self._made_of_run[0]() is not run or run is None:
            # The run itself is large, so it is not kept for later queries.
            self._made_of_run = (lambda: None) if run is None else ref(run), {}
        key = what, ask.get("token"), ask.get("max_side_px")
        content, frames = self._kept(key, lambda: self._made(ask, run))
        return {**content, **_origin(completed)}, frames

    def _kept(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """Return what was made for this run before, or make it."""
        kept = self._made_of_run[1]
        if key not in kept:
            if len(kept) >= _MOST_KEPT:
                kept.clear()
            kept[key] = make()
        return kept[key]

    def _made(self, ask: Mapping[str, Any], run: Run | None) -> AnswerParts:
        what, runner = ask.get("what"), self._tried.runner
        if what == "preview":
            return _preview(run, runner, ask)
        if what not in ("view", "svg"):
            raise QueryRefused("unknown query", f"A worker has no answer to {what!r:.40}.")
        figure = self._kept("figure", lambda: _figure(runner if run is None else run))
        if what == "svg":
            return {"media_type": "image/svg+xml"}, [figure.svg.encode()]
        return {"media_type": "application/json"}, [_json_of(figure)]

    # -- values -------------------------------------------------------------------------------------------------

    def _answer_run(self, ask: Mapping[str, Any]) -> None:
        revision = ask.get("revision")
        completed = self._latest.completed if revision is None else self._latest.of_revision(revision)
        if completed is None and revision is not None and self._latest.completed is not None:
            self._inputs.put(Job(lambda: self._send(ask, lambda: self._run_again(ask))))
        else:
            self._send(ask, lambda: self._values(completed, ask))

    def _run_again(self, ask: Mapping[str, Any]) -> AnswerParts:
        """Run the last payload with the parameters of now, on a slot's thread."""
        completed, revision = self._latest.completed, self._revision()
        if completed is not None and completed.revision >= ask["revision"]:
            return self._values(completed, ask)
        if revision < ask["revision"]:
            raise QueryRefused(
                "unknown revision", f"The parameters have revision {revision}, not {ask['revision']} yet."
            )
        again = self._latest.again
        if again is None or again.revision != revision:
            again = self._ran_again(completed, revision)
            self._latest.keep_again(again, completed)
        return self._values(again, ask)

    def _ran_again(self, completed: CompletedRun | None, revision: int) -> CompletedRun:
        if completed is None:
            raise _nothing_yet()
        runner = self._tried.runner
        payload = {token: completed.run[token] for token in runner.free_source_tokens}
        run = runner.trial({}, payload=payload)
        if run.failure is not None:
            raise QueryRefused("failed", str(run.failure))
        return CompletedRun(run, completed.event_id, revision)

    def _values(self, completed: CompletedRun | None, ask: Mapping[str, Any]) -> AnswerParts:
        if completed is None:
            raise _nothing_yet()
        run, tokens = completed.run, ask.get("tokens") or completed.run.cg.sink_tokens
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
    from epypes.display import show

    return show(shown)


def _json_of(figure: Figure) -> bytes:
    from epypes.display.views.jsonview import to_json

    return json.dumps(to_json(figure.view)).encode()


def _preview(run: Run | None, runner: CompGraphRunner, ask: Mapping[str, Any]) -> AnswerParts:
    """Return a token as a picture, or as text."""
    from epypes.display import scene_of, scene_picture
    from epypes.display.previews.preview import preview

    token, side_px = ask["token"], min(max(int(ask["max_side_px"]), _SIDES_PX[0]), _SIDES_PX[1])
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
    text = str(error) if isinstance(error, EpypesError) else f"{type(error).__name__}: {error!s:.500}"
    return {"error": text, "reason": reason}
