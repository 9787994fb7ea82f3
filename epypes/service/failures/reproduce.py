"""Running an event that failed once more, in a fresh process that may be killed or stuck.

Run as a program (``python -I -m epypes.service.failures.reproduce BUNDLE FOLDER SECONDS``) it is that process.
"""

from __future__ import annotations

import faulthandler
import json
import linecache
import os
import queue
import re
import signal
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from epypes.bundle.manifest import MODULE
from epypes.errors import BundleError, EpypesError
from epypes.service.failures.record import FailedEvent, read_record, state_of, values_of, with_id
from epypes.service.supervision.worker_connection import signal_name

if TYPE_CHECKING:
    from epypes.pipeline import FullPipeline
    from epypes.run import Failure
    from epypes.wire import Envelope

TIMEOUT_S: Final = 30.0
# To start Python, to import what the bundle imports, and to end.
_START_AND_END_S: Final = 60.0
_RECORD, _EVENT, _STATE, _OUTCOME, _CALLS, _DUMP = "record.json", "event", "state", "outcome.json", "calls", "dump"
# What functions print comes before the lines of a process that ends.
_MAX_DUMP_BYTES: Final = 256 * 1024
_DUMP_LINE: Final = re.compile(r'^  File "([^"\n]*)", line (\d+) in (\S+)', re.MULTILINE)

Ending = Literal["failed", "fine", "killed", "stuck"]


@dataclass(frozen=True, slots=True)
class Reproduction:
    """The result of running an event again.

    Attributes
    ----------
    ending
        ``"failed"``: it was raised again, or something else was; ``"fine"``; ``"killed"``: the process ended with it;
        ``"stuck"``: it took longer than it was given.
    function
        A function of the graph, f_in, f_out or compute; empty if it is not known.
    exception, message, trace
        What was raised; or how the process ended.
    line, code
        The last line of the bundle's code that was executed: its number from 1, 0 if it is not known; and its text.
    file
        The file of the bundle that has it.
    """

    ending: Ending
    function: str = ""
    exception: str = ""
    message: str = ""
    trace: tuple[str, ...] = ()
    line: int = 0
    code: str = ""
    file: str = MODULE

    @property
    def place(self) -> str:
        """Function and line, as a part of a sentence."""
        where = f"in {self.function!r}" if self.function else "in a function that is not known"
        return f"{where}, {self.file}, line {self.line}: {self.code}" if self.line else where


def reproduce(
    record: FailedEvent,
    event: Envelope | bytes,
    bundle: str | Path,
    state: bytes = b"",
    *,
    timeout_s: float = TIMEOUT_S,
) -> Reproduction:
    """Run an event once more, alone in a new interpreter that sees neither the environment nor the current folder.

    Parameters
    ----------
    record
        Its hyperparameters are taken, as far as the bundle has them.
    bundle
        The folder of the bundle.
    state
        The packed state between events that it began with; empty for the initial one.
    timeout_s
        How long the event may take, in seconds.

    Raises
    ------
    BundleError
        The bundle is not what was promoted, or its module fails.
    """
    from epypes.service.supervision.packing import pack_event

    with tempfile.TemporaryDirectory(prefix="epypes-replay-") as name:
        scratch = Path(name)
        (scratch / _RECORD).write_text(json.dumps(asdict(with_id(record)), default=str), encoding="utf-8")
        (scratch / _EVENT).write_bytes(pack_event(event))
        (scratch / _STATE).write_bytes(state)
        folder = Path(bundle).resolve()
        status = _run_process(folder, scratch, timeout_s)
        return _read_result(folder, scratch, status, timeout_s)


