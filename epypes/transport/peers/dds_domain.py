"""The domains of DDS that a process has open, their configuration, and the quality of service of an address.

A domain is on 127.0.0.1, unless the address names another interface or CYCLONEDDS_URI says otherwise. A program on
Cyclone DDS finds the peers on this machine with `LOOPBACK` as its CYCLONEDDS_URI.
"""

from __future__ import annotations

import ctypes
import os
import re
import socket
import threading
from typing import Any, Final

from cyclonedds.core import DDSException
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.qos import Policy, Qos
from cyclonedds.util import duration

from epypes.errors import AddressError, BrokerError
from epypes.transport.address import Address
from epypes.transport.peers.channel import PeerSession

_TUNING: Final = (
    "<CycloneDDS><Domain>"
    # The trip of 1 MB takes half as long as by the default.
    "<General><MaxMessageSize>65500B</MaxMessageSize></General>"
    # Fast DDS (vendor 1.15) describes the types of ROS 2 so that Cyclone can't read it: names decide then.
    "<Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>"
    # A burst of 300 MB, which is more than the sockets hold, arrives within 1 s, and not 10.
    '<Internal><SocketReceiveBufferSize max="16MB"/><NackDelay>10ms</NackDelay>'
    "<DefragReliableMaxSamples>256</DefragReliableMaxSamples>"
    # Heartbeats ask for acknowledgements. By the default intervals, a writer of 150 messages per second keeps its whole
    # history; and a node of ROS 2 that keeps ten images misses half of them, since the readers of Fast DDS have small
    # buffers and learn of a loss by a heartbeat alone.
    '<HeartbeatInterval min="1ms" minsched="2ms" max="1s">5ms</HeartbeatInterval>'
    # A writer with more unacknowledged bytes would wait, for all readers and holding Python's lock.
    "<Watermarks><WhcHigh>1GB</WhcHigh><WhcHighInit>1GB</WhcHighInit><WhcAdaptive>false</WhcAdaptive></Watermarks>"
    # A larger message is dropped at its first fragment.
    "<MaxSampleSize>512MB</MaxSampleSize></Internal></Domain></CycloneDDS>"
)
# This interface has no multicast, so all ports of the domain are asked for peers. One that was killed is gone after the
# lease, as over ZeroMQ; Cyclone's default is 10 s.
LOOPBACK: Final = (
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    '<MaxAutoParticipantIndex>99</MaxAutoParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers>'
    "<LeaseDuration>3s</LeaseDuration></Discovery>"
    "</Domain></CycloneDDS>"
)
# glibc returns a block of 1 MB to the system when it is freed, and the next one comes page by page, filled with zeros:
# 3 of the 4.4 ms of CPU of an image's trip. After a block of this size was freed, it keeps such (M_MMAP_THRESHOLD).
_LARGE_BLOCK_BYTES: Final = 31 * 1024**2
# Beyond it, ports would go beyond 65,535.
_MOST_DOMAIN: Final = 230
# What a writer keeps for a reader that is behind, and a reader until the thread of its channel has time.
_WRITER_HISTORY: Final = 256
_READER_HISTORY: Final = 1_000
_MOST_HISTORY: Final = 1_000_000
_BLOCKED_S: Final = 0.1


def domain_of(address: Address) -> int:
    """Return the number of an address' domain.

    Raises
    ------
    AddressError
        There is no such domain.
    """
    host = address.host
    number = int(host) if host.isascii() and host.isdecimal() and len(host) < 4 else -1
    if not 0 <= number <= _MOST_DOMAIN or address.port or address.user:
        text = f"{address}: write dds://DOMAIN/TOPIC; a domain is a number from 0 to {_MOST_DOMAIN}."
        raise AddressError(str(address), text)
    return number


def check_topic(address: Address) -> None:
    """Raise AddressError for a topic with an empty word, and for one of ROS 2 without ``rt/``, which it has in DDS."""
    name, is_ros = address.name, "type" in address.options
    if (is_ros and not name.startswith("rt/")) or "" in name.split("/"):
        right = "/".join(filter(None, ["rt" if is_ros else "", *name.removeprefix("rt/").split("/")]))
        wrong = "a topic has one slash between two words"
        if is_ros and not name.startswith("rt/"):
            wrong = "in DDS, a topic of ROS 2 has rt/ before its name"
        raise AddressError(str(address), f"{address}: {wrong}: write dds://{address.host}/{right}")


