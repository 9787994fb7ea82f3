"""Slots of a worker: each runs one event at a time; and the parameters of all of them.

A slot is a FullPipeline of the bundle and the two queues at its ends. When the pipeline asks its q_in for the next
event, it has finished the one before, whatever it did with that: answered it once, several times or not at all, or
failed.
"""

from __future__ import annotations

import logging
import os
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from time import perf_counter_ns
from typing import Any, Final

import epypes
from epypes.bundle.arrays import StoredArray
from epypes.bundle.load import Bundle, pipeline_of
from epypes.bundle.settings import Member, decode_value
from epypes.errors import MessageError
from epypes.pipeline import FullPipeline, Pipeline
from epypes.run import Failure, Run
from epypes.service.supervision.frame_socket import FrameSocket, WorkerMessage
from epypes.service.supervision.packing import BytesLike, pack_state
from epypes.service.worker.inputs import Inputs
from epypes.service.worker.run_queries import CompletedRun, QueryAnswerer
from epypes.service.worker.states import State, WorkerStates
from epypes.wire import Envelope, decode, encode, failure_event, serialized
from epypes.wire.envelope import request_fields

_MAX_TRACE_FRAMES: Final = 20
_MAX_LINE: Final = 500
_MAX_MESSAGE: Final = 2_000
_UNKNOWN: Final = object()
_EPYPES_FOLDER: Final = str(Path(epypes.__file__).parent)

_log: Final = logging.getLogger("epypes.service")


class Slot:
    """One pipeline of a worker, and the queues at its ends.

    Parameters
    ----------
    bundle
        Whose pipeline it is.
    inputs
        Where events come from.
    front
        Where results go.
    parameters
        Whose revision a run begins with.
    answers
        Gets each run that has completed.
    states
        What the events before have left, if the bundle has state between events.
    """

    def __init__(
        self,
        bundle: Bundle,
        inputs: Inputs,
        front: FrameSocket,
        parameters: SlotParameters,
        answers: QueryAnswerer,
        states: WorkerStates,
    ) -> None:
        self._inputs, self._front, self._parameters, self._answers = inputs, front, parameters, answers
        self._digest = bundle.digest
        self._work: _Work | None = None
        self._pid = os.getpid()
        self.pipeline: FullPipeline = pipeline_of(bundle, self, self, detach=False)
        self.pipeline.on_error = self._failed
        # What a handle of a subclass raises.
        self.pipeline.loop.on_error = lambda event, error: self._failed(
            Failure("handle", (), {}, error, getattr(event, "id", ""))
        )
        self._is_last_put = _puts_last(self.pipeline)
        self._states = states if bundle.settings.states else None
        # What the pipeline has taken over from `_states` last; None for the initial state.
        self._state: object = None

    @property
    def running(self) -> dict[str, Any] | None:
        """The number of the event that is worked on, and the functions that run; None between events."""
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
        """Send the result of the event before, and wait for the next one; there is no time-out.

        Raises
        ------
        queue.Empty
            There will be none; without ``block``: there is none now.
        """
        if os.getpid() != self._pid:
            # A function has forked, and its child has returned: it must not go on as a worker.
            os._exit(0)
        self._finish()
        while True:
            message = self._inputs.take(block)
            if message.kind == "query":
                self._answers.answer_by_rerun(message)
                self._inputs.finished()
                continue
            before, revision = self.pipeline.runner.last, self._parameters.revision
            self._work = work = _Work(message.number, revision, before, stamp={"revision": revision})
            try:
                frames = message.frames
                if self._states is not None:
                    frames = self._take_state(self._states, message, work)
                event = bytes(frames[0]) if len(frames) == 1 else decode(frames)
            except Exception as error:
                self._failed(Failure("f_in", self.pipeline.runner.free_source_tokens, {}, error))
                self._finish()
                continue
            if isinstance(event, Envelope):
                work.event_id = event.id
                work.stamp |= request_fields(event)
            return event

    def _take_state(self, states: WorkerStates, message: WorkerMessage, work: _Work) -> Sequence[BytesLike]:
        """Have the pipeline go on with the state that an event begins with; return the frames of the event."""
        state, frames = states.begin(message)
        if state is not self._state:
            # It has worked on another series, or the event before has failed.
            if state is None:
                self.pipeline.reset()
            else:
                self.pipeline.state = state
            self._state = state
        work.message, work.state = message, state
        return frames

    # -- as q_out -----------------------------------------------------------------------------------------------

    def put(self, item: Any, block: bool = True, timeout: float | None = None) -> None:
        """Take an answer to the event that is worked on.

        Raises
        ------
        MessageError
            It can't be sent, which is a failure of the event; or no event is worked on.
        """
        work = self._work
        if work is None:
            raise MessageError("no event", "An answer was put on q_out while no event was being worked on.")
        answer = _answer(item, work.stamp)
        if not self._is_last_put:
            # What is put may be written to again before the event is done.
            answer = [*map(bytes, answer)]
        work.answers.append(answer)

    # -- results -------------------------------------------------------------------------------

    def _failed(self, failure: Failure) -> None:
        work = self._work
        if work is None:
            _log.error("%s failed while no event was being worked on: %s", self.pipeline.name, failure)
        elif work.failure is None:
            work.failure = failure

    def _finish(self) -> None:
        """Send the result of the event that is worked on, if there is one."""
        work, self._work = self._work, None
        if work is None:
            return
        run = self.pipeline.runner.last
        if run is work.before:
            run = None
        if run is not None and run.failure is None:
            self._answers.note(CompletedRun(run, work.event_id, work.revision, work.state))
        try:
            try:
                self._send(work, run)
            except MessageError as error:
                work.answers.clear()
                work.failure = Failure("f_out", self.pipeline.cg.sink_tokens, {}, error, work.event_id)
                self._send(work, run)
        except EOFError:
            _log.info("%s: the front is gone", self.pipeline.name)
        finally:
            self._inputs.finished()

    def _send(self, work: _Work, run: Run | None) -> None:
        answers = work.answers
        state = [] if self._states is None else self._leave_state(self._states, work)
        if work.failure is not None:
            event = failure_event(work.failure, self.pipeline.name, self._digest)
            answers = [*answers, _answer(event, work.stamp)]
        content = {
            "revision": work.revision,
            "failure": None if work.failure is None else _describe_failure(work.failure),
            "total_ns": perf_counter_ns() - work.start_ns,
            "durations_ns": {} if run is None else run.report.durations_ns,
            # How many frames belong to each: one of 2019, or those of an envelope.
            "answers": [*map(len, answers)],
        }
        if state:
            content["has_state"] = True
        self._front.send(WorkerMessage("done", work.seq, content, [*chain.from_iterable(answers), *state]))

    def _leave_state(self, states: WorkerStates, work: _Work) -> list[bytes]:
        """Keep what an event has left for the next one, and return it encoded; nothing if the event failed."""
        # The graph may have gone on before f_out failed: the pipeline takes the state over anew then.
        self._state = _UNKNOWN
        if work.failure is not None or work.message is None:
            return []
        state = self.pipeline.state
        try:
            block = pack_state(state)
        except MessageError as error:
            work.answers.clear()
            work.failure = Failure("state", tuple(state), {}, error, work.event_id)
            return []
        states.keep(work.message, state)
        self._state = state
        return [block]


