"""``epypes record``: what is published, into a file."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Annotated

import typer

from epypes.cli.options import Allow, Keys
from epypes.cli.terminal import out
from epypes.errors import RecordingError

# Long enough for a publisher that is there to confirm; one of 2019 never does.
_JOIN_S = 0.5
# A slow disk gets some time for what waits; then that is dropped, and counted.
_STOP_S = 30.0


def record(
    address: Annotated[str, typer.Argument(help="Where messages are published; bind:ADDRESS binds.")],
    file: Annotated[Path, typer.Argument(help="The MCAP file to write.")],
    topic: Annotated[str, typer.Option(help="Record this topic alone, with those below it.")] = "",
    seconds: Annotated[float | None, typer.Option(help="Stop after this time.", min=0.0)] = None,
    messages: Annotated[int | None, typer.Option(help="Stop after so many messages.", min=1)] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the file if it is there.")] = False,
    insecure: Annotated[bool, typer.Option(help="Bind an address that other machines can reach.")] = False,
    keys: Keys = None,
    allow: Allow = None,
) -> None:
    """Write every message that is published into a file, until SIGTERM or Ctrl+C."""
    from epypes.service.serving import SignalWait
    from epypes.transport import Recorder

    if seconds is not None and seconds > threading.TIMEOUT_MAX:
        text = f"--seconds {seconds:g} is too long: {threading.TIMEOUT_MAX:.0f} at most; without it, Ctrl+C ends it."
        raise RecordingError(file, text)
    with SignalWait() as signals:
        recorder = Recorder(
            address,
            file,
            topic,
            force=force,
            messages=messages,
            insecure=insecure,
            keys=keys,
            allow=allow,
            on_end=signals.now,
        )
        recorder.start()
        try:
            joined = "" if recorder.wait_joined(_JOIN_S) else " (no publisher has confirmed yet)"
            out.print(f"RECORDING {recorder.address}{joined} to {file}. Ctrl+C ends it.")
            signals.wait(seconds)
        finally:
            try:
                recorder.stop(_STOP_S)
            finally:
                out.print(f"RECORDED {file}: {recorder.counts}.")
