"""How does a worker run events, one at a time in each of its slots?

A slot is a FullPipeline of the bundle and the two queues at its ends. That the pipeline asks its q_in for the next
event tells that it has finished with the one before, whatever it did with that: answered it once, several times or
not at all, or failed.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from time import perf_counter_ns
from typing import Any, Final

from epypes.bundle.load import Bundle, pipeline_of
from epypes.errors import MessageError
from epypes.pipeline import FullPipeline
from epypes.pipeline.answering import Answering
from epypes.pipeline.reactive import SinkPipeline
from epypes.run import Failure, Run
from epypes.service.channel import Channel
from epypes.service.packing import BytesLike
from epypes.service.worker.inbox import Event, Inbox
from epypes.service.worker.traces import failure_told
from epypes.wire import Envelope, decode, encode, failure_event, serialized

_LOG: Final = logging.getLogger("epypes.service")


@dataclass(frozen=True, slots=True, eq=False)
class Completed:
    """A run that has completed: of which event, and with which revision of the parameters."""

    run: Run
    event_id: str
    revision: int


class Slot:
    """One pipeline of a worker, and the queues at its ends.

    Parameters
    ----------
    bundle
        Whose pipeline it is.
    inbox
        Where events come from.
    channel
        Where is told that they are done.
    revision
        Returns the revision of the parameters that a run begins with.
    on_completed
        Called on the slot's thread with each run that has completed; must return at once.
    """

    def __init__(
        self,
        bundle: Bundle,
        inbox: Inbox,
        channel: Channel,
        revision: Callable[[], int],
        on_completed: Callable[[Completed], object],
    ) -> None:
        self._inbox, self._channel, self._revision, self._on_completed = inbox, channel, revision, on_completed
        self._digest = bundle.digest
        self._work: _Work | None = None
        self._pid = os.getpid()
        self.pipeline: FullPipeline = pipeline_of(bundle, self, self, detach=False)
        self.pipeline.on_error = self._failed
        # What handle itself raises, where a subclass has one of its own.
        self.pipeline.loop.on_error = lambda event, error: self._failed(Failure("handle", (), {}, error, _id_of(event)))
        self._is_last_put = _puts_last(self.pipeline)

    @property
    def under_way(self) -> dict[str, Any] | None:
        """The event under way by its number, and what runs; None between events."""
        work = self._work
        if work is None:
            return None
        functions = self.pipeline.runner.running
        if not functions:
            stages = self.pipeline.stages
            around = (*stages.before, *stages.after)
            functions = tuple(stage.name for stage in around if stage.kind == "function" and stage.state == "running")
        return {"seq": work.seq, "functions": list(functions), "ns": perf_counter_ns() - work.start_ns}

    # -- as q_in ------------------------------------------------------------------------------------------------

    def get(self, block: bool = True, timeout: float | None = None) -> Any:
        """Tell that the event before is done, and wait for the next one, however long; no time-out wakes anybody up.

        Raises
        ------
        queue.Empty
            None will come; without ``block``: there is none now.
        """
        if os.getpid() != self._pid:
            # A function has forked, and its child has come back: it is not to go on as a worker.
            os._exit(0)
        self._finish()
        while True:
            item = self._inbox.take(block)
            if not isinstance(item, Event):
                item.run()
                self._inbox.finished()
                continue
            self._work = work = _Work(item.seq, self._revision(), self.pipeline.runner.last)
            try:
                event = bytes(item.frames[0]) if item.is_raw else decode(item.frames)
            except Exception as error:
                self._failed(Failure("f_in", self.pipeline.runner.free_source_tokens, {}, error))
                self._finish()
                continue
            work.event_id = _id_of(event)
            return event

    # -- as q_out -----------------------------------------------------------------------------------------------

    def put(self, item: Any, block: bool = True, timeout: float | None = None) -> None:
        """Take an answer to the event under way.

        Raises
        ------
        MessageError
            It can't be sent, which is a failure of the event; or no event is under way.
        """
        work = self._work
        if work is None:
            raise MessageError("no event", "An answer was put on q_out while no event was being worked on.")
        answer = _answer(item, work.revision)
        if not self._is_last_put:
            # What is put may be written to again before the event is done.
            answer = _Answer(answer.is_raw, [bytes(frame) for frame in answer.frames])
        work.answers.append(answer)

    # -- what becomes of an event -------------------------------------------------------------------------------

    def _failed(self, failure: Failure) -> None:
        work = self._work
        if work is None:
            _LOG.error("%s failed while no event was being worked on: %s", self.pipeline.name, failure)
        elif work.failure is None:
            work.failure = failure

    def _finish(self) -> None:
        """Tell that the event under way is done, if there is one."""
        work, self._work = self._work, None
        if work is None:
            return
        run = self.pipeline.runner.last
        if run is work.before:
            run = None
        if run is not None and run.failure is None:
            self._on_completed(Completed(run, work.event_id, work.revision))
        try:
            self._send(work, run)
        except MessageError as error:
            work.answers.clear()
            work.failure = Failure("f_out", self.pipeline.cg.sink_tokens, {}, error, work.event_id)
            self._send(work, run)
        except EOFError:
            _LOG.info("%s has nobody to answer any more", self.pipeline.name)
        self._inbox.finished()

    def _send(self, work: _Work, run: Run | None) -> None:
        answers = [*work.answers]
        if work.failure is not None:
            event = failure_event(work.failure, self.pipeline.name, self._digest)
            answers.append(_answer(event, work.revision))
        header = {
            "kind": "done",
            "seq": work.seq,
            "revision": work.revision,
            "failure": None if work.failure is None else failure_told(work.failure),
            "total_ns": perf_counter_ns() - work.start_ns,
            "durations_ns": {} if run is None else dict(run.report.durations_ns),
            "answers": [{"raw": answer.is_raw, "frames": len(answer.frames)} for answer in answers],
        }
        self._channel.send(header, [frame for answer in answers for frame in answer.frames])


class _Work:
    """What is known of the event under way."""

    __slots__ = ("answers", "before", "event_id", "failure", "revision", "seq", "start_ns")

    def __init__(self, seq: int, revision: int, before: Run | None) -> None:
        self.seq, self.revision, self.before = seq, revision, before
        self.event_id = ""
        self.answers: list[_Answer] = []
        self.failure: Failure | None = None
        self.start_ns = perf_counter_ns()


@dataclass(frozen=True, slots=True, eq=False)
class _Answer:
    is_raw: bool
    frames: list[BytesLike]


def _answer(item: Any, revision: int) -> _Answer:
    """Return the frames of what was put on q_out, as a publisher would take it.

    Raises
    ------
    MessageError
        It can't be sent.
    """
    if isinstance(item, Envelope):
        stamped = item if item.revision == revision else replace(item, revision=revision)
        return _Answer(False, [*encode(stamped)])
    if isinstance(item, bytes | bytearray | memoryview):
        return _Answer(True, [bytes(item)])
    if callable(getattr(item, "SerializeToString", None)):
        return _Answer(True, [serialized(item)])
    if isinstance(item, Failure):
        return _answer(failure_event(item), revision)
    kind = type(item).__name__
    text = (
        f"A service sends bytes, protobuf messages, Envelopes and Failures, not {kind}. Let f_out return one of these."
    )
    raise MessageError("no codec", text)


def _puts_last(pipeline: FullPipeline) -> bool:
    """Whether a pipeline has finished with an event when it has put its answer."""
    kind = type(pipeline)
    own: Mapping[str, Any] = {"handle": SinkPipeline.handle, "emit": Answering.emit, "put": Answering.put}
    return all(getattr(kind, name) is hook for name, hook in own.items())


def _id_of(event: Any) -> str:
    return event.id if isinstance(event, Envelope) else ""
