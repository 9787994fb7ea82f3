"""Where are two hosts, on one machine? In two network namespaces with an address each and a cable between them."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
from dataclasses import dataclass

_PATH = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"


def _ip(*words):
    return subprocess.run(
        [shutil.which("ip", path=_PATH) or "ip", *words], capture_output=True, text=True, check=True, timeout=60
    ).stdout


@dataclass(frozen=True)
class Host:
    """A network of its own: what is started with ``before`` in front of it sees no other."""

    name: str
    address: str

    @property
    def before(self):
        return (shutil.which("ip", path=_PATH), "netns", "exec", self.name)


@dataclass(frozen=True)
class Cable:
    """What connects two hosts; it is pulled out of the first."""

    host: Host

    def pull(self):
        _ip("-n", self.host.name, "link", "set", "cable", "down")

    def plug(self):
        _ip("-n", self.host.name, "link", "set", "cable", "up")

    @property
    def is_up(self):
        return json.loads(_ip("-n", self.host.name, "-json", "link", "show", "cable"))[0]["operstate"] == "UP"


def why_not():
    """Return why this machine gives nobody two hosts; empty if it does."""
    name = f"epypes-{os.getpid()}-try"
    try:
        _ip("netns", "add", name)
    except FileNotFoundError:
        return "there is no command ip: install your system's package iproute2"
    except subprocess.CalledProcessError as error:
        return f"network namespaces are not permitted: {error.stderr.strip()}"
    _ip("netns", "del", name)
    return ""


@contextlib.contextmanager
def two_hosts():
    """Give two hosts and the cable between them; they are removed afterwards, and the cable with them."""
    hosts = [Host(f"epypes-{os.getpid()}-{number}", f"10.77.0.{number}") for number in (1, 2)]
    made = []
    try:
        for host in hosts:
            _ip("netns", "add", host.name)
            made.append(host)
        names = [host.name for host in hosts]
        _ip("link", "add", "cable", "netns", names[0], "type", "veth", "peer", "name", "cable", "netns", names[1])
        for host in hosts:
            _ip("-n", host.name, "addr", "add", f"{host.address}/24", "dev", "cable")
            for link in ("lo", "cable"):
                _ip("-n", host.name, "link", "set", link, "up")
        yield (*hosts, Cable(hosts[0]))
    finally:
        for host in made:
            _ip("netns", "del", host.name)