@dataclass(slots=True, eq=False)
class _Work:
    """The event that is worked on, and its answers so far.

    Attributes
    ----------
    revision
        Of the parameters that it is computed with.
    before
        The last run before it.
    stamp
        Fields of every envelope that answers it.
    message, state
        Where the graph has state between events: the message that it came in, and what it begins with.
    """

    seq: int
    revision: int
    before: Run | None
    event_id: str = ""
    stamp: dict[str, Any] = field(default_factory=dict)
    answers: list[list[BytesLike]] = field(default_factory=list)
    failure: Failure | None = None
    start_ns: int = field(default_factory=perf_counter_ns)
    message: WorkerMessage | None = None
    state: State = None


def _answer(item: Any, stamp: Mapping[str, Any]) -> list[BytesLike]:
    """Return the frames of an item that was put on q_out.

    Raises
    ------
    MessageError
        It can't be sent.
    """
    if isinstance(item, Envelope):
        return [*encode(replace(item, **stamp))]
    if isinstance(item, bytes | bytearray | memoryview):
        return [bytes(item)]
    if callable(getattr(item, "SerializeToString", None)):
        return [serialized(item)]
    if isinstance(item, Failure):
        return _answer(failure_event(item), stamp)
    kind = type(item).__name__
    text = (
        f"A service sends bytes, protobuf messages, Envelopes and Failures, not {kind}. Let f_out return one of these."
    )
    raise MessageError("no codec", text)


