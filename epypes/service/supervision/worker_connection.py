"""The front's connection to one worker process, and the process at its other end."""

from __future__ import annotations

import contextlib
import itertools
import json
import logging
import os
import queue
import re
import select
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep
from typing import TYPE_CHECKING, Any, Final, Literal

from epypes.errors import MessageError, ServiceError
from epypes.service.sd_notify import VARIABLES
from epypes.service.supervision.frame_socket import ControlSocket, FrameSocket, WorkerMessage, buffers_of
from epypes.service.supervision.packing import BytesLike
from epypes.service.supervision.standard_error import STANDARD_ERROR

if TYPE_CHECKING:
    from epypes.service.bundle_info import BundleInfo

_log = logging.getLogger("epypes.service")

_NO_CONTENT: Final[Mapping[str, Any]] = {}
WorkerStatus = Literal["loading", "ready", "refused", "gone"]

# How long a query may take.
_QUERY_TIMEOUT_S: Final = 2.0
# How long a worker may take to report whether a change that timed out was made.
_WITHDRAW_TIMEOUT_S: Final = 0.5
# How long a worker that seems to hang may take to report what it runs.
_HANG_REPORT_TIMEOUT_S: Final = 0.5

_LINES_KEPT: Final = 20
_READ_BYTES: Final = 64 * 1024
# How long a process may take to write the stacks of its threads, and how often the file is read meanwhile.
_TRACE_TIMEOUT_S: Final = 5.0
# The main thread is the last one in a trace of faulthandler, and `python -m` begins there.
_END_OF_TRACE: Final = " in _run_module_as_main\n"
_TRACE_PERIOD_S: Final = 0.01
_MAX_TRACE_BYTES: Final = 256 * 1024
# How long a process may take to end once its socket has.
_END_TIMEOUT_S: Final = 1.0
_FRAME: Final = re.compile(r'^  File "(?P<file>.*)", line \d+ in (?P<name>\S+)$')


