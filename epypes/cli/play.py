"""``epypes play``: what was recorded, published once more."""

from __future__ import annotations

import math
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from epypes.cli.options import Allow, Keys
from epypes.cli.terminal import out
from epypes.errors import RecordingError
from epypes.wording import counted

if TYPE_CHECKING:
    from epypes.transport import RecordingInfo


def play(
    file: Annotated[Path, typer.Argument(help="The MCAP file that epypes record wrote.")],
    address: Annotated[
        str, typer.Argument(help="Where to publish; connect:ADDRESS connects.", show_default=True)
    ] = "tcp://127.0.0.1:*",
    speed: Annotated[float, typer.Option(help="2 is twice as fast; 0 is as fast as possible.", min=0.0)] = 1.0,
    loop: Annotated[int, typer.Option(help="How often; 0 is until Ctrl+C.", min=0)] = 1,
    wait: Annotated[bool, typer.Option(help="Wait for a subscriber before the first message.")] = True,
    insecure: Annotated[bool, typer.Option(help="Bind an address that other machines can reach.")] = False,
    keys: Keys = None,
    allow: Allow = None,
    only_info: Annotated[bool, typer.Option("--info", help="Send nothing; print what is in the file.")] = False,
) -> None:
    """Publish the messages of a file as they came, at the same distances in time."""
    from epypes.service.serving import SignalWait
    from epypes.transport import Player, recording_info

    if only_info:
        _print_info(file, recording_info(file))
        return
    if speed == math.inf:
        raise RecordingError(file, "--speed inf is no speed. 0 is as fast as possible.")
    with SignalWait() as signals:
        player = Player(
            file,
            address,
            speed=speed,
            loop=loop,
            wait=wait,
            insecure=insecure,
            keys=keys,
            allow=allow,
            on_end=signals.now,
        ).start()
        try:
            out.print(f"PLAYING {file} at {player.address}. Ctrl+C ends it.")
            signals.wait()
        finally:
            try:
                player.stop()
            finally:
                out.print(f"PLAYED {file}: sent {player.sent}.")


def _print_info(file: Path, found: RecordingInfo) -> None:
    source = f" from {found.about['address']}" if "address" in found.about else ""
    out.print(f"{file}: {counted(found.messages, 'message')}{source} in {found.duration_s:.3f} s")
    if found.messages:
        begun = datetime.fromtimestamp(found.first_ns / 1e9).astimezone()
        out.print(f"first message on {begun:%Y-%m-%d at %H:%M:%S %z}")
    out.print(str(found.counts or "The recorder did not finish it: what it had not written is missing."))
    for topic, count in sorted(found.topics.items()):
        out.print(f"  {topic or '(no topic)'}: {counted(count, 'message')}")