class _Domains:
    """The domains that are open in this process, each with one participant for all its sessions."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        # By number: the configuration, the participant and, unless the program itself made it, the domain.
        self._open: dict[int, tuple[str, Any, Any]] = {}
        self._sessions: dict[PeerSession, int] = {}
        self._process = 0

    def join(self, session: PeerSession, number: int) -> Any:
        """Return the participant of a domain, which is there until its last session has left.

        Raises
        ------
        AddressError
            The address names an interface that another place does not, or that can't be one.
        BrokerError
            It can't be opened.
        """
        address = session.address
        config = _config(address)
        if self._open and self._process != os.getpid():
            text = f"{address}: the process that this one was forked from uses DDS, so this one can't. Spawn it."
            raise BrokerError(str(address), text)
        with self._lock:
            self._process = os.getpid()
            if number not in self._open:
                self._open[number] = (config, *_open_domain(address, number, config))
            elif self._open[number][0] != config:
                text = f"{address}: domain {number} is open in this process, on another interface; a domain has one."
                text += " Give all addresses of the domain the same interface=, or none."
                raise AddressError(str(address), text)
            self._sessions[session] = number
            return self._open[number][1]

    def leave(self, session: PeerSession) -> None:
        """Close the domain with its last session."""
        with self._lock:
            number = self._sessions.pop(session, None)
            if number is not None and number not in self._sessions.values():
                # The participant first.
                _, participant, domain = self._open.pop(number)
                del participant
                del domain

    def keep(self) -> None:
        """In a forked child, keep all that is open for ever: its end would wait for threads that only the parent has.

        At the end of the interpreter, nothing else than a reference that is never returned keeps an object.
        """
        self._lock = threading.Lock()
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(self))


domains: Final = _Domains()
os.register_at_fork(after_in_child=domains.keep)


def _config(address: Address) -> str:
    """Return the configuration of an address' domain: fragments, of which later ones override earlier ones."""
    from_environment, interface = os.environ.get("CYCLONEDDS_URI", ""), address.options.get("interface")
    if interface is None:
        return f"{_TUNING},{from_environment or LOOPBACK}"
    if from_environment:
        text = f"{address}: CYCLONEDDS_URI is set, which names the interfaces. Leave interface= out, or unset it."
        raise AddressError(str(address), text)
    if not re.fullmatch(r"[\w.:-]+", interface, re.ASCII):
        text = f"{address}: interface is the name or the address of a network interface, not {interface!r}."
        raise AddressError(str(address), text)
    kind = "address" if re.fullmatch(r"[\d.]+|.*:.*", interface) else "name"
    named = f'<NetworkInterface {kind}="{interface}"/>'
    return f"{_TUNING},<CycloneDDS><Domain><General><Interfaces>{named}</Interfaces></General></Domain></CycloneDDS>"


def _open_domain(address: Address, number: int, config: str) -> tuple[Any, Any]:
    """Return a participant of a domain, and the domain."""
    bytearray(_LARGE_BLOCK_BYTES)
    domain = None
    try:
        try:
            domain = Domain(number, config)
        except DDSException as error:
            # The program itself uses Cyclone DDS: its configuration counts.
            if error.code != DDSException.DDS_RETCODE_PRECONDITION_NOT_MET:
                raise
        return DomainParticipant(number), domain
    except DDSException as error:
        by, way_out = "as CYCLONEDDS_URI says", "Cyclone DDS writes why to the standard error."
        if not os.environ.get("CYCLONEDDS_URI"):
            interfaces = ", ".join(name for _, name in socket.if_nameindex())
            by, way_out = "on this network interface", f"This machine has the interfaces {interfaces}. {way_out}"
        text = f"{address} can't be opened {by}: {error}. {way_out}"
        raise BrokerError(str(address), text) from error


def qos_of(address: Address, is_reader: bool) -> Qos:
    """Return the quality of service that an address asks for."""
    options, durability = address.options, address.options.get("durability")
    depth = int(options.get("history", _READER_HISTORY if is_reader else _WRITER_HISTORY))
    if not 0 < depth <= _MOST_HISTORY:
        text = f"{address}: history is a number of messages from 1 to {_MOST_HISTORY:,}, not {depth:,}."
        raise AddressError(str(address), text)
    history, best_effort = Policy.History.KeepLast(depth), options.get("reliability") == "best_effort"
    # For late joiners the newest, unless the address says otherwise.
    for_late_joiners = history if "history" in options else Policy.History.KeepLast(1)
    policies = [
        Policy.Reliability.BestEffort if best_effort else Policy.Reliability.Reliable(duration(seconds=_BLOCKED_S)),
        Policy.Durability.TransientLocal if durability == "transient_local" else Policy.Durability.Volatile,
        history,
        Policy.DurabilityService(0, for_late_joiners, -1, -1, -1),
        Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),
    ]
    for name, make in (("deadline", Policy.Deadline), ("lease", Policy.Liveliness.Automatic)):
        if name in options:
            if not float(options[name]):
                raise AddressError(str(address), f"{address}: {name} is a number of seconds above 0.")
            policies.append(make(duration(seconds=float(options[name]))))
    return Qos(*policies)


def describe(policy: Any) -> str:
    """Return a policy as an address has it."""
    time_ns = getattr(policy, "deadline", getattr(policy, "lease_duration", None))
    if time_ns is not None:
        return "none" if time_ns == duration(infinite=True) else f"{time_ns / 1e9:g} s"
    return re.sub("(?<=[a-z])(?=[A-Z])", "_", type(policy).__name__.rpartition(".")[2]).lower()
