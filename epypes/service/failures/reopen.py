"""`load_failure`: an event that failed in a service, in a notebook, stopped at the function that failed."""

from __future__ import annotations

import queue
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from epypes.bundle.load import Bundle, pipeline_of, read_bundle
from epypes.errors import RemoteFailure
from epypes.run import CompGraphRunner
from epypes.run.runner import stop_at
from epypes.service.failures.record import FailedEvent, state_of, values_of
from epypes.service.failures.reproduce import reproduce
from epypes.service.failures.source import bundle_of, failures_of, find_failure, path_of

# The functions of these failures are not called here: they would end this process, or never return.
_NOT_CALLED: Final = ("killed", "stuck", "exhausted")


def load_failure(id: str, source: Any = None, *, bundle: str | Path | None = None) -> CompGraphRunner:  # noqa: A002
    """Return a runner whose last run is the one that failed in a service, stopped at the function that failed.

    The event is run again here: with the bundle's f_in, the hyperparameters and the state between events of that time,
    and all functions up to the one that failed. A function that killed the worker or never returned is not called;
    ``rerun`` would call it.

    Parameters
    ----------
    id
        The failure's id, the first or last characters of it, the id of the event that failed, which is the
        ``input_id`` of the failure in its answer, or ``"latest"``.
    source
        The path of the bundle that was served, the http URL of its service, or a Connection; without, all failures of
        this machine.
    bundle
        Where the bundle is on this machine, if it was served from another place.

    Returns
    -------
    CompGraphRunner
        Its ``last`` shows the failed function in red and the values before it; ``rerun(threshold=90)`` goes on from
        there.

    Raises
    ------
    UnknownName
        There is no such failure.
    FailureNotKept
        Its event was not kept, or can't be read.
    BundleError
        The bundle that failed is not there.
    ServiceError
        The service can't be reached.
    Exception
        What f_in raises, where it is f_in that fails.

    Warns
    -----
    UserWarning
        If the bundle has changed since, or the event does not fail here as it did there.
    """
    failures = failures_of(source)
    record = find_failure(failures, id)
    event, state = failures.event(record.id), failures.state(record.id)
    folder, changed = bundle_of(record, bundle or path_of(source))
    opened = read_bundle(folder)
    runner = CompGraphRunner(opened.cg, opened.settings.hyperparameters)
    values, left_out = values_of(record, runner.hyperparameters, opened.enums)
    runner.set(**values)
    runner.state, no_state = state_of(state, runner.state)
    if record.kind in _NOT_CALLED:
        differs = _stop(runner, opened, record, event, state)
    else:
        differs = _run(runner, opened, record, event)
    for note in filter(None, [changed, left_out, no_state, differs]):
        warnings.warn(f"Failure {record.id}: {note}.", stacklevel=2)
    return runner


def _payload(bundle: Bundle, event: Any) -> Mapping[str, Any]:
    pipeline = pipeline_of(bundle, queue.SimpleQueue(), queue.SimpleQueue())
    try:
        payload: Mapping[str, Any] = pipeline.f_in(event)
    except Exception as error:
        error.add_note(f"f_in of {bundle.path} fails on this event, so no function of the graph was run.")
        raise
    return payload


def _run(runner: CompGraphRunner, bundle: Bundle, record: FailedEvent, event: Any) -> str:
    """Run the event; return what differs from the record, nothing if the same function failed in the same way."""
    payload = _payload(bundle, event)
    try:
        runner.run_on(payload)
    except KeyboardInterrupt:
        raise
    except BaseException:  # the failed run has the exception of the user's function
        if runner.last is None:
            raise
    failure = runner.last.failure if runner.last is not None else None
    there = f"there it was {record.function!r} ({record.summary})"
    if record.kind == "dropped":
        return "this event was dropped before any function was called"
    if failure is None:
        is_function = record.function in runner.cg.functions
        return f"nothing fails here; {there}" if is_function else f"no function fails; {there}"
    if (failure.function, failure.kind) != (record.function, record.exception):
        return f"here {failure.function!r} fails ({failure.kind}); {there}"
    return ""


def _stop(runner: CompGraphRunner, bundle: Bundle, record: FailedEvent, event: Any, state: bytes) -> str:
    """Run the event up to the function that failed, which is not called; return a note if that is not possible."""
    if record.kind == "exhausted":
        stop_at(runner, _payload(bundle, event))
        text = f"it is not known which function it is, so none was run ({record.message})"
        return f"{text}. rerun('token') goes on to a token"
    if record.function not in (*runner.cg.functions, "f_in"):
        # The service could not say where its worker was. Another process, which may be lost, finds out.
        record = replace(record, function=reproduce(record, event, bundle.path, state).function)
    if record.function == "f_in":
        return f"f_in was {record.kind} by this event, so it is not called here, and no function was run"
    payload = _payload(bundle, event)
    if record.function not in runner.cg.functions:
        stop_at(runner, payload)
        text = f"the worker was {record.kind}, and it is not known in which function, so none was run"
        return f"{text}. rerun('token') goes on to a token"
    why = RemoteFailure(bundle.path, record.function, record.kind, f"not called here. {record.message}")
    run = stop_at(runner, payload, record.function, why)
    if run.failure is not None and run.failure.exception is not why:
        return f"before {record.function!r}, which was {record.kind}, {run.failure.function!r} fails here"
    return ""