def _run_process(folder: Path, scratch: Path, timeout_s: float) -> int | None:
    """Return the exit status of the process; None if it had to be killed."""
    arguments = [str(folder), str(scratch), f"{timeout_s:g}"]
    with (scratch / _DUMP).open("wb") as dump:
        process = subprocess.Popen(  # noqa: S603 - this interpreter, this module
            [sys.executable, "-I", "-m", __spec__.name, *arguments],
            cwd=scratch,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=dump,
            # All processes that a function has started can be ended with their group; and Ctrl+C does not reach it.
            start_new_session=True,
        )
        try:
            return process.wait(timeout_s + _START_AND_END_S)
        except subprocess.TimeoutExpired:
            return None
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def _read_result(folder: Path, scratch: Path, status: int | None, timeout_s: float) -> Reproduction:
    """Read what the process has left."""
    with (scratch / _DUMP).open("rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - _MAX_DUMP_BYTES))
        dump = file.read().decode(errors="replace")
    if (scratch / _OUTCOME).is_file():
        outcome = json.loads((scratch / _OUTCOME).read_text(encoding="utf-8"))
        if "refused" in outcome:
            raise BundleError(folder, outcome["refused"])
        return Reproduction(**{**outcome, "trace": tuple(outcome["trace"])})
    if not (scratch / _CALLS).is_file():
        last = dump.strip().splitlines()[-1:] or ["no message"]
        raise BundleError(folder, f"{folder} can't be loaded for a replay: {last[0]}")
    calls = (scratch / _CALLS).read_text(encoding="utf-8").splitlines()
    function = calls[-1] if calls else ""
    # The dump of all threads begins with the innermost frame of each.
    own = (match for match in _DUMP_LINE.finditer(dump) if Path(match[1]).is_relative_to(folder))
    frame = next(own, None)
    line, code = (int(frame[2]), linecache.getline(frame[1], int(frame[2])).strip()) if frame else (0, "")
    place = Path(frame[1]).relative_to(folder).as_posix() if frame else MODULE
    if status is None or (status == 1 and "Timeout (" in dump):
        return Reproduction("stuck", function, "TimeoutError", f"more than {timeout_s:g} s", (), line, code, place)
    ended = f"status {status}" if status >= 0 else signal_name(-status)
    return Reproduction("killed", function, ended, "the process ended with it", (), line, code, place)


# -- in the process of its own ----------------------------------------------------------------------------------------


def main(arguments: list[str]) -> int:
    """Run the event in a scratch folder on a bundle, and write the outcome into the scratch folder."""
    folder, scratch, timeout_s = Path(arguments[0]), Path(arguments[1]), float(arguments[2])
    faulthandler.enable()
    try:
        pipeline, failures = _pipeline(folder, scratch)
    except Exception as error:
        text = str(error) if isinstance(error, EpypesError) else f"{folder} fails: {type(error).__name__}: {error}"
        _write_outcome(scratch, {"refused": text})
        return 1
    from epypes.service.supervision.packing import unpack_event

    event = unpack_event((scratch / _EVENT).read_bytes())
    # Its thread does not need the GIL: it shows the line also while a C function holds that.
    faulthandler.dump_traceback_later(timeout_s, exit=True)
    pipeline.handle(event)
    faulthandler.cancel_dump_traceback_later()
    _write_outcome(scratch, asdict(_reproduction(failures[-1], folder) if failures else Reproduction("fine")))
    return 0


def _pipeline(folder: Path, scratch: Path) -> tuple[FullPipeline, list[Failure]]:
    """Return the pipeline that the service runs, with the hyperparameters that failed, and the list of its failures."""
    from epypes.bundle.load import pipeline_of, read_bundle

    bundle = read_bundle(folder)
    pipeline = pipeline_of(bundle, queue.SimpleQueue(), queue.SimpleQueue())
    record = read_record(json.loads((scratch / _RECORD).read_bytes()))
    pipeline.runner.set(**values_of(record, pipeline.runner.hyperparameters, bundle.enums)[0])
    pipeline.state = state_of((scratch / _STATE).read_bytes(), pipeline.state)[0]
    failures: list[Failure] = []
    pipeline.on_error = failures.append
    _log_calls(pipeline, scratch / _CALLS)
    return pipeline, failures


def _log_calls(pipeline: FullPipeline, file: Path) -> None:
    """Write the name of every function to a file before it is called: the file outlives the process."""
    from epypes.pipeline.node import wrap_calls

    descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)

    def logged(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any) -> Any:
            os.write(descriptor, f"{name}\n".encode())
            return function(*args)

        return call

    pipeline.f_in, pipeline.f_out = logged("f_in", pipeline.f_in), logged("f_out", pipeline.f_out)
    for name, node in pipeline.network.nodes.items():
        wrap_calls(node, partial(logged, name))


def _reproduction(failure: Failure, folder: Path) -> Reproduction:
    exception = failure.exception
    frames = traceback.extract_tb(exception.__traceback__)
    own = [frame for frame in frames if Path(frame.filename).is_relative_to(folder)]
    trace = "".join(traceback.format_exception(exception)).splitlines()
    return Reproduction(
        "failed",
        failure.function,
        failure.kind,
        failure.message,
        tuple(trace[-100:]),
        (own[-1].lineno or 0) if own else 0,
        (own[-1].line or "") if own else "",
        Path(own[-1].filename).relative_to(folder).as_posix() if own else MODULE,
    )


def _write_outcome(scratch: Path, outcome: dict[str, Any]) -> None:
    part = scratch / f"{_OUTCOME}.part"
    part.write_text(json.dumps(outcome), encoding="utf-8")
    part.replace(scratch / _OUTCOME)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
