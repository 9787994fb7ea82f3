"""The worker process: the only process of a service that runs the bundle's functions.

``python -I -m epypes.service.worker SOCKET CONTROL BUNDLE --threads N --faults FD``: SOCKET and CONTROL are descriptors
of the sockets to the front (`FrameSocket`, `ControlSocket`), FD is that of a file for the stacks of all threads,
written on SIGUSR1 or when the process crashes. It ends with 0 when the front ends it, with 1 when the bundle can't be
served, with 2 when it gets arguments or messages that it does not understand, with 3 when the front is gone.
"""

from __future__ import annotations

import argparse
import ctypes
import faulthandler
import io
import logging
import os
import signal
import socket
import sys
import threading
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from epypes.bundle.load import Bundle, read_bundle
from epypes.bundle.proof.replay import replay
from epypes.errors import EpypesError, InvalidValue
from epypes.pipeline import Pipeline
from epypes.run import Failure
from epypes.service.supervision.frame_socket import ControlSocket, FrameSocket, WorkerMessage
from epypes.service.worker.inputs import FRONT_GONE, Inputs, not_understood
from epypes.service.worker.run_queries import QueryAnswerer
from epypes.service.worker.slots import Slot, SlotParameters
from epypes.service.worker.states import WorkerStates, describe_delays

_ENDED: Final = 0
_REFUSED: Final = 1

_log: Final = logging.getLogger("epypes.service")
_PR_SET_PDEATHSIG: Final = 1
_STOP_TIMEOUT_S: Final = 5.0
_MAX_REASONS: Final = 100
_MAX_REASON: Final = 2_000


class Worker:
    """A bundle behind two sockets.

    Parameters
    ----------
    front
        What must stay in order: events, changes of parameters, results.
    control
        What is taken while functions run.
    bundle
        What it runs.
    threads
        How many events it works on at once. OpenCV's own threads are left as they were during the replay: with
        several slots they compete for the same cores.

    Attributes
    ----------
    delays
        What the bundle keeps between events; see `describe_delays`.
    """

    def __init__(self, front: FrameSocket, control: ControlSocket, bundle: Bundle, threads: int) -> None:
        self._front, self._control = front, control
        self._trial = trial = Pipeline(bundle.settings.name, bundle.cg, bundle.settings.hyperparameters)
        parameters = SlotParameters(trial, bundle.enums)
        self._answers = answers = QueryAnswerer(front, parameters)
        self._inputs = inputs = Inputs(front, parameters.apply)
        states = WorkerStates()
        self._slots = [Slot(bundle, inputs, front, parameters, answers, states) for _ in range(threads)]
        parameters.pipelines = [slot.pipeline for slot in self._slots]
        self.delays = describe_delays(self._slots[0].pipeline, bundle.settings.states)

    def work(self) -> None:
        """Work until the front sends that nothing more comes; the process ends if the front is gone."""
        self._answers.start()
        threading.Thread(target=self._read_control, name="epypes control", daemon=True).start()
        for slot in self._slots:
            slot.pipeline.listen()
        self._inputs.has_ended.wait()
        for slot in self._slots:
            # However long it takes: the front has a time-out.
            while not slot.pipeline.loop.drain(_STOP_TIMEOUT_S):
                _log.info("waiting for %s", slot.running)
            slot.pipeline.stop()

    def _read_control(self) -> None:
        while True:
            try:
                self._take(self._control.receive())
            except EOFError:
                os._exit(FRONT_GONE)
            except BaseException as error:  # without this thread the worker would be deaf
                not_understood(error)

    def _take(self, message: WorkerMessage) -> None:
        if message.kind == "withdraw":
            self._inputs.withdraw(message)
        elif message.kind != "query":
            raise InvalidValue(f"The front has sent a message of kind {message.kind!r}.")
        elif message.content["what"] == "running":
            # At once: the front asks when something takes too long, which may be another query.
            slots = [found for slot in self._slots if (found := slot.running)]
            running = [*(name for found in slots for name in found["functions"]), *self._trial.runner.running]
            self._front.send(WorkerMessage("answer", message.number, {"running": running, "slots": slots}))
        else:
            self._answers.put(message)


def main(arguments: Sequence[str]) -> int:
    """Serve a bundle to the front at the other end of a socket."""
    parser = argparse.ArgumentParser("epypes.service.worker")
    parser.add_argument("socket", type=int)
    parser.add_argument("control", type=int)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--faults", type=int)
    options = parser.parse_args(arguments)
    _stay_with_the_front(options.faults)
    ends = [socket.socket(fileno=descriptor) for descriptor in (options.socket, options.control)]
    for end in ends:
        end.set_inheritable(False)
        # Or the front would not see this process end while a forked child lives.
        os.register_at_fork(after_in_child=end.close)
    worker = _loaded(FrameSocket(ends[0]), ControlSocket(ends[1]), options.bundle, options.threads)
    if worker is None:
        return _REFUSED
    worker.work()
    return _ENDED


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


def _loaded(front: FrameSocket, control: ControlSocket, path: Path, threads: int) -> Worker | None:
    """Send that the worker is ready, if its bundle computes what was recorded, and return it; None if it does not."""
    reasons: Sequence[str]
    doing = f"Reading {path}"
    try:
        bundle = read_bundle(path)
        doing = f"The replay of {path}"
        report = replay(bundle)
        reasons = [] if report.identical else [str(found) for found in report.differences] or [str(report)]
        doing = f"Making the pipelines of {path}"
        worker = Worker(front, control, bundle, threads) if not reasons else None
    except MemoryError:
        # Not the fault of the bundle: the front tries again later.
        raise
    except BaseException as error:  # a module may call sys.exit
        worker, reasons = None, [_reason(error, doing, path.resolve())]
    if worker is None:
        texts = [reason[:_MAX_REASON] for reason in reasons[:_MAX_REASONS]]
        front.send(WorkerMessage("refused", content={"reasons": texts}))
        return None
    functions = list(bundle.cg.functions)
    ready = {
        "digest": bundle.digest,
        "report": str(report),
        "pid": os.getpid(),
        "functions": functions,
        "delays": worker.delays,
        "func_io": {name: [bundle.cg.func_inputs(name), bundle.cg.func_outputs(name)] for name in functions},
    }
    front.send(WorkerMessage("ready", content=ready))
    return worker


def _reason(error: BaseException, doing: str, folder: Path) -> str:
    """Return why a bundle can't be served: an error of EPypes, or what its code raised, and where."""
    if isinstance(error, EpypesError):
        return str(error)
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename.startswith(str(folder))]
    where = f" at {Path(frames[-1].filename).name}, line {frames[-1].lineno}: {frames[-1].line}" if frames else ""
    failure = Failure(doing, (), {}, error)
    notes = [note for note in getattr(error, "__notes__", ()) if isinstance(note, str)]
    return " | ".join([f"{doing} failed{where}: {failure.kind}: {failure.message}", *notes])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
