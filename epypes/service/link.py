"""What passes between the front and one worker?

Nothing here blocks who sends: a thread of the link's own writes to the channel, another one reads from it.
"""

from __future__ import annotations

import itertools
import json
import logging
import queue
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Literal

from epypes.errors import MessageError, ServiceError
from epypes.service.packing import BytesLike
from epypes.service.served import Served
from epypes.service.workerprocess import WorkerProcess

_log = logging.getLogger("epypes.service")

Status = Literal["loading", "ready", "refused", "gone"]
Message = tuple[dict[str, Any], list[memoryview]]
ASK_S: Final = 2.0
# How a worker settles a change of parameters.
SETTLING: Final = ("parameters", "parameters_refused", "parameters_tried", "parameters_withdrawn")
# How long a worker may take to say whether a change that nobody waits for any more was made.
_WITHDRAW_S: Final = 0.5


class Link:
    """A worker process, and what is said to it and by it.

    Parameters
    ----------
    served
        The bundle that it runs.
    threads
        How many events it works on at once.
    hear
        Called on the link's reading thread with the link and each message that is no answer to an `ask`.
    gone
        Called there at the end, when the process is gone.

    Attributes
    ----------
    status
        ``"loading"`` until the worker has proved the bundle or refused it.
    about
        What it said when it was ready: functions, report.
    reasons
        Why it refused.
    is_dismissed
        Whether it is ended by the front itself, so that its events have no part in its end.
    """

    def __init__(
        self, served: Served, threads: int, hear: Callable[[Link, Message], None], gone: Callable[[Link], None]
    ) -> None:
        self.served = served
        self.status: Status = "loading"
        self.about: Mapping[str, Any] = {}
        self.reasons: tuple[str, ...] = ()
        self.is_dismissed = False
        self._hear, self._gone = hear, gone
        self._outbox: queue.SimpleQueue[tuple[Mapping[str, Any], Sequence[BytesLike]] | None] = queue.SimpleQueue()
        self._is_over = False
        self._numbers = itertools.count(1)
        self._asked: dict[tuple[str, int], queue.SimpleQueue[Message | None]] = {}
        self.process = WorkerProcess(served.path, threads)
        try:
            for target, name in ((self._send, "to"), (self._read, "from")):
                threading.Thread(target=target, name=f"epypes {name} worker", daemon=True).start()
        except BaseException:
            self._outbox.put(None)
            self.process.kill()
            self.process.close()
            raise

    @property
    def pid(self) -> int:
        """The process."""
        return self.process.pid

    def post(self, header: Mapping[str, Any], frames: Sequence[BytesLike] = ()) -> None:
        """Send a message after those before it; returns at once. To a worker that is gone nothing is sent."""
        self._outbox.put((header, frames))

    def ask(self, what: str, timeout_s: float = ASK_S, **more: Any) -> Message:
        """Ask the worker something, and wait for what it answers.

        Raises
        ------
        ServiceError
            It is gone, or does not answer in time.
        """
        number = next(self._numbers)
        header = {"kind": "ask", "ask": number, "what": what, **more}

        def late(key: tuple[str, int], answers: queue.SimpleQueue[Message | None]) -> Message | None:
            text = f"The worker has not answered within {timeout_s:g} s: it is busy. Try again."
            raise ServiceError(self.served.path, text)

        return self._exchange(("asked", number), lambda: self.post(header), timeout_s, late)

    def change(
        self, revision: int, values: Mapping[str, Any], timeout_s: float, *, is_trial: bool = False
    ) -> dict[str, str]:
        """Have it take values of hyperparameters, by token as in pipeline.toml; return its problems, if it has any.

        With ``is_trial`` it only says whether it would take them.

        Raises
        ------
        ServiceError
            It is gone, or works on an event for longer than ``timeout_s``.
        """
        key = ("parameters", revision)

        def send() -> None:
            self.tell_parameters(revision, values, is_trial=is_trial)

        answer, _ = self._exchange(key, send, timeout_s, self._withdraw)
        if answer["kind"] == "parameters_withdrawn":
            text = f"The worker works on an event for longer than {timeout_s:g} s, so nothing was changed. Try again."
            raise ServiceError(self.served.path, text)
        return dict(answer.get("problems") or {})

    def tell_parameters(self, revision: int, values: Mapping[str, Any], *, is_trial: bool = False) -> None:
        """Have it take values of hyperparameters as soon as it works on no event; it says whether it has."""
        # Not in the header, which is bounded: a table may be large.
        header = {"kind": "parameters", "revision": revision, "is_trial": is_trial}
        self.post(header, [json.dumps(values).encode()])

    def _withdraw(self, key: tuple[str, int], answers: queue.SimpleQueue[Message | None]) -> Message | None:
        """Have it forget a change that it has not made yet; return what has become of that.

        Raises
        ------
        ServiceError
            It does not say.
        """
        self.post({"kind": "withdraw", "revision": key[1]})
        try:
            return answers.get(timeout=_WITHDRAW_S)
        except queue.Empty:
            text = (
                f"The worker does not answer. If it goes on before it is replaced, the change may be made yet, as "
                f"revision {key[1]}: look at the parameters then."
            )
            raise ServiceError(self.served.path, text) from None

    def _exchange(
        self,
        key: tuple[str, int],
        send: Callable[[], object],
        timeout_s: float,
        late: Callable[[tuple[str, int], queue.SimpleQueue[Message | None]], Message | None],
    ) -> Message:
        answers = self._asked[key] = queue.SimpleQueue[Message | None]()
        try:
            answer = None
            if not self._is_over:
                send()
                answer = answers.get(timeout=timeout_s)
        except queue.Empty:
            answer = late(key, answers)
        finally:
            del self._asked[key]
        if answer is None:
            raise ServiceError(self.served.path, "The worker is gone, and is started again. Try again in a moment.")
        return answer

    def _send(self) -> None:
        while (message := self._outbox.get()) is not None:
            try:
                self.process.channel.send(*message)
            except EOFError:
                return
            except MessageError as error:
                # Only an event can be as large, and the subscriber has looked at it.
                _log.error("a message to the worker was not sent: %s", error)
            except BaseException:
                # Memory may be short. What the worker has not got is given to the next one.
                _log.exception("the worker can't be sent messages, so it is ended")
                self.process.kill()
                return
            # An event may be large: it shall not live on until another comes.
            del message

    def _read(self) -> None:
        try:
            while True:
                self._take(self.process.channel.receive())
        except EOFError:
            pass
        except BaseException:
            _log.exception("the worker's messages can't be understood, so it is ended")
        self._outbox.put(None)
        self.process.close()
        if self.status != "refused":
            self.status = "gone"
        self._is_over = True
        for answers in list(self._asked.values()):
            answers.put(None)
        self._gone(self)

    def _take(self, message: Message) -> None:
        header = message[0]
        kind = header.get("kind")
        if kind == "asked" or kind in SETTLING:
            number = header.get("ask") if kind == "asked" else header.get("revision")
            answers = self._asked.get(("asked" if kind == "asked" else "parameters", number or 0))
            # What was settled is noted before anything that comes after it is read.
            if kind != "asked":
                self._hear(self, message)
            if answers is not None:
                answers.put(message)
            return
        if kind == "ready":
            self.about, self.status = header, "ready"
        elif kind == "refused":
            self.reasons, self.status = tuple(map(str, header.get("reasons") or ["It gave no reason."])), "refused"
        self._hear(self, message)

    def dismiss(self, timeout_s: float) -> None:
        """Let it finish what it has and end; kill it if that takes longer than ``timeout_s``."""
        self.is_dismissed = True
        self.post({"kind": "end"})
        if not self.process.wait(timeout_s):
            self.process.kill()
