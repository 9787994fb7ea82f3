"""``epypes stop``: a running service is ended, and its end waited for."""

from __future__ import annotations

import os
import select
import signal
from typing import Annotated

import typer

from epypes.cli.source import Source, state_of
from epypes.cli.terminal import out
from epypes.errors import ServiceError

_MS_PER_S = 1000


def stop(
    source: Source,
    timeout: Annotated[float, typer.Option(help="How long to wait for its end, in seconds.", min=0.0)] = 30.0,
) -> None:
    """End a running service of this user's, as SIGTERM does: it answers first what it has accepted."""
    pid = state_of(source).pid
    try:
        process = os.pidfd_open(pid)
    except OSError as error:
        raise ServiceError(
            source, f"Process {pid}, which serves {source}, can't be ended: {error.strerror}."
        ) from error
    try:
        # The descriptor is that of one process, whoever has its number meanwhile.
        signal.pidfd_send_signal(process, signal.SIGTERM)
        ended = select.poll()
        ended.register(process, select.POLLIN)
        if not ended.poll(timeout * _MS_PER_S):
            text = f"Process {pid}, which serves {source}, has not ended within {timeout:g} s. Wait longer: --timeout."
            raise ServiceError(source, text)
    except OSError as error:
        raise ServiceError(
            source, f"Process {pid}, which serves {source}, can't be ended: {error.strerror}."
        ) from error
    finally:
        os.close(process)
    out.print(f"STOPPED {source}, process {pid}.")


def _ended(pid: int, timeout_s: float) -> bool:
    """End a process, and return whether it has ended in time."""
    process = os.pidfd_open(pid)
    try:
        # The descriptor is that of one process, whoever has its number meanwhile.
        signal.pidfd_send_signal(process, signal.SIGTERM)
        ended = select.poll()
        ended.register(process, select.POLLIN)
        return bool(ended.poll(timeout_s * _MS_PER_S))
    finally:
        os.close(process)