def _puts_last(pipeline: FullPipeline) -> bool:
    """Whether a pipeline has finished with an event when it has put its answer."""
    kind = type(pipeline)
    own = ("handle", "emit", "put")
    return all(getattr(kind, name) is getattr(FullPipeline, name) for name in own)


def _describe_failure(failure: Failure) -> dict[str, Any]:
    """Return an event's failure as JSON."""
    return {
        "function": failure.function,
        "tokens": list(failure.tokens),
        "exception": failure.kind,
        "message": failure.message[:_MAX_MESSAGE],
        "trace": _trace_of(failure.exception),
        "kind": "raised",
    }


def _trace_of(exception: BaseException) -> list[str]:
    """Return the lines of a traceback, outermost call first, without frames of EPypes.

    The exception's own code may do anything when its text is read; the lines are bounded all the same.
    """
    try:
        frames = traceback.extract_tb(exception.__traceback__)
        users = [frame for frame in frames if not frame.filename.startswith((_EPYPES_FOLDER, "<epypes"))]
        lines = [_describe_frame(frame) for frame in users[-_MAX_TRACE_FRAMES:]]
        texts = traceback.format_exception_only(exception)
        return [line[:_MAX_LINE] for text in (*lines, *texts) for line in text.splitlines()[:_MAX_TRACE_FRAMES]]
    except BaseException:  # whatever the exception's own methods do
        return []


def _describe_frame(frame: traceback.FrameSummary) -> str:
    return f'File "{frame.filename}", line {frame.lineno}, in {frame.name}\n  {frame.line}'


# -- parameters -------------------------------------------------------------------------------------------------------


class SlotParameters:
    """The parameters of all slots: they change everywhere, or nowhere.

    Parameters
    ----------
    trial
        A pipeline of the same graph that answers no events: values are set on it first.
    enums
        The bundle's enumerations, whose members may be values.

    Attributes
    ----------
    trial
        The pipeline that answers no events.
    pipelines
        Of the slots.
    revision
        Of the last change; 0 with the bundle's own values.
    """

    def __init__(self, trial: Pipeline, enums: Mapping[str, Any]) -> None:
        self.trial, self._enums = trial, enums
        self.pipelines: Sequence[Pipeline] = ()
        self.revision = 0

    def apply(self, revision: int, entries: Mapping[str, Any]) -> dict[str, str]:
        """Set these values everywhere; return the reason by token for those that can't be set: then none is.

        Called while no slot works.

        Parameters
        ----------
        revision
            Counts the changes.
        entries
            Values by token, written as in pipeline.toml.
        """
        values, problems = _values(entries, self._enums)
        problems |= self._tried(values)
        if not problems:
            problems = self._set(values)
        if not problems:
            self.revision = revision
        return problems

    def _tried(self, values: Mapping[str, Any]) -> dict[str, str]:
        before, problems = self.trial.runner.hyperparameters, {}
        for token, value in values.items():
            try:
                self.trial.set(**{token: value})
            except BaseException as error:  # a value's own comparison may raise whatever it likes
                problems[token] = _text_of(error)
        if problems:
            self.trial.runner.set(**before)
        return problems

    def _set(self, values: Mapping[str, Any]) -> dict[str, str]:
        """Set values that the graph allows; a pipeline of the bundle's own may still refuse them."""
        before = [dict(pipeline.runner.hyperparameters) for pipeline in self.pipelines]
        try:
            for pipeline in self.pipelines:
                pipeline.set(**values)
        except BaseException as error:  # see above
            for pipeline, its_values in zip((self.trial, *self.pipelines), (before[0], *before), strict=True):
                pipeline.runner.set(**its_values)
            token = getattr(error, "token", None)
            return {name: _text_of(error) for name in values if token not in values or name == token}
        return {}


def _values(entries: Mapping[str, Any], enums: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    values, problems = {}, {}
    for token, entry in entries.items():
        try:
            values[token] = decode_value(entry, enums)
        except Exception as error:  # an entry of a kind may fail in the making of a value of that kind
            problems[token] = f"This value can't be read: {_text_of(error)}."
            continue
        if isinstance(values[token], StoredArray):
            problems[token] = "It is a file of the bundle. Promote it anew."
        if isinstance(values[token], Member):
            problems[token] = f"The bundle has no enumeration {values[token].enum!r}."
    return values, problems


def _text_of(error: BaseException) -> str:
    failure = Failure("", (), {}, error)
    return (failure.message or failure.kind)[:_MAX_MESSAGE]
