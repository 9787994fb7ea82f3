"""Checks of this machine: versions, extras, ports, keys, a broker, a bundle, and the round-trip time.

Every check answers in one line, and one that fails says the way out. Nothing is changed.
"""

from __future__ import annotations

import os
import platform
import queue
import shutil
import socket
import stat
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from time import perf_counter_ns
from typing import TYPE_CHECKING, Any, Final, Literal

from epypes.bundle.manifest import check_manifest
from epypes.errors import EpypesError, install_command
from epypes.service.state_file import read_states, state_file

if TYPE_CHECKING:
    from packaging.requirements import Requirement

Outcome = Literal["ok", "warning", "failed"]

# A missing extra disables one part of EPypes.
_EXTRAS: Final = ("notebook", "vision", "serve", "service", "scale", "store", "rabbitmq", "nats", "mqtt")
_BROWSERS: Final = ("chromium", "chromium-browser", "google-chrome", "firefox", "safari", "microsoft-edge")
_ROUND_TRIPS: Final = 100
_ROUND_TRIP_TIMEOUT_S: Final = 5.0
# A loopback round trip takes 0.2 ms on an idle machine.
_SLOW_ROUND_TRIP_MS: Final = 20.0


@dataclass(frozen=True, slots=True)
class Check:
    """One check and its outcome.

    Attributes
    ----------
    name
        The subject.
    outcome
        ``"ok"``, ``"warning"`` for what only some users miss, or ``"failed"``.
    found
        The finding.
    way_out
        What helps; empty where nothing needs help.
    """

    name: str
    outcome: Outcome
    found: str
    way_out: str = ""


def examine(
    bundle: str | Path | None = None, *, addresses: Iterable[str] = (), keys: Iterable[str | Path] = ()
) -> Iterator[Check]:
    """Yield the checks of this machine, each as soon as it is done.

    Parameters
    ----------
    bundle
        A bundle that is to be served, or is: its manifest and its service are checked too.
    addresses
        Addresses that a service is to bind: ``tcp://127.0.0.1:5555``, ``http://127.0.0.1:8642``; or of a broker.
    keys
        Files of keys that are to be used.
    """
    checks: list[tuple[str, Callable[[], Check]]] = [
        ("Python", _python),
        ("EPypes", _epypes),
        *((f"extra {extra}", lambda extra=extra: _extra(extra)) for extra in _EXTRAS),
        ("OpenCV", _opencv),
        ("Graphviz", _graphviz),
        ("browser", _browser),
        ("state folder", _state_folder),
        *((f"address {_shown(address)}", lambda address=address: _address(address)) for address in addresses),
        *((f"keys {path}", lambda path=path: _keys(Path(path))) for path in keys),
        ("round trip", _round_trip),
    ]
    if bundle is not None:
        checks += [("bundle", lambda: _bundle(Path(bundle))), ("service", lambda: _service(Path(bundle)))]
    for name, look in checks:
        try:
            yield look()
        except EpypesError as error:
            yield Check(name, "failed", str(error))
        except Exception as error:  # a check that fails is a finding, and those after it are still wanted
            yield Check(name, "failed", f"{type(error).__name__}: {error}", "Report this: the check itself failed.")


def _shown(address: str) -> str:
    """Return an address without its password."""
    before, at, host = address.rpartition("@")
    return f"{before.partition('://')[0]}://{host}" if at else address


def _python() -> Check:
    found = f"{platform.python_implementation()} {platform.python_version()} at {sys.executable}, {platform.machine()}"
    return Check("Python", "ok", found)


def _epypes() -> Check:
    import epypes

    where = Path(epypes.__file__).parent
    return Check("EPypes", "ok", f"{metadata.version('epypes')} at {where}")


def _extra(extra: str) -> Check:
    """Check that the packages of an extra are installed, at the versions that it requires."""
    missing, found = [], []
    for one in _required(extra).values():
        try:
            version = metadata.version(one.name)
        except metadata.PackageNotFoundError:
            missing.append(one.name)
            continue
        if one.specifier.contains(version, prereleases=True):
            found.append(f"{one.name} {version}")
        else:
            missing.append(f"{one.name}{one.specifier} (is {version})")
    if missing:
        way_out = f"{install_command(extra)}, if you need it."
        return Check(f"extra {extra}", "warning", f"missing: {', '.join(missing)}", way_out)
    return Check(f"extra {extra}", "ok", ", ".join(found))


def _required(extra: str) -> dict[str, Requirement]:
    """Return what an extra requires, by name; an extra that consists of others requires what they do."""
    from packaging.requirements import Requirement

    found: dict[str, Requirement] = {}
    for one in map(Requirement, metadata.requires("epypes") or ()):
        if one.marker is None or one.marker.evaluate({"extra": ""}) or not one.marker.evaluate({"extra": extra}):
            continue
        if one.name == "epypes":
            for other in sorted(one.extras):
                found |= _required(other)
        else:
            found[one.name] = one
    return found


def _opencv() -> Check:
    twins = [name for name in metadata.packages_distributions().get("cv2", ()) if name]
    if not twins:
        return Check("OpenCV", "warning", "not installed", f"{install_command('vision')}, if you need it.")
    found = ", ".join(f"{name} {metadata.version(name)}" for name in sorted(set(twins)))
    if len(set(twins)) > 1:
        way_out = "They overwrite each other's files. Uninstall all of them, then install the one that you want."
        return Check("OpenCV", "failed", found, way_out)
    import cv2

    return Check("OpenCV", "ok", f"{found}, {cv2.getNumThreads()} threads")


