"""The worker process: the only process of a service that runs the bundle's functions.

``python -I -m epypes.service.worker SOCKET BUNDLE --threads N --faults FD``: SOCKET is the descriptor of the socket to
the front, FD that of a file for the stacks of all threads, written on SIGUSR1 or when the process crashes. It ends with
0 when the front ends it, with 1 when the bundle can't be served, with 2 when it gets arguments or messages that it
does not understand, with 3 when the front is gone.
"""

from __future__ import annotations

import argparse
import contextlib
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
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NoReturn

from epypes.bundle.load import Bundle, read_bundle
from epypes.bundle.replay import replay
from epypes.errors import EpypesError
from epypes.pipeline import Pipeline
from epypes.run import Failure
from epypes.service.worker.inputs import InputQueue, ParameterChange, WorkerEvent
from epypes.service.worker.queries import LatestRun, QueryAnswerer
from epypes.service.worker.slots import Slot, SlotParameters
from epypes.service.worker_connection import FrameSocket

ENDED: Final = 0
REFUSED: Final = 1
NOT_UNDERSTOOD: Final = 2
FRONT_GONE: Final = 3

_log: Final = logging.getLogger("epypes.service")
_PR_SET_PDEATHSIG: Final = 1
_STOP_TIMEOUT_S: Final = 5.0
_MAX_REASON: Final = 2_000


class Worker:
    """A bundle behind a socket.

    Parameters
    ----------
    front
        The socket to the front.
    bundle
        What it runs.
    threads
        How many events it works on at once. OpenCV's own threads are left as they were during the replay: with
        several slots they compete for the same cores.
    """

    def __init__(self, front: FrameSocket, bundle: Bundle, threads: int) -> None:
        self._front = front
        self._inputs, latest = InputQueue(), LatestRun()
        self._trial = trial = Pipeline(bundle.settings.name, bundle.cg, bundle.settings.hyperparameters)
        self._parameters = parameters = SlotParameters(trial, bundle.enums)
        self._slots = [Slot(bundle, self._inputs, front, parameters, latest.put) for _ in range(threads)]
        parameters.pipelines = [slot.pipeline for slot in self._slots]
        self._queries = QueryAnswerer(front, self._inputs, latest, trial, lambda: parameters.revision)
        self.ending = threading.Event()

    def start(self) -> None:
        """Begin to work."""
        self._queries.start()
        for slot in self._slots:
            slot.pipeline.listen()

    def stop(self) -> None:
        """Work on what has come, and end."""
        self._inputs.end()
        for slot in self._slots:
            # However long it takes: the front has a time-out.
            while not slot.pipeline.loop.drain(_STOP_TIMEOUT_S):
                _log.info("waiting for %s", slot.running)
            slot.pipeline.stop()

    def receive(self, header: dict[str, Any], frames: list[memoryview]) -> None:
        """Take a message of the front; returns at once.

        Raises
        ------
        KeyError, ValueError
            There is no such kind of message, or it lacks something.
        """
        kind = header["kind"]
        if kind == "event":
            self._inputs.put(WorkerEvent(header["seq"], frames))
        elif kind == "parameters":
            revision, values = header["revision"], json.loads(bytes(frames[0]))
            self._inputs.put(ParameterChange(revision, lambda: self._apply(revision, values)))
        elif kind == "withdraw":
            # A change that is not there any more was made or refused, and that was sent.
            if self._inputs.withdraw(header["revision"]):
                self._front.send({"kind": "parameters_withdrawn", "revision": header["revision"]})
        elif kind == "end":
            self.ending.set()
        elif kind != "ask":
            raise ValueError(f"The front has sent a message of kind {kind!r:.40}.")
        elif header["what"] == "running":
            # At once: the front asks when something takes too long, which may be another query.
            slots = [found for slot in self._slots if (found := slot.running)]
            running = [*(name for found in slots for name in found["functions"]), *self._trial.runner.running]
            self._front.send({"kind": "answer", "ask": header["ask"], "running": running, "slots": slots})
        else:
            self._queries.put(header)

    def _apply(self, revision: int, values: dict[str, Any]) -> None:
        problems = self._parameters.apply(revision, values)
        answer: dict[str, Any] = {"kind": "parameters", "revision": revision}
        if problems:
            answer = {"kind": "parameters_refused", "revision": revision, "problems": problems}
        with contextlib.suppress(EOFError):  # the process ends then
            self._front.send(answer)