class WorkerProcess:
    """The process that runs a bundle's code.

    The system ends it with the thread that made this object, so that thread must live as long as the service.

    Parameters
    ----------
    bundle
        The bundle's folder.
    threads
        How many events it works on at once.
    """

    def __init__(self, bundle: Path, threads: int) -> None:
        self.bundle = bundle
        self._last_traces = ""
        self._lines: deque[str] = deque(maxlen=_LINES_KEPT)
        # The system may be short of descriptors, memory or threads at any of these.
        with contextlib.ExitStack() as given, contextlib.ExitStack() as kept:
            self.socket, theirs = FrameSocket.pair()
            kept.callback(self.socket.close)
            given.callback(theirs.close)
            self.control, their_control = ControlSocket.pair()
            kept.callback(self.control.close)
            given.callback(their_control.close)
            self._traces = os.memfd_create("epypes-traces")
            kept.callback(os.close, self._traces)
            output, standard_error = os.pipe()
            kept.callback(os.close, output)
            given.callback(os.close, standard_error)
            command = [sys.executable, "-I", "-m", "epypes.service.worker"]
            sockets = [str(theirs.fileno()), str(their_control.fileno())]
            self.process = subprocess.Popen(  # noqa: S603 - this interpreter, our own module
                [*command, *sockets, str(bundle), "--threads", str(threads), "--faults", str(self._traces)],
                pass_fds=[theirs.fileno(), their_control.fileno(), self._traces],
                stdin=subprocess.DEVNULL,
                stdout=standard_error,
                stderr=standard_error,
                env={name: value for name, value in os.environ.items() if name not in VARIABLES},
            )
            self.pid = self.process.pid
            kept.callback(self.process.wait)
            kept.callback(self.kill)
            self._output = threading.Thread(
                target=_copy_output, args=(output, self._lines), name="epypes worker output", daemon=True
            )
            self._output.start()
            threading.Thread(target=self._end_with_process, name="epypes worker end", daemon=True).start()
            kept.pop_all()

    def _end_with_process(self) -> None:
        """End the socket when the process is gone: a child that C code has forked may hold the other end open."""
        process = os.pidfd_open(self.pid)
        try:
            gone = select.poll()
            gone.register(process, select.POLLIN)
            gone.poll()
        finally:
            os.close(process)
            # What the process has sent is still read.
            self.socket.end()

    def kill(self) -> None:
        """Kill it, also if it is stopped or hangs."""
        with contextlib.suppress(ProcessLookupError):
            self.process.kill()

    def wait(self, timeout_s: float) -> bool:
        """Return whether it has ended within ``timeout_s`` seconds."""
        try:
            self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def close(self) -> None:
        """Release its resources when its socket has ended; kill it if it does not end then."""
        if not self.wait(_END_TIMEOUT_S):
            self.kill()
        self.process.wait()
        if self._traces == -1:
            return
        self._last_traces = self._read_traces(0)
        self.socket.close()
        self.control.close()
        # Its last output may be on the way; a process that it has started may hold the pipe open for longer.
        self._output.join(0.2)
        # Once: later the number may be that of another file.
        traces, self._traces = self._traces, -1
        os.close(traces)

    @property
    def ending(self) -> str:
        """How it ended, with its last line of output; empty while it runs."""
        status = self.process.poll()
        if status is None:
            return ""
        how = f"was killed by {signal_name(-status)}" if status < 0 else f"ended with status {status}"
        last = next((line for line in reversed(self._lines) if line.strip()), "")
        return f"The worker {how}" + (f"; its last output: {last.strip()[:300]}" if last else "")

    def functions_by_trace(self) -> tuple[str, ...]:
        """Return the functions of the bundle's module that its threads are in, as faulthandler writes them.

        None of its threads needs to run Python code for that. A process that is stopped writes nothing.
        """
        try:
            begin = os.fstat(self._traces).st_size
            self.process.send_signal(signal.SIGUSR1)
            deadline = monotonic() + _TRACE_TIMEOUT_S
            while not self._read_traces(begin).endswith(_END_OF_TRACE):
                if monotonic() > deadline or self.is_stopped:
                    break
                sleep(_TRACE_PERIOD_S)
            return functions_in_trace(self._read_traces(begin), self.bundle)
        except OSError:
            return ()

    @property
    def died_in(self) -> tuple[str, ...]:
        """The functions of the bundle's module that it was in when it crashed, as far as faulthandler wrote them."""
        return functions_in_trace(self._last_traces, self.bundle)

    def _read_traces(self, begin: int) -> str:
        size = min(os.fstat(self._traces).st_size - begin, _MAX_TRACE_BYTES)
        return os.pread(self._traces, size, begin).decode(errors="replace")

    @property
    def is_stopped(self) -> bool:
        """Whether the process was stopped by SIGSTOP, or by a debugger."""
        try:
            status = Path(f"/proc/{self.pid}/stat").read_text(encoding="utf-8", errors="replace")
        except OSError:
            return False
        return status.rpartition(")")[2].split()[:1] in (["T"], ["t"])


def functions_in_trace(text: str, bundle: Path) -> tuple[str, ...]:
    """Return, for each thread of a trace of faulthandler, the outermost function of a bundle that it is in.

    Examples
    --------
    >>> trace = '''Thread 0x7f (most recent call first):
    ...   File "/b/modules/lanes.py", line 9 in helper
    ...   File "/b/pipeline.py", line 4 in match
    ...   File "/x/epypes/run/execute.py", line 30 in call
    ... '''
    >>> functions_in_trace(trace, Path("/b"))
    ('match',)
    """
    found: list[str] = []
    for block in text.split("most recent call first):\n"):
        frames = [frame for line in block.splitlines() if (frame := _FRAME.match(line))]
        names = [frame["name"] for frame in frames if Path(frame["file"]).is_relative_to(bundle)]
        found += names[-1:]
    return tuple(found)


