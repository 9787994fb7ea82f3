"""The inputs of a worker's slots: events and queries, and changes of parameters between them.

A free slot reads the next message itself; the others wait for their turn to read. So a message that comes after a
change of parameters is read when the change is made, and a change is made when no slot works.
"""

from __future__ import annotations

import json
import logging
import os
import queue
import threading
from collections.abc import Callable, Mapping
from time import sleep
from typing import Any, Final, NoReturn

from epypes.errors import MessageError
from epypes.service.supervision.frame_socket import FrameSocket, WorkerMessage

NOT_UNDERSTOOD: Final = 2
FRONT_GONE: Final = 3
# As in EventLoop, whose threads poll once everything has ended.
_ENDED_POLL_S: Final = 0.05

_log: Final = logging.getLogger("epypes.service")


class Inputs:
    """What the front gives to the slots.

    Parameters
    ----------
    front
        The socket to the front.
    apply
        Sets parameters: called with their revision and their values, while no slot works; returns problems by token.

    Attributes
    ----------
    has_ended
        Set when the front has sent that nothing more comes.
    """

    def __init__(self, front: FrameSocket, apply: Callable[[int, Mapping[str, Any]], Mapping[str, str]]) -> None:
        self._front, self._apply = front, apply
        self.has_ended = threading.Event()
        self._reading, self._lock = threading.Lock(), threading.Lock()
        self._changed = threading.Condition(self._lock)
        self._working = 0
        # Numbers of changes: the last that was made, refused or skipped, and those that are not to be made.
        self._settled, self._withdrawn = 0, set[int]()

    def take(self, block: bool = True) -> WorkerMessage:
        """Wait for an event, or a query that runs functions; the slot works on it until `finished` is called.

        The process ends if the front is gone, or can't be understood.

        Raises
        ------
        queue.Empty
            There will be none; without ``block``: there is none now.
        """
        if not self._reading.acquire(block):
            raise queue.Empty
        try:
            while not self.has_ended.is_set():
                if not block and not self._front.is_readable():
                    raise queue.Empty
                message = self._front.receive()
                if message.kind in ("event", "query"):
                    with self._lock:
                        self._working += 1
                    return message
                self._settle(message)
        except queue.Empty:
            raise
        except EOFError:
            os._exit(FRONT_GONE)
        except BaseException as error:  # without its slots the worker would be deaf
            not_understood(error)
        finally:
            self._reading.release()
        sleep(_ENDED_POLL_S)
        raise queue.Empty

    def finished(self) -> None:
        """Note that a slot is free again."""
        with self._lock:
            self._working -= 1
            self._changed.notify()

    def _settle(self, message: WorkerMessage) -> None:
        if message.kind == "parameters":
            self._change(message)
        elif message.kind == "end":
            self.has_ended.set()
        else:
            raise MessageError("unknown kind", f"The front has sent a message of kind {message.kind!r}.")

    def _change(self, message: WorkerMessage) -> None:
        """Set parameters when no slot works, unless the change is withdrawn; later messages are read afterwards."""
        revision, number = message.content["revision"], message.number
        with self._lock:
            self._changed.wait_for(lambda: not self._working or number in self._withdrawn)
            self._settled = number
            if number in self._withdrawn:
                self._withdrawn.remove(number)
                return
            problems = self._apply(revision, json.loads(bytes(message.frames[0])))
            answer = {"revision": revision, "problems": problems, "is_withdrawn": False}
            self._front.send(WorkerMessage("parameters", number, answer))

    def withdraw(self, message: WorkerMessage) -> None:
        """Have a change not made, and send that; one that was made or refused was answered already."""
        with self._lock:
            if message.number > self._settled:
                self._withdrawn.add(message.number)
                self._changed.notify()
                answer = {"revision": message.content["revision"], "problems": {}, "is_withdrawn": True}
                self._front.send(WorkerMessage("parameters", message.number, answer))


def not_understood(error: BaseException) -> NoReturn:
    """End the process: after a message that can't be understood, the stream can't be understood either."""
    _log.error("a message of the front can't be understood: %r", error)
    os._exit(NOT_UNDERSTOOD)