def main(arguments: Sequence[str]) -> int:
    """Serve a bundle to the front at the other end of a socket."""
    parser = argparse.ArgumentParser("epypes.service.worker")
    parser.add_argument("socket", type=int)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--faults", type=int)
    options = parser.parse_args(arguments)
    _stay_with_the_front(options.faults)
    os.set_inheritable(options.socket, False)
    front = FrameSocket(socket.socket(fileno=options.socket))
    front.close_in_forks()
    reader = _FrontReader(front)
    threading.Thread(target=reader.read_all, name="epypes front", daemon=True).start()
    worker = _loaded(front, options.bundle, options.threads)
    if worker is None:
        return REFUSED
    worker.start()
    reader.attach(worker)
    worker.ending.wait()
    worker.stop()
    return ENDED


class _FrontReader:
    """Reads from the front from the first moment on, so that its end is noticed whatever else goes on."""

    def __init__(self, front: FrameSocket) -> None:
        self._front = front
        self._lock = threading.Lock()
        self._worker: Worker | None = None
        # Messages before there was a worker.
        self._early: list[tuple[dict[str, Any], list[memoryview]]] = []

    def attach(self, worker: Worker) -> None:
        """Give all messages to a worker, those before too."""
        with self._lock:
            self._worker = worker
            for header, frames in self._early:
                _give(worker, header, frames)
            self._early.clear()

    def read_all(self) -> None:
        """Read until the other side is gone; the process ends then, whatever it is doing."""
        while True:
            try:
                header, frames = self._front.receive()
            except EOFError:
                os._exit(FRONT_GONE)
            except BaseException as error:  # without this thread the worker would be deaf
                _not_understood(error)
            self._take(header, frames)
            # An event may be large: its memory must not be held until another one comes.
            del header, frames

    def _take(self, header: dict[str, Any], frames: list[memoryview]) -> None:
        with self._lock:
            if self._worker is not None:
                _give(self._worker, header, frames)
            elif header.get("kind") == "end":
                os._exit(ENDED)
            else:
                self._early.append((header, frames))


def _give(worker: Worker, header: dict[str, Any], frames: list[memoryview]) -> None:
    try:
        worker.receive(header, frames)
    except EOFError:
        os._exit(FRONT_GONE)
    except BaseException as error:  # as above
        _not_understood(error)


def _not_understood(error: BaseException) -> NoReturn:
    _log.error("a message of the front can't be understood: %r", error)
    os._exit(NOT_UNDERSTOOD)


def _stay_with_the_front(faults: int | None) -> None:
    """End with the front and not before it, and redirect what functions print to standard error."""
    # Ctrl+C in a terminal and a stop of the whole group are for the front, which ends its worker.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    os.dup2(2, 1)
    # Unbuffered by line: a buffer would be lost when the process is killed.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True)
    if faults is not None:
        os.set_inheritable(faults, False)
        faulthandler.enable(file=faults)
        faulthandler.register(signal.SIGUSR1, file=faults, all_threads=True)


def _loaded(front: FrameSocket, path: Path, threads: int) -> Worker | None:
    """Send that the worker is ready, if its bundle computes what was recorded, and return it; None if it does not."""
    reasons: Sequence[str]
    doing = f"Reading {path}"
    try:
        bundle = read_bundle(path)
        doing = f"The replay of {path}"
        report = replay(bundle)
        reasons = [] if report.identical else [str(found) for found in report.differences] or [str(report)]
        doing = f"Making the pipelines of {path}"
        worker = Worker(front, bundle, threads) if not reasons else None
    except MemoryError:
        # Not the fault of the bundle: the front tries again later.
        raise
    except BaseException as error:  # a module may call sys.exit
        worker, reasons = None, [_reason(error, doing, path.resolve())]
    if worker is None:
        front.send({"kind": "refused", "reasons": list(reasons)})
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
    front.send(ready)
    return worker


def _reason(error: BaseException, doing: str, folder: Path) -> str:
    """Return why a bundle can't be served: an error of EPypes, or what its code raised, and where."""
    if isinstance(error, EpypesError):
        return str(error)
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename.startswith(str(folder))]
    where = f" at {Path(frames[-1].filename).name}, line {frames[-1].lineno}: {frames[-1].line}" if frames else ""
    failure = Failure(doing, (), {}, error)
    notes = [note for note in getattr(error, "__notes__", ()) if isinstance(note, str)]
    return " | ".join([f"{doing} failed{where}: {failure.kind}: {failure.message}", *notes])[:_MAX_REASON]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
