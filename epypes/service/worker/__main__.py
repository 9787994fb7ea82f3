"""What does the process do that runs a bundle's functions, the only one of a service that does?

``python -I -m epypes.service.worker CHANNEL BUNDLE --threads N --faults FD`` is that process: CHANNEL is the number of
the socket to its front, FD that of a file which is told, on SIGUSR1 or when the process crashes, at which lines its
threads are. It ends with 0 when the front said so, with 1 when the bundle can't be served, with 2 when it was called
or spoken to in a way that it doesn't understand, with 3 when the front is gone.
"""

from __future__ import annotations

import argparse
import ctypes
import faulthandler
import io
import json
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, NoReturn

from epypes.bundle.load import Bundle, read_bundle
from epypes.bundle.replay import replay
from epypes.pipeline import Pipeline
from epypes.service.channel import Channel
from epypes.service.worker.asked import Asked, Latest
from epypes.service.worker.changes import Changes
from epypes.service.worker.inbox import Change, Event, Inbox
from epypes.service.worker.slots import Slot
from epypes.service.worker.traces import reason_of

ENDED: Final = 0
REFUSED: Final = 1
NOT_UNDERSTOOD: Final = 2
FRONT_GONE: Final = 3

_LOG: Final = logging.getLogger("epypes.service")
_PR_SET_PDEATHSIG: Final = 1
_STOP_TIMEOUT_S: Final = 5.0


class Worker:
    """A bundle behind a channel.

    Parameters
    ----------
    channel
        To the front.
    bundle
        What it runs.
    threads
        How many events it works on at once. OpenCV's own threads are left as they were during the replay: with
        several slots they compete for the same cores.
    """

    def __init__(self, channel: Channel, bundle: Bundle, threads: int) -> None:
        self._channel, self._bundle = channel, bundle
        self._inbox, self._latest = Inbox(), Latest()
        self._trial = trial = Pipeline(bundle.settings.name, bundle.cg, bundle.settings.hyperparameters)
        revision: Callable[[], int] = lambda: self._changes.revision  # noqa: E731
        self._slots = [Slot(bundle, self._inbox, channel, revision, self._latest.put) for _ in range(threads)]
        self._changes = Changes(trial, [slot.pipeline for slot in self._slots], bundle.enums)
        self._asked = Asked(channel, self._inbox, self._latest, trial, revision)
        self.ending = threading.Event()

    def start(self) -> None:
        """Begin to work."""
        self._asked.start()
        for slot in self._slots:
            slot.pipeline.listen()

    def stop(self) -> None:
        """Work off what has come, and end."""
        self._inbox.end()
        for slot in self._slots:
            # However long it takes: the front knows how long it will wait.
            while not slot.pipeline.loop.drain(_STOP_TIMEOUT_S):
                _LOG.info("waiting for %s", slot.under_way)
            slot.pipeline.stop()

    def hear(self, header: dict[str, Any], frames: list[memoryview]) -> None:
        """Take a message of the front's; returns at once.

        Raises
        ------
        KeyError
            There is no such kind of message, or it lacks something.
        """
        hearers = {
            "event": self._event,
            "parameters": self._parameters,
            "withdraw": self._withdraw,
            "ask": self._ask,
            "end": self._end,
        }
        hearers[header["kind"]](header, frames)

    def _event(self, header: dict[str, Any], frames: list[memoryview]) -> None:
        self._inbox.put(Event(header["seq"], bool(header["raw"]), frames))

    def _parameters(self, header: dict[str, Any], frames: list[memoryview]) -> None:
        revision, values = header["revision"], json.loads(bytes(frames[0]))
        make = self._try if header.get("is_trial") else self._apply
        self._inbox.put(Change(revision, lambda: make(revision, values)))

    def _withdraw(self, header: dict[str, Any], frames: list[memoryview]) -> None:
        # A change that is not there any more was made or refused, which is told.
        if self._inbox.withdraw(header["revision"]):
            self._channel.send({"kind": "parameters_withdrawn", "revision": header["revision"]})

    def _apply(self, revision: int, values: dict[str, Any]) -> None:
        problems = self._changes.apply(revision, values)
        answer: dict[str, Any] = {"kind": "parameters", "revision": revision}
        if problems:
            answer = {"kind": "parameters_refused", "revision": revision, "problems": problems}
        self._settle(answer)

    def _try(self, revision: int, values: dict[str, Any]) -> None:
        self._settle({"kind": "parameters_tried", "revision": revision, "problems": self._changes.refusals(values)})

    def _settle(self, answer: dict[str, Any]) -> None:
        try:
            self._channel.send(answer)
        except EOFError:
            return

    def _ask(self, header: dict[str, Any], frames: list[memoryview]) -> None:
        if header["what"] == "running":
            # At once: this is asked when something takes too long, which may be what others asked for.
            slots = [found for slot in self._slots if (found := slot.under_way)]
            running = [*(name for found in slots for name in found["functions"]), *self._trial.runner.running]
            self._channel.send({"kind": "asked", "ask": header["ask"], "running": running, "slots": slots})
        else:
            self._asked.put(header)

    def _end(self, header: dict[str, Any], frames: list[memoryview]) -> None:
        self.ending.set()


