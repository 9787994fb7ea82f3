"""Commands on recordings of published messages: record, play."""

from __future__ import annotations

import math
import threading
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path
from typing import Any, Final

import click

from epypes.cli.options import PATH, allow_option, command, insecure_option, keys_option, refuse_nan
from epypes.errors import RecordingError
from epypes.wording import counted

# Long enough for a running publisher to confirm; a publisher of 2019 never does.
_JOIN_S: Final = 0.5
# A slow disk has this time to write what waits; the rest is dropped, and counted.
_STOP_S: Final = 30.0
_SPEED: Final = click.FloatRange(0.0)


@command("epypes record tcp://127.0.0.1:5556 answers.mcap --seconds 60")
@click.argument("address", help="Address of the publisher. bind:ADDRESS binds in place of connecting.")
@click.argument("file", type=PATH, help="MCAP file to write.")
@click.option("--topic", default="", show_default=False, help="Record only this topic and the topics below it.")
@click.option("--seconds", type=click.FloatRange(0.0), callback=refuse_nan, help="Stop after this number of seconds.")
@click.option("--messages", type=click.IntRange(1), help="Stop after this number of messages.")
@click.option("--force", is_flag=True, help="Replace an existing file.")
@insecure_option
@keys_option
@allow_option
def record(
    address: str, file: Path, topic: str, seconds: float | None, messages: int | None, force: bool, **access: Any
) -> None:
    """Record the messages of a publisher in a file.

    The recording ends at Ctrl+C or SIGTERM, or after --seconds or --messages. epypes play publishes it again, and
    Foxglove shows its images.
    """
    from epypes.service.serving import SignalWait
    from epypes.transport import Recorder

    if seconds is not None and seconds > threading.TIMEOUT_MAX:
        text = f"--seconds {seconds:g} is too long: {threading.TIMEOUT_MAX:.0f} at most; without it, Ctrl+C ends it."
        raise RecordingError(file, text)
    with SignalWait() as signals, ExitStack() as ending:
        recorder = Recorder(address, file, topic, force=force, messages=messages, on_end=signals.now, **access).start()
        # In reverse order, the last one also if stopping fails.
        ending.callback(lambda: click.echo(f"RECORDED {file}: {recorder.counts}."))
        ending.callback(recorder.stop, _STOP_S)
        joined = "" if recorder.wait_joined(_JOIN_S) else " (no publisher has confirmed yet)"
        click.echo(f"RECORDING {recorder.address}{joined} to {file}. Ctrl+C ends it.")
        signals.wait(seconds)


@command("epypes play answers.mcap tcp://127.0.0.1:5555 --speed 2")
@click.argument("file", type=PATH, help="MCAP file of epypes record.")
@click.argument(
    "address",
    default="tcp://127.0.0.1:*",
    help="Address to bind; default: a free port. connect:ADDRESS connects in place of binding.",
)
@click.option(
    "--speed",
    type=_SPEED,
    default=1.0,
    callback=refuse_nan,
    help="Speed factor: 2 is twice as fast, 0 sends without pauses.",
)
@click.option("--loop", type=click.IntRange(0), default=1, help="Number of times to play the file; 0: until Ctrl+C.")
@click.option("--wait/--no-wait", default=True, help="Wait for a subscriber before the first message is sent.")
@click.option("--info", "only_info", is_flag=True, help="Print what the file contains, and send nothing.")
@insecure_option
@keys_option
@allow_option
def play(file: Path, address: str, speed: float, loop: int, wait: bool, only_info: bool, **access: Any) -> None:
    """Publish the messages of a recording again.

    The time between two messages is that of the recording, divided by --speed.
    """
    from epypes.service.serving import SignalWait
    from epypes.transport import Player

    if only_info:
        _print_info(file)
        return
    if speed == math.inf:
        raise RecordingError(file, "--speed inf is no speed. 0 is as fast as possible.")
    with SignalWait() as signals, ExitStack() as ending:
        player = Player(file, address, speed=speed, loop=loop, wait=wait, on_end=signals.now, **access).start()
        ending.callback(lambda: click.echo(f"PLAYED {file}: sent {player.sent}."))
        ending.callback(player.stop)
        click.echo(f"PLAYING {file} at {player.address}. Ctrl+C ends it.")
        signals.wait()


def _print_info(file: Path) -> None:
    from epypes.transport import recording_info

    found = recording_info(file)
    source = f" from {found.about['address']}" if "address" in found.about else ""
    click.echo(f"{file}: {counted(found.messages, 'message')}{source} in {found.duration_s:.3f} s")
    if found.messages:
        begun = datetime.fromtimestamp(found.first_ns / 1e9).astimezone()
        click.echo(f"first message on {begun:%Y-%m-%d at %H:%M:%S %z}")
    click.echo(str(found.counts or "The recorder did not finish it: what it had not written is missing."))
    for topic, count in sorted(found.topics.items()):
        click.echo(f"  {topic or '(no topic)'}: {counted(count, 'message')}")
