"""A worker process, driven as a front drives it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from contextlib import contextmanager
from itertools import count

from epypes.service.supervision.frame_socket import ControlSocket, FrameSocket, WorkerMessage
from epypes.service.supervision.packing import unpack
from epypes.wire import Envelope, decode, encode

TIMEOUT_S = 60.0


class Front:
    """The other end of a worker's sockets; a watchdog kills a worker that does not answer."""

    def __init__(self, channel, control, process, faults):
        self.channel, self.control, self.process, self.faults = channel, control, process, faults
        self.seqs, self.numbers = count(1), count(1)
        self.waiting = []

    def receive(self, kind):
        """Return the next message of a kind; others are kept for later calls."""
        for place, message in enumerate(self.waiting):
            if message.kind == kind:
                return self.waiting.pop(place)
        watchdog = threading.Timer(TIMEOUT_S, self.process.kill)
        watchdog.start()
        try:
            while True:
                message = self.channel.receive()
                if message.kind == kind:
                    return message
                assert message.kind != "refused", message
                self.waiting.append(message)
        finally:
            watchdog.cancel()

    def send_event(self, event):
        seq = next(self.seqs)
        frames = [event] if isinstance(event, bytes) else encode(event)
        self.channel.send(WorkerMessage("event", seq, frames=frames))
        return seq

    def done(self):
        """Return the contents of the next ``done`` message with its ``seq``, and the answers."""
        message = self.receive("done")
        answers, left = [], list(message.frames)
        for size in message.content["answers"]:
            mine, left = left[:size], left[size:]
            answers.append(bytes(mine[0]) if size == 1 else decode(mine))
        assert not left
        return {"seq": message.number, **message.content}, answers

    def run(self, **parts):
        """Have one event worked on."""
        seq = self.send_event(Envelope(type="x", parts=parts))
        header, answers = self.done()
        assert header["seq"] == seq
        return header, answers

    def set(self, revision, **values):
        return self.send_parameters(revision, {k: {"value": v} for k, v in values.items()})

    def send_parameters(self, revision, values):
        number = next(self.numbers)
        frames = [json.dumps(values).encode()]
        self.channel.send(WorkerMessage("parameters", number, {"revision": revision}, frames))
        return number

    def changed(self):
        """Return the contents of the next answer to a change of parameters."""
        return self.receive("parameters").content

    def send_query(self, what, **content):
        message = WorkerMessage("query", next(self.numbers), {"what": what, **content})
        (self.channel if "revision" in content else self.control).send(message)
        return message.number

    def query(self, what, **content):
        number = self.send_query(what, **content)
        answer = self.receive("answer")
        assert answer.number == number
        return answer.content, [bytes(frame) for frame in answer.frames]

    def values(self, *tokens, **content):
        header, frames = self.query("run", tokens=list(tokens), **content)
        assert "error" not in header, header
        return decode(unpack(frames[0]))

    def close(self):
        self.channel.close()
        self.control.close()

    def end(self):
        self.channel.send(WorkerMessage("end"))
        return self.process.wait(TIMEOUT_S)


@contextmanager
def worker_of(bundle, tmp_path, *options, environment=None):
    """Start a worker; yield its front before it is ready. It is gone when the block ends."""
    (channel, theirs), (control, their_control) = FrameSocket.pair(), ControlSocket.pair()
    faults = tmp_path / "faults.txt"
    with faults.open("wb") as file, (tmp_path / "stderr.txt").open("wb") as stderr, theirs, their_control:
        sockets = theirs.fileno(), their_control.fileno()
        command = [sys.executable, "-I", "-m", "epypes.service.worker", *map(str, sockets), str(bundle)]
        process = subprocess.Popen(
            [*command, "--faults", str(file.fileno()), *options],
            pass_fds=[*sockets, file.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=stderr,
            env={**os.environ, **(environment or {})},
        )
    front = Front(channel, control, process, faults)
    front.stderr = tmp_path / "stderr.txt"
    try:
        yield front
    finally:
        front.close()
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
        front.ready = front.receive("ready").content
        yield front