def signal_name(number: int) -> str:
    """Return the name of a signal, ``SIGSEGV``, or its number where it has none."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _copy_output(output: int, lines: deque[str]) -> None:
    """Copy what a process prints to our own standard error, and keep the last lines."""
    rest = b""
    with contextlib.suppress(OSError):
        while data := os.read(output, _READ_BYTES):
            STANDARD_ERROR.write(data)
            *whole, rest = (rest + data).split(b"\n")
            lines.extend(line.decode(errors="replace") for line in whole[-_LINES_KEPT:])
            rest = rest[-_READ_BYTES:]
    if rest:
        lines.append(rest.decode(errors="replace"))
    os.close(output)


@dataclass(frozen=True, slots=True)
class HangReport:
    """What a worker runs that seems to hang.

    Attributes
    ----------
    functions
        By the number of the event, the function that runs; empty where that can't be known.
    elapsed_ns
        How long the worker has worked on an event. An event that is missing here waits in the worker: for a change of
        parameters, or for something else that the worker does.
    has_answered
        Whether the worker answered. Otherwise none of its threads runs Python code.
    """

    functions: Mapping[int, str]
    elapsed_ns: Mapping[int, int]
    has_answered: bool


class WorkerConnection:
    """A worker process, and the messages between it and the front.

    No method but `query`, `change_parameters` and `dismiss` waits: a thread sends what the kernel does not take at
    once, another one receives.

    Parameters
    ----------
    bundle
        The bundle that it runs.
    threads
        How many events it works on at once.
    on_message
        Called on the receiving thread with the connection and each message, but the answers to queries.
    on_end
        Called there at the end, when the process is gone.

    Attributes
    ----------
    status
        ``"loading"`` until the worker has proved the bundle or refused it.
    about
        The contents of its ``ready`` message: functions, report.
    reasons
        Why it refused the bundle.
    is_dismissed
        Whether the front itself ends it, so that its events did not cause its end.
    """

    def __init__(
        self,
        bundle: BundleInfo,
        threads: int,
        on_message: Callable[[WorkerConnection, WorkerMessage], None],
        on_end: Callable[[WorkerConnection], None],
    ) -> None:
        self.bundle = bundle
        self.status: WorkerStatus = "loading"
        self.about: Mapping[str, Any] = {}
        self.reasons: tuple[str, ...] = ()
        self.is_dismissed = False
        self._on_message, self._on_end = on_message, on_end
        self._posting = threading.Lock()
        # Buffers that the kernel has not taken, None at the end; while there are any, later messages queue behind them.
        self._unsent: queue.SimpleQueue[list[memoryview] | None] = queue.SimpleQueue()
        self._unsent_count = 0
        self._is_over = False
        self._numbers = itertools.count(1)
        self._answers: dict[int, queue.SimpleQueue[WorkerMessage | None]] = {}
        self.process = WorkerProcess(bundle.path, threads)
        try:
            for target, name in ((self._send, "to"), (self._receive, "from")):
                threading.Thread(target=target, name=f"epypes {name} worker", daemon=True).start()
        except BaseException:
            self._unsent.put(None)
            self.process.kill()
            self.process.close()
            raise

    @property
    def pid(self) -> int:
        """The process."""
        return self.process.pid

    # -- sending ------------------------------------------------------------------------------------------------------

    def post_event(self, seq: int, frames: Sequence[BytesLike], content: Mapping[str, Any] = _NO_CONTENT) -> None:
        """Give the worker an event; returns at once."""
        self._post(WorkerMessage("event", seq, content, frames))

    def post_parameters(self, revision: int, values: Mapping[str, Any], number: int | None = None) -> None:
        """Have it take values of hyperparameters as soon as it works on no event; a message reports whether it has."""
        number = next(self._numbers) if number is None else number
        # Not in the contents, which are bounded: a table may be large.
        self._post(WorkerMessage("parameters", number, {"revision": revision}, [json.dumps(values).encode()]))

    def _post(self, message: WorkerMessage) -> None:
        """Send a message after those before it; returns at once. To a worker that is gone nothing is sent."""
        try:
            left = buffers_of(message)
        except MessageError as error:
            # Only an event can be as large, and the subscriber has checked its size.
            _log.error("a message to the worker was not sent: %s", error)
            return
        with self._posting:
            if not self._unsent_count:
                try:
                    left = self.process.socket.send_buffers(left, is_waiting=False)
                except EOFError:
                    return
            if left:
                self._unsent_count += 1
                self._unsent.put(left)

    def _send(self) -> None:
        while (left := self._unsent.get()) is not None:
            try:
                self.process.socket.send_buffers(left)
            except EOFError:
                return
            except BaseException:
                # Memory may be short. What the worker has not got is given to the next one.
                _log.exception("the worker can't be sent messages, so it is ended")
                self.process.kill()
                return
            # An event may be large: its memory must not be held until another one comes.
            left.clear()
            with self._posting:
                self._unsent_count -= 1

    # -- requests -----------------------------------------------------------------------------------------------------

    def query(self, what: str, timeout_s: float = _QUERY_TIMEOUT_S, **more: Any) -> WorkerMessage:
        """Send a query to the worker, and wait for the answer.

        Values of a revision may be computed for it, by a slot; everything else is answered while functions run.

        Raises
        ------
        ServiceError
            It is gone, or does not answer in time.
        """
        with self._request() as (number, answers):
            message = WorkerMessage("query", number, {"what": what, **more})
            if "revision" in more:
                self._post(message)
            else:
                self.process.control.send(message)
            try:
                return self._answer(answers, timeout_s)
            except queue.Empty:
                text = f"The worker has not answered within {timeout_s:g} s: it is busy. Try again."
                raise ServiceError(self.bundle.path, text) from None

    def change_parameters(self, revision: int, values: Mapping[str, Any], timeout_s: float) -> dict[str, str]:
        """Have it take values of hyperparameters, by token as in pipeline.toml; return its problems by token.

        Raises
        ------
        ServiceError
            It is gone, or works on an event for longer than ``timeout_s``.
        """
        with self._request() as (number, answers):
            self.post_parameters(revision, values, number)
            try:
                answer = self._answer(answers, timeout_s)
            except queue.Empty:
                self.process.control.send(WorkerMessage("withdraw", number, {"revision": revision}))
                try:
                    answer = self._answer(answers, _WITHDRAW_TIMEOUT_S)
                except queue.Empty:
                    text = (
                        f"The worker does not answer; the outcome is unknown. If it goes on before it is replaced, the "
                        f"change may still be made, as revision {revision}: read the parameters then."
                    )
                    raise ServiceError(self.bundle.path, text) from None
        if answer.content["is_withdrawn"]:
            text = f"The worker works on an event for longer than {timeout_s:g} s, so nothing was changed. Try again."
            raise ServiceError(self.bundle.path, text)
        return dict(answer.content["problems"])

    @contextlib.contextmanager
    def _request(self) -> Iterator[tuple[int, queue.SimpleQueue[WorkerMessage | None]]]:
        """Yield the number of a new request, and the queue of its answers: None when the worker is gone."""
        number = next(self._numbers)
        answers = self._answers[number] = queue.SimpleQueue()
        try:
            if self._is_over:
                answers.put(None)
            yield number, answers
        finally:
            del self._answers[number]

    def _answer(self, answers: queue.SimpleQueue[WorkerMessage | None], timeout_s: float) -> WorkerMessage:
        answer = answers.get(timeout=timeout_s)
        if answer is None:
            raise ServiceError(self.bundle.path, "The worker is gone, and is started again. Try again in a moment.")
        return answer

    def hang_report(self, seqs: Sequence[int]) -> HangReport:
        """Return what the worker runs for some events: by its answer, or by faulthandler if it does not answer."""
        try:
            answer = self.query("running", _HANG_REPORT_TIMEOUT_S)
        except ServiceError:
            # A function holds the interpreter's lock, or the process is stopped.
            names = self.process.functions_by_trace()
            known = [name for name in names if name in self.about.get("functions", ())] or list(names)
            return HangReport(dict.fromkeys(seqs, ", ".join(dict.fromkeys(known))), {}, has_answered=False)
        slots: list[Mapping[str, Any]] = list(answer.content["slots"])
        functions = dict.fromkeys(seqs, "") | {slot["seq"]: ", ".join(slot["functions"]) for slot in slots}
        return HangReport(functions, {slot["seq"]: slot["ns"] for slot in slots}, has_answered=True)

    # -- receiving ----------------------------------------------------------------------------------------------------

    def _receive(self) -> None:
        try:
            while True:
                self._take(self.process.socket.receive())
        except EOFError:
            pass
        except BaseException:
            _log.exception("the worker's messages can't be understood, so it is ended")
        self._unsent.put(None)
        self.process.close()
        if self.status != "refused":
            self.status = "gone"
        self._is_over = True
        for answers in list(self._answers.values()):
            answers.put(None)
        self._on_end(self)

    def _take(self, message: WorkerMessage) -> None:
        if message.kind == "ready":
            self.about, self.status = message.content, "ready"
        elif message.kind == "refused":
            self.reasons, self.status = tuple(message.content["reasons"]), "refused"
        if message.kind != "answer":
            # A change of parameters is noted before anything that comes after it is read.
            self._on_message(self, message)
        if message.kind != "done" and (answers := self._answers.get(message.number)) is not None:
            answers.put(message)

    def dismiss(self, timeout_s: float) -> None:
        """Let it finish its events and end; kill it if it still loads, or if that takes longer than ``timeout_s``."""
        self.is_dismissed = True
        if self.status != "loading":
            self._post(WorkerMessage("end"))
            if self.process.wait(timeout_s):
                return
        self.process.kill()

    def kill(self) -> None:
        """End it at once, by the front: its events are not to blame."""
        self.is_dismissed = True
        self.process.kill()
