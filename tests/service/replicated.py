"""Replicas of a bundle on a broker, as tests serve them, and peers that publish beside them."""

from __future__ import annotations

import linecache
import re
import signal
from contextlib import contextmanager

import epypes as ep
from epypes.service.replication.messages import encode_message
from epypes.transport.address import parse_address
from tests.brokers.fleet import fleet

TOKEN = "t" * 40
MODULE = '''
import os
import time

import numpy as np


def kill_front():
    """Kill the replica that this is computed for; do nothing where it is computed for another process."""
    parent = os.getppid()
    with open(f"/proc/{parent}/cmdline", "rb") as file:
        is_replica = b"--replica" in file.read()
    if is_replica:
        os.kill(parent, 9)
        time.sleep(60)


def work(number, kind, gain):
    """Multiply; raise or kill a process if the event asks for it."""
    if kind == 1:
        os.kill(os.getpid(), 9)
    if kind == 2:
        raise ValueError(f"event {number} is spoilt")
    if kind == 3:
        kill_front()
    time.sleep(0.002 + 0.006 * (number % 7 == 0))
    return np.array([number, gain, number * gain])
'''


def promoted(folder):
    """Promote the function of the module; return the bundle's path."""
    folder.mkdir(parents=True, exist_ok=True)
    source = folder / "working.py"
    source.write_text(MODULE)
    names = {}
    exec(compile(MODULE, str(source), "exec"), names)
    linecache.getlines(str(source))
    graph = ep.CompGraph({"work": names["work"]}, {"work": (("number", "kind", "gain"), "result")})
    runner = ep.CompGraphRunner(graph, {"gain": 2})
    runner.run(number=3, kind=0)
    return ep.promote(runner, folder / "working").path


@contextmanager
def replicas(bundle, sub, pub, *options, names=("1", "2", "3"), before=()):
    """Serve a bundle on a broker, as a replica of each name; give the processes."""
    token = bundle.parent / "token"
    token.write_text(TOKEN)
    token.chmod(0o600)
    given = ["--sub", sub, "--pub", pub, "--http", "http://127.0.0.1:0", "--token-file", token, *options]
    command = ["-m", "epypes.cli", "serve", bundle, *given]
    with fleet([[*map(str, command), "--replica", name] for name in names], before) as members:
        yield members


def control(member):
    """Connect to a replica."""
    return ep.connect(re.search(r"control at (http://[^,]+)", member.lines[0])[1], token=TOKEN)


def stopped(member):
    """End a replica in order; return its counts."""
    line = member.end(signal.SIGTERM)
    assert member.process.returncode == 0, "".join(member.errors)
    assert line.startswith("STOPPED"), member.lines
    return {name: int(count) for name, count in re.findall(r"(\w+) (\d+)", line)}


def publish_to_replicas(sub, *messages):
    """Publish messages, or any bytes, to the replicas that take events from an address, as a peer process does."""
    with ep.Publisher(parse_address(sub).beside("group", "broadcast", create=True)) as publisher:
        for message in messages:
            publisher.send((message if isinstance(message, bytes) else encode_message(message),))