def _graphviz() -> Check:
    from epypes.display.layout import Box, routed_layout

    engine = "pygraphviz" if find_spec("pygraphviz") else shutil.which("dot") or "none"
    try:
        routed_layout([Box("box", 40, 20), Box("ellipse", 40, 20)], [(0, 1)], frozenset())
    except EpypesError as error:
        way_out = f"{install_command('graphviz')}, or your system's package graphviz, if you want graphs drawn."
        return Check("Graphviz", "warning", str(error), way_out)
    return Check("Graphviz", "ok", f"lays out by {engine}")


def _browser() -> Check:
    named = (os.environ.get("BROWSER", ""), *_BROWSERS)
    found = next((path for name in named if name and (path := shutil.which(name))), None)
    if found is None:
        way_out = "Open JupyterLab's and the service's addresses in a browser of another machine through ssh -L."
        return Check("browser", "warning", "none on the PATH", way_out)
    return Check("browser", "ok", found)


def _state_folder() -> Check:
    folder = state_file(".").parent
    mode = stat.S_IMODE(folder.stat().st_mode)
    if mode & 0o077:
        return Check("state folder", "warning", f"{folder} is open to others", f"chmod 700 {folder}")
    free_mb = shutil.disk_usage(folder).free >> 20
    return Check("state folder", "ok", f"{folder}, {free_mb:,} MB free")


def _address(address: str) -> Check:
    """Check that an address can be bound now, that a broker has it, or that it can be opened."""
    from urllib.parse import urlsplit

    from epypes.transport.address import scheme_of

    scheme = scheme_of(address)
    if scheme is not None and not scheme.is_zeromq:
        return _open_address(address)
    name = f"address {address}"
    way_out = "Write tcp://127.0.0.1:5555, http://127.0.0.1:8642, or a broker's, as amqp://HOST/QUEUE."
    try:
        parts = urlsplit(address)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        return Check(name, "failed", str(error), way_out)
    if parts.scheme not in ("tcp", "http") or not host or not port:
        return Check(name, "failed", "not an address", way_out)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family) as taken:
        # As servers do: a port whose last connection is just closing is free.
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            taken.bind((host, port))
        except OSError as error:
            reason = error.strerror or str(error)
            return Check(name, "failed", reason, f"Name another port, or find its process: ss -ltnp 'sport = :{port}'")
    return Check(name, "ok", "free")


def _open_address(address: str) -> Check:
    from epypes.transport.address import open_channel, parse_address

    place = parse_address(address)
    channel = open_channel(place)
    channel.open(None)
    channel.close()
    return Check(f"address {place}", "ok", "the broker answers, and has it" if place.is_broker else "it can be opened")


def _keys(path: Path) -> Check:
    from epypes.transport import read_keys

    name = f"keys {path}"
    keys = read_keys(path)
    secret = next((file for file in (path, path.with_suffix(".key_secret")) if file.suffix == ".key_secret"), path)
    if secret.exists() and stat.S_IMODE(secret.stat().st_mode) & 0o077:
        return Check(name, "failed", f"{secret} can be read by others", f"chmod 600 {secret}, or make new ones.")
    return Check(name, "ok", f"public key {keys.public}")


def _round_trip() -> Check:
    """Time small messages there and back between two pairs of sockets of this process."""
    from epypes.transport import ZMQPublisher, ZMQSubscriber

    there: queue.SimpleQueue[Any] = queue.SimpleQueue()
    back: queue.SimpleQueue[Any] = queue.SimpleQueue()
    sent: queue.SimpleQueue[Any] = queue.SimpleQueue()
    with (
        ZMQPublisher("tcp://127.0.0.1:*", sent) as asking,
        ZMQSubscriber(asking.address, there) as asked,
        ZMQPublisher("tcp://127.0.0.1:*", back) as answering,
    ):
        answers: queue.SimpleQueue[Any] = queue.SimpleQueue()
        with ZMQSubscriber(answering.address, answers) as answered:
            joined = asked.wait_joined(_ROUND_TRIP_TIMEOUT_S) and answered.wait_joined(_ROUND_TRIP_TIMEOUT_S)
            if not joined:
                way_out = "A firewall or container forbids connections within this machine: allow 127.0.0.1."
                return Check("round trip", "failed", "no subscriber could join", way_out)
            times = [_trip_ns(sent, there, back, answers) for _ in range(_ROUND_TRIPS)]
    took_ms = median(times) / 1e6
    found = f"median {took_ms:.2f} ms, slowest {max(times) / 1e6:.2f} ms of {_ROUND_TRIPS} over loopback"
    if took_ms > _SLOW_ROUND_TRIP_MS:
        return Check("round trip", "warning", found, "This machine is busy: look at top.")
    return Check("round trip", "ok", found)


def _trip_ns(sent: Any, there: Any, back: Any, answers: Any) -> int:
    start_ns = perf_counter_ns()
    sent.put(b"there")
    back.put(there.get(timeout=_ROUND_TRIP_TIMEOUT_S))
    answers.get(timeout=_ROUND_TRIP_TIMEOUT_S)
    return perf_counter_ns() - start_ns


def _bundle(path: Path) -> Check:
    digest = check_manifest(path)
    return Check("bundle", "ok", f"{path} is whole: {digest[:16]}. epypes verify {path} replays it.")


def _service(path: Path) -> Check:
    running = read_states(path)
    if not running:
        return Check("service", "warning", "none runs for this bundle", f"epypes serve {path}")
    services = (
        f"process {state.pid}{f' (replica {state.replica})' if state.replica else ''}: "
        f"events at {state.sub}, answers at {state.pub}"
        for state in running
    )
    return Check("service", "ok", "; ".join(services))