def main(arguments: Sequence[str]) -> int:
    """Serve a bundle to the front at the other end of a socket."""
    parser = argparse.ArgumentParser("epypes.service.worker")
    parser.add_argument("channel", type=int)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--faults", type=int)
    options = parser.parse_args(arguments)
    _stay_with_the_front(options.faults)
    os.set_inheritable(options.channel, False)
    channel = Channel(socket.socket(fileno=options.channel))
    channel.close_in_forks()
    hearer = _Hearer(channel)
    threading.Thread(target=hearer.hear_all, name="epypes channel", daemon=True).start()
    worker = _loaded(channel, options.bundle, options.threads)
    if worker is None:
        return REFUSED
    worker.start()
    hearer.hear_with(worker)
    worker.ending.wait()
    worker.stop()
    return ENDED


class _Hearer:
    """Reads the channel from the first moment on, so that the end of the front is noticed whatever else goes on."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._turn = threading.Lock()
        self._worker: Worker | None = None
        # What came before there was a worker.
        self._early: list[tuple[dict[str, Any], list[memoryview]]] = []

    def hear_with(self, worker: Worker) -> None:
        """Give what has come and what will come to a worker."""
        with self._turn:
            self._worker = worker
            for header, frames in self._early:
                _tell(worker, header, frames)
            self._early.clear()

    def hear_all(self) -> None:
        """Read until the other side is gone; the process ends then, whatever it is doing."""
        while True:
            try:
                header, frames = self._channel.receive()
            except EOFError:
                os._exit(FRONT_GONE)
            except BaseException as error:  # a thread that ended here would leave a worker that hears nothing
                _not_understood(error)
            self._hear(header, frames)
            # An event may be large: it shall not live on until another comes.
            del header, frames

    def _hear(self, header: dict[str, Any], frames: list[memoryview]) -> None:
        with self._turn:
            if self._worker is not None:
                _tell(self._worker, header, frames)
            elif header.get("kind") == "end":
                os._exit(ENDED)
            else:
                self._early.append((header, frames))


def _tell(worker: Worker, header: dict[str, Any], frames: list[memoryview]) -> None:
    try:
        worker.hear(header, frames)
    except EOFError:
        os._exit(FRONT_GONE)
    except BaseException as error:  # as above
        _not_understood(error)


def _not_understood(error: BaseException) -> NoReturn:
    _LOG.error("the front said what can't be understood: %r", error)
    os._exit(NOT_UNDERSTOOD)


def _stay_with_the_front(faults: int | None) -> None:
    """End with the front and not before it, and keep what functions print out of every stream but stderr."""
    # Ctrl+C in a terminal and a stop of the whole group are for the front, which says what becomes of its worker.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    os.dup2(2, 1)
    # What is printed shall not wait for a buffer to be full, and be lost when the process is killed.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True)
    if faults is not None:
        os.set_inheritable(faults, False)
        faulthandler.enable(file=faults)
        faulthandler.register(signal.SIGUSR1, file=faults, all_threads=True)


def _loaded(channel: Channel, path: Path, threads: int) -> Worker | None:
    """Return a worker whose bundle computes what was recorded, and say that it is ready; None if it was refused."""
    reasons: Sequence[str]
    doing = f"Reading {path}"
    try:
        bundle = read_bundle(path)
        doing = f"The replay of {path}"
        report = replay(bundle)
        reasons = [] if report.identical else [str(found) for found in report.differences] or [str(report)]
        doing = f"Making the pipelines of {path}"
        worker = Worker(channel, bundle, threads) if not reasons else None
    except MemoryError:
        # The bundle is none the worse for it: the front tries again later.
        raise
    except BaseException as error:  # a module may call sys.exit
        worker, reasons = None, [reason_of(error, doing, path.resolve())]
    if worker is None:
        channel.send({"kind": "refused", "reasons": list(reasons)})
        return None
    functions = list(bundle.cg.functions)
    ready = {
        "kind": "ready",
        "digest": bundle.digest,
        "report": str(report),
        "pid": os.getpid(),
        "functions": functions,
        "func_io": {name: [bundle.cg.func_inputs(name), bundle.cg.func_outputs(name)] for name in functions},
    }
    channel.send(ready)
    return worker


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
