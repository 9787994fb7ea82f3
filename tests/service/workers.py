"""How do tests drive a worker process, as a front does?"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from contextlib import contextmanager
from itertools import count

from epypes.service.packing import unpack
from epypes.service.worker_connection import frame_sockets
from epypes.wire import Envelope, decode, encode

TIMEOUT_S = 60.0


class Front:
    """The other end of a worker's channel; a watchdog kills a worker that does not answer."""

    def __init__(self, channel, process, faults):
        self.channel, self.process, self.faults = channel, process, faults
        self.seqs, self.asks = count(1), count(1)
        self.waiting = []

    def receive(self, kind):
        """Return the next message of a kind; others wait for whoever wants them."""
        for place, message in enumerate(self.waiting):
            if message[0]["kind"] == kind:
                return self.waiting.pop(place)
        watchdog = threading.Timer(TIMEOUT_S, self.process.kill)
        watchdog.start()
        try:
            while True:
                message = self.channel.receive()
                if message[0]["kind"] == kind:
                    return message
                assert message[0]["kind"] != "refused", message[0]
                self.waiting.append(message)
        finally:
            watchdog.cancel()

    def send_event(self, event):
        seq = next(self.seqs)
        frames = [event] if isinstance(event, bytes) else encode(event)
        self.channel.send({"kind": "event", "seq": seq}, frames)
        return seq

    def done(self):
        """Return the header of the next event that is done, and its answers."""
        header, frames = self.receive("done")
        answers, left = [], list(frames)
        for size in header["answers"]:
            mine, left = left[:size], left[size:]
            answers.append(bytes(mine[0]) if size == 1 else decode(mine))
        assert not left
        return header, answers

    def run(self, **parts):
        """Have one event worked on."""
        seq = self.send_event(Envelope(type="x", parts=parts))
        header, answers = self.done()
        assert header["seq"] == seq
        return header, answers

    def set(self, revision, **values):
        self.send_parameters(revision, {k: {"value": v} for k, v in values.items()})

    def send_parameters(self, revision, values):
        self.channel.send({"kind": "parameters", "revision": revision}, [json.dumps(values).encode()])

    def send_ask(self, what, **content):
        ask = next(self.asks)
        self.channel.send({"kind": "ask", "ask": ask, "what": what, **content})
        return ask

    def ask(self, what, **content):
        ask = self.send_ask(what, **content)
        header, frames = self.receive("answer")
        assert header["ask"] == ask
        return header, [bytes(frame) for frame in frames]

    def values(self, *tokens, **content):
        header, frames = self.ask("run", tokens=list(tokens), **content)
        assert "error" not in header, header
        return decode(unpack(frames[0]))

    def end(self):
        self.channel.send({"kind": "end"})
        return self.process.wait(TIMEOUT_S)


@contextmanager
def worker_of(bundle, tmp_path, *options, environment=None):
    """Start a worker; yield its front before it is ready. It is gone when the block ends."""
    channel, theirs = frame_sockets()
    faults = tmp_path / "faults.txt"
    with faults.open("wb") as file, (tmp_path / "stderr.txt").open("wb") as stderr, theirs:
        command = [sys.executable, "-I", "-m", "epypes.service.worker", str(theirs.fileno()), str(bundle)]
        process = subprocess.Popen(
            [*command, "--faults", str(file.fileno()), *options],
            pass_fds=[theirs.fileno(), file.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=stderr,
            env={**os.environ, **(environment or {})},
        )
    front = Front(channel, process, faults)
    front.stderr = tmp_path / "stderr.txt"
    try:
        yield front
    finally:
        channel.close()
        try:
            process.wait(TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
        finally:
            process.kill()
            process.wait()
            process.stdout.close()


@contextmanager
def ready_worker(bundle, tmp_path, *options, **more):
    """Start a worker and wait until it is ready."""
    with worker_of(bundle, tmp_path, *options, **more) as front:
        front.ready, _ = front.receive("ready")
        yield front
