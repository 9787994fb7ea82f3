"""``epypes stop``: a running service is ended, and its end waited for."""

from __future__ import annotations

import os
import select
import signal
from contextlib import ExitStack
from time import monotonic
from typing import TYPE_CHECKING, Annotated

import typer

from epypes.cli.source import Source, states_of
from epypes.cli.terminal import out
from epypes.errors import ServiceError

if TYPE_CHECKING:
    from epypes.service.state_file import ServiceState

_MS_PER_S = 1000


def stop(
    source: Source,
    timeout: Annotated[float, typer.Option(help="How long to wait for its end, in seconds.", min=0.0)] = 30.0,
    replica: Annotated[
        str, typer.Option(help="Which of several services of the bundle here; without, all of them are ended.")
    ] = "",
) -> None:
    """End a running service of this user's, as SIGTERM does: it answers first what it has accepted."""
    states = states_of(source, replica)
    until_s = monotonic() + timeout
    with ExitStack() as opened:
        processes = [(state, _asked_to_end(source, state, opened)) for state in states]
        late = []
        for state, process in processes:
            if process is not None and not _has_ended(process, max(until_s - monotonic(), 0.0)):
                late.append(_named(source, state))
                continue
            named = f", replica {state.replica}" if state.replica else ""
            out.print(f"STOPPED {source}{named}, process {state.pid}.")
    if late:
        raise ServiceError(source, f"{' '.join(late)} has not ended within {timeout:g} s. Wait longer: --timeout.")


def _named(source: str, state: ServiceState) -> str:
    return f"Process {state.pid}, which serves {source},"


def _asked_to_end(source: str, state: ServiceState, opened: ExitStack) -> int | None:
    """Tell a process to end; return its descriptor, which is that of one process, whoever has its number meanwhile.

    None is returned for one that has ended already: another one shall be told all the same.
    """
    try:
        process = os.pidfd_open(state.pid)
        opened.callback(os.close, process)
        signal.pidfd_send_signal(process, signal.SIGTERM)
    except ProcessLookupError:
        return None
    except OSError as error:
        text = f"{_named(source, state)} can't be ended: {error.strerror}."
        raise ServiceError(source, text) from error
    return process


def _has_ended(process: int, timeout_s: float) -> bool:
    ended = select.poll()
    ended.register(process, select.POLLIN)
    return bool(ended.poll(timeout_s * _MS_PER_S))
