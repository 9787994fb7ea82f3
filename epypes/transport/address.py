"""Addresses: where messages are sent to and received from, for every scheme.

`parse_address` reads the text that users write. Neither the text of an `Address` nor an error has
the password in it.
"""

from __future__ import annotations

import errno
import importlib
import ipaddress
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Literal, NamedTuple, get_args
from urllib.parse import SplitResult, parse_qsl, quote, unquote, urlencode, urlsplit

from epypes.errors import AddressError, install_command
from epypes.optional import NO_WHEEL_FROM
from epypes.transport.channel import Channel, ChannelOptions

Kind = Literal["queue", "broadcast", "log"]
KINDS: Final = get_args(Kind)
ATTEMPTS: Final = 3
# Of brokers.
_OPTIONS: Final = ("attempts", "ca", "create", "dead", "group", "kind", "password_file", "vhost")


class Scheme(NamedTuple):
    """What EPypes knows about the scheme of an address."""

    module: str
    extra: str
    port: int = 0
    is_broker: bool = True
    encrypted_as: str = ""
    options: tuple[str, ...] = _OPTIONS

    @property
    def is_zeromq(self) -> bool:
        """Whether its addresses are endpoints of ZeroMQ."""
        return self.module == "zeromq.channel"


# To add a broker: an entry here, and a module with ``make_channel`` and a `brokers.channel.BrokerSession`. To add a
# middleware without a broker: likewise, with a `peers.channel.PeerSession`.
SCHEMES: Final[Mapping[str, Scheme]] = {
    "amqp": Scheme("brokers.amqp", "rabbitmq", 5672, encrypted_as="amqps"),
    "amqps": Scheme("brokers.amqp", "rabbitmq", 5671),
    "nats": Scheme("brokers.nats", "nats", 4222, encrypted_as="tls"),
    "tls": Scheme("brokers.nats", "nats", 4222),
    "mqtt": Scheme("brokers.mqtt", "mqtt", 1883, encrypted_as="mqtts"),
    "mqtts": Scheme("brokers.mqtt", "mqtt", 8883),
    "memory": Scheme("memory", ""),
    "dds": Scheme(
        "peers.dds",
        "dds",
        is_broker=False,
        options=("deadline", "durability", "history", "interface", "lease", "reliability", "token", "type"),
    ),
    "zenoh": Scheme(
        "peers.zenoh",
        "zenoh",
        is_broker=False,
        options=("ca", "congestion", "domain", "password_file", "priority", "token", "type"),
    ),
    "tcp": Scheme("zeromq.channel", "serve", is_broker=False),
    "ipc": Scheme("zeromq.channel", "serve", is_broker=False),
    "inproc": Scheme("zeromq.channel", "serve", is_broker=False),
}
_ENCRYPTED: Final = tuple(known.encrypted_as for known in SCHEMES.values() if known.encrypted_as)
# The options of DDS and Zenoh that are one of some words, and those that are a number: whole, or of seconds.
_WORDS: Final[Mapping[str, tuple[str, ...]]] = {
    "congestion": ("drop", "block"),
    "durability": ("volatile", "transient_local"),
    "priority": ("real_time", "interactive_high", "interactive_low", "data_high", "data", "data_low", "background"),
    "reliability": ("reliable", "best_effort"),
}
_WHOLE_NUMBERS: Final = ("domain", "history")
_SECONDS: Final = ("deadline", "lease")
# Which side of two ZeroMQ sockets binds, where it is not the publisher.
_SIDES: Final = {"bind": True, "connect": False}
_FORM: Final = (
    "Write amqp://HOST/QUEUE, nats://HOST/SUBJECT or mqtt://HOST/TOPIC, with USER:PASSWORD@ before HOST, :PORT behind "
    "it and ?create=true at the end as needed; tcp://127.0.0.1:5555 for ZeroMQ; dds://DOMAIN/TOPIC or "
    "zenoh://127.0.0.1/KEY."
)
_QUOTING: Final = "In a user, a password or a name write %2F for /, %3F for ?, %40 for @, %5B for [ and %5D for ]."
_ZEROMQ_FORM: Final = (
    "Write tcp://127.0.0.1:5555, tcp://127.0.0.1:* (a free port), ipc:///path/to/socket or inproc://name."
)
_CONTROL: Final = re.compile(r"[\x00-\x1f\x7f-\x9f]")
_BOOLEANS: Final[Mapping[str, bool]] = {
    "true": True,
    "1": True,
    "yes": True,
    "false": False,
    "0": False,
    "no": False,
}
_MAX_PORT: Final = 65_535


@dataclass(frozen=True, slots=True)
class Address:
    """A queue, a broadcast or a log at a broker; a ZeroMQ endpoint; or a topic of DDS or Zenoh.

    Attributes
    ----------
    scheme, host, port
        Where the broker listens, and its protocol. The host of DDS is the number of its domain; that of Zenoh is its
        router, or this machine without a port for the peers on it.
    user, password
        The credentials; empty without.
    name
        Of the queue (RabbitMQ), the subject (NATS), the topic (MQTT, DDS) or the key (Zenoh); for ZeroMQ the whole
        address.
    kind
        ``"queue"``: each message goes to one consumer, and is kept until that consumer has acknowledged it.
        ``"broadcast"``: each goes to all consumers that are connected just then, and is not kept. ``"log"``: all are
        kept, in one order, and every consumer gets all of them from the first on. MQTT has neither queues nor logs;
        `epypes.transport.brokers.mqtt` describes what replaces them, and what may be lost.
    create
        Whether the channel creates it if it is missing; otherwise a missing one is an error.
    attempts
        How often a message of a queue is delivered at most, before it is a dead letter; MQTT does not count.
    dead
        The name of the dead-letter queue; ``NAME.dead`` (``NAME/dead`` for MQTT) unless given.
    group
        The consumers that share a queue, for NATS (the durable consumer) and MQTT (the shared subscription); RabbitMQ
        needs none.
    vhost
        RabbitMQ's virtual host.
    ca
        The file of the certificates that an encrypted broker is checked by; the system's without.
    password_file
        The file that the password was read from; empty if it was in the address.
    options
        What DDS and Zenoh have beside these, by name; `epypes.transport.peers` describes them.
    """

    scheme: str
    host: str
    port: int
    name: str
    user: str = ""
    password: str = field(default="", repr=False)
    kind: Kind = "queue"
    create: bool = False
    attempts: int = ATTEMPTS
    dead: str = ""
    group: str = "epypes"
    vhost: str = "/"
    ca: str = ""
    password_file: str = field(default="", repr=False, compare=False)
    options: Mapping[str, str] = field(default_factory=dict, hash=False)

    def __str__(self) -> str:
        """Return the address without the password: for people, logs and state files."""
        if self.is_zeromq:
            return self.name
        user = f"{quote(self.user, safe='')}@" if self.user else ""
        host = f"[{self.host}]" if ":" in self.host else self.host
        port = f":{self.port}" if self.port else ""
        if self.is_broker:
            query = "" if self.kind == "queue" else f"?kind={self.kind}"
        else:
            # All of them: a service that is paused opens it again by this text.
            files = {name: path for name in ("ca", "password_file") if (path := getattr(self, name))}
            query = f"?{urlencode({**self.options, **files}, safe='/')}" if self.options or files else ""
        return f"{self.scheme}://{user}{host}{port}/{quote(self.name, safe='/.-_~$#+*>')}{query}"

    @property
    def is_broker(self) -> bool:
        """Whether a broker shares out the messages; those of ZeroMQ, DDS and Zenoh go from peer to peer."""
        return SCHEMES[self.scheme].is_broker

    @property
    def is_zeromq(self) -> bool:
        """Whether it is an endpoint of ZeroMQ."""
        return SCHEMES[self.scheme].is_zeromq

    @property
    def endpoint(self) -> str:
        """The endpoint of a ZeroMQ address, without ``bind:`` and ``connect:``; otherwise the address as text."""
        if not self.is_zeromq:
            return str(self)
        return self.name.partition(":")[2] if self.binds is not None else self.name

    @property
    def binds(self) -> bool | None:
        """Whether a ZeroMQ address says that it is bound or connected to; None if it says neither."""
        return _SIDES.get(self.name.partition(":")[0])

    @property
    def extra(self) -> str:
        """The extra of EPypes that brings what the scheme needs; empty if none does."""
        return SCHEMES[self.scheme].extra

    @property
    def is_encrypted(self) -> bool:
        """Whether the connection to the broker is encrypted."""
        return self.scheme in _ENCRYPTED

    @property
    def encrypted_as(self) -> str:
        """The scheme of the same broker with encryption; empty if there is none, or it is that already."""
        return SCHEMES[self.scheme].encrypted_as

    @property
    def is_on_this_machine(self) -> bool:
        """Whether the broker runs on this machine."""
        return self.scheme in ("ipc", "inproc", "memory") or is_loopback_host(self.host)

    @property
    def refused_way_out(self) -> str:
        """What helps when a broker refuses the user or the password: a sentence."""
        if not self.user and self.password_file:
            return f"Write USER@ before the host; the password was read from {self.password_file}."
        if self.password_file:
            return f"The password was read from {self.password_file}: correct that file, or the user before the host."
        if self.user and self.password:
            return (
                "Correct the user or the password before the host; ?password_file=PATH keeps the latter out of sight."
            )
        return "Write USER@ before the host, and the path of a file with the password at the end: ?password_file=PATH."

    def beside(self, ending: str, kind: Kind, *, create: bool | None = None) -> Address:
        """Return another address of the same broker, with this one's name and an ending."""
        joint = "/" if self.scheme.startswith("mqtt") else "."
        made = self.create if create is None else create
        return replace(self, name=f"{self.name}{joint}{ending}", kind=kind, create=made, dead="")

    @property
    def dead_letters(self) -> Address:
        """The dead-letter queue, where rejected messages are put; that of a dead-letter queue is itself."""
        if self.dead:
            return replace(self, name=self.dead, kind="queue", dead="")
        is_one = self.name.endswith("/dead" if self.scheme.startswith("mqtt") else ".dead")
        return self if is_one else self.beside("dead", "queue")

    @property
    def has_dead_letters(self) -> bool:
        """Whether rejected messages go into another queue; those of a dead-letter queue stay there."""
        return self.kind == "queue" and self.dead_letters.name != self.name


def parse_address(address: str | Address) -> Address:
    """Read an address: ``SCHEME://[USER[:PASSWORD]@]HOST[:PORT]/NAME[?OPTION=VALUE&...]``.

    Parameters
    ----------
    address
        Of RabbitMQ (``amqp``, encrypted ``amqps``), NATS (``nats``, encrypted ``tls``), MQTT (``mqtt``, encrypted
        ``mqtts``), ZeroMQ (``tcp``, ``ipc``, ``inproc``; with ``connect:`` before it the publisher connects, with
        ``bind:`` the subscriber binds), DDS (``dds``), Zenoh (``zenoh``) or a broker within this process, for tests
        (``memory``). An Address is returned as it is.

        The options, each an attribute of `Address`: ``create=true``, ``attempts=3``, ``dead=NAME``, ``group=NAME``,
        ``kind=queue`` (or ``broadcast``, ``log``), ``vhost=NAME``, ``ca=FILE``, ``password_file=FILE``. DDS and Zenoh
        have others, which `epypes.transport.peers` lists. Between two of them is an ``&``, which a shell takes for its
        own: quote the address there.

    Raises
    ------
    AddressError
        It can't be understood; the text never has the password in it.

    Examples
    --------
    >>> parse_address("amqp://robot:secret@127.0.0.1/events?create=true")
    Address(scheme='amqp', host='127.0.0.1', port=5672, name='events', user='robot', kind='queue', create=True, ...)

    A broker with a certificate of the house, at which an event is delivered five times at most:

    >>> address = parse_address("amqps://robot@broker.lab/events?ca=/etc/lab.pem&attempts=5")
    >>> address.ca, address.attempts
    ('/etc/lab.pem', 5)

    The group of consumers that share the events at a NATS server, and the dead-letter queue:

    >>> address = parse_address("nats://127.0.0.1/frames?create=true&group=edges&dead=frames.rejected")
    >>> address.group, address.dead_letters.name
    ('edges', 'frames.rejected')

    A topic whose messages go to all consumers that are connected just then:

    >>> parse_address("mqtt://127.0.0.1/camera/1?kind=broadcast").kind
    'broadcast'

    A topic of ROS 2 over DDS, in domain 0:

    >>> address = parse_address("dds://0/rt/image?type=sensor_msgs/msg/Image&history=5")
    >>> address.name, address.options["type"]
    ('rt/image', 'sensor_msgs/msg/Image')
    """
    if isinstance(address, Address):
        return address
    scheme, found, _ = address.partition("://") if isinstance(address, str) else (type(address).__name__, "", "")
    side, _, plain = scheme.rpartition(":")
    known = SCHEMES.get(plain)
    if found and known is not None and known.is_zeromq and side in ("", *_SIDES):
        return Address(plain, address.partition("://")[2].rpartition(":")[0], 0, address, kind="broadcast")
    if not found or scheme not in SCHEMES:
        # What comes behind it may be a password.
        scheme = scheme.partition(":")[0]
        raise AddressError(scheme, f"{scheme!r} is not the beginning of an address that EPypes knows. {_FORM}")
    parts = _split(scheme, address)
    options = _options(scheme, parts.query)
    name, port = unquote(parts.path.removeprefix("/")), parts.port
    if scheme == "dds" and not parts.hostname:
        right = f"dds://0{parts.path if name else '/rt/image'}{parts.query and f'?{parts.query}'}"
        raise AddressError(scheme, f"An address of dds has no domain: write {right}")
    if not parts.hostname or not name:
        missing = "host" if not parts.hostname else "name behind the host: a queue, subject, topic or key"
        raise AddressError(scheme, f"An address of {scheme} has no {missing}. {_FORM}")
    if _CONTROL.search(name):
        raise AddressError(scheme, f"The name in an address of {scheme} has control characters in it: {name!r}.")
    user, password = unquote(parts.username or ""), unquote(parts.password or "")
    bare = Address(scheme, parts.hostname, SCHEMES[scheme].port if port is None else port, name, user, password)
    return _with_options(bare, options)


def _split(scheme: str, address: str) -> SplitResult:
    """Split an address into its parts. The errors don't quote it, since a password may be in it."""
    # It has no fragments, and # is a wildcard of MQTT's topics.
    address = address.replace("#", "%23")
    try:
        parts = urlsplit(address)
        _ = parts.port
    except ValueError:
        wrong = "its host or its port can't be one"
    else:
        if "@" not in parts.path + parts.query or "@" in parts.netloc:
            return parts
        wrong = "it has an @ behind its host"
    text = f"An address of {scheme} can't be understood: {wrong}. {_FORM} {_QUOTING}"
    raise AddressError(scheme, text)


def _options(scheme: str, query: str) -> dict[str, str]:
    options = dict(parse_qsl(query, keep_blank_values=True))
    known = SCHEMES[scheme].options
    unknown = sorted(set(options) - set(known))
    if unknown:
        text = f"An address of {scheme} has no option {', '.join(unknown)}. There are: {', '.join(known)}."
        raise AddressError(scheme, text)
    return options


def _with_options(bare: Address, options: Mapping[str, str]) -> Address:
    changes: dict[str, object] = dict(options)
    if "kind" in options and options["kind"] not in KINDS:
        raise AddressError(str(bare), f"{bare} can't be of kind {options['kind']!r}. Take {', '.join(KINDS)}.")
    if "create" in options:
        if options["create"] not in _BOOLEANS:
            raise AddressError(str(bare), f"create is true or false, not {options['create']!r}, in {bare}.")
        changes["create"] = _BOOLEANS[options["create"]]
    if "attempts" in options:
        if not options["attempts"].isdecimal() or int(options["attempts"]) < 1:
            text = f"attempts is a whole number from 1, not {options['attempts']!r}, in {bare}."
            raise AddressError(str(bare), text)
        changes["attempts"] = int(options["attempts"])
    if options.get("password_file"):
        changes["password"] = _read_password(bare, Path(options["password_file"]))
    if not bare.is_broker:
        for name, value in options.items():
            _check_option(bare, name, value)
        own = {name: changes.pop(name) for name in options if name not in _OPTIONS}
        changes |= {"kind": "broadcast", "options": own}
    return replace(bare, **changes)  # type: ignore[arg-type]  # each was checked above


def _check_option(bare: Address, name: str, value: str) -> None:
    """Raise AddressError for an option of DDS or Zenoh that has no such value."""
    if name in _WORDS and value not in _WORDS[name]:
        wanted = f"one of {', '.join(_WORDS[name])}"
    elif name in _WHOLE_NUMBERS and not (value.isascii() and value.isdecimal()):
        wanted = "a whole number"
    elif name in _SECONDS and not re.fullmatch(r"\d{1,9}(\.\d{1,9})?", value, re.ASCII):
        wanted = "a number of seconds"
    elif name == "type" and not re.fullmatch(r"\w+(/\w+)*", value, re.ASCII):
        wanted = "the name of a type, as sensor_msgs/msg/Image"
    else:
        return
    raise AddressError(str(bare), f"{name} is {wanted}, not {value!r}, in {bare}.")


def _read_password(bare: Address, path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8").rstrip("\r\n")
    except (OSError, ValueError) as error:
        # ValueError: the content is no text, or the path is none.
        text = f"The password for {bare} can't be read from {path}: {getattr(error, 'strerror', None) or error}."
        raise AddressError(str(bare), text) from error


def scheme_of(address: str) -> Scheme | None:
    """Return the scheme of an address as it is written; None for any other, as ``bind:tcp`` and ``http``."""
    return SCHEMES.get(address.partition("://")[0])


def is_broker(address: str) -> bool:
    """Return whether an address is one of a broker, which keeps messages until they are acknowledged."""
    known = scheme_of(address)
    return known is not None and known.is_broker


def open_channel(address: str | Address, options: ChannelOptions | None = None) -> Channel:
    """Return the channel of an address; its ``open`` connects it.

    Raises
    ------
    AddressError
        The address can't be understood, or a package that it needs is not installed.
    """
    parsed = parse_address(address)
    try:
        module = importlib.import_module(f"epypes.transport.{SCHEMES[parsed.scheme].module}")
    except ModuleNotFoundError as error:
        if error.name is not None and error.name.startswith("epypes"):
            raise
        package = (error.name or "").partition(".")[0]
        first_without = NO_WHEEL_FROM.get(package)
        text = f"{parsed} needs {package}, which is not installed: {install_command(parsed.extra)}."
        if first_without is not None and sys.version_info >= first_without:
            this, before = (".".join(map(str, version)) for version in (sys.version_info[:2], first_without))
            text = f"{parsed} needs {package}, which has no wheel for Python {this}. Use a version before {before}."
        raise AddressError(str(parsed), text) from error
    made: Channel = module.make_channel(parsed, options or ChannelOptions())
    return made


def is_loopback(address: str) -> bool:
    """Return whether an address can be reached from this machine alone.

    Parameters
    ----------
    address
        Of ZeroMQ: ``"tcp://127.0.0.1:5555"``. Loopback are 127.0.0.0/8, ::1, localhost, ipc and inproc. The name of
        a network interface is not: what it stands for may change.
    """
    scheme, _, rest = address.partition("://")
    if scheme in {"ipc", "inproc"}:
        return bool(rest)
    if scheme != "tcp":
        return False
    return is_loopback_host(rest.rpartition(":")[0])


def is_loopback_host(host: str) -> bool:
    """Return whether a host, without its port, can be reached from this machine alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.removeprefix("[").removesuffix("]")).is_loopback
    except ValueError:
        return False


def check_bind(address: str, insecure: bool = False) -> None:
    """Refuse to bind where other machines could connect.

    Parameters
    ----------
    address
        The address to bind.
    insecure
        True to bind it all the same, without keys: every machine that reaches it can read and write.

    Raises
    ------
    AddressError
        If the address is no text, or is not loopback and not ``insecure``.
    """
    if not isinstance(address, str) or "://" not in address:
        raise AddressError(str(address), f"{address!r} is not an address. {_ZEROMQ_FORM}")
    if not insecure and not is_loopback(address):
        raise AddressError(
            address,
            f"{address} can be reached from other machines, which could then read and write without keys. "
            "Bind 127.0.0.1, give keys= and allow= (epypes.transport.make_keys makes keys), or say insecure=True.",
        )


def check_port(address: str) -> None:
    """Raise AddressError for a TCP port that no machine has; ZeroMQ takes 99999 for 34463."""
    port = address.rpartition(":")[2]
    if address.startswith("tcp:") and port.isdecimal() and int(port) > _MAX_PORT:
        raise AddressError(address, f"{address} has port {port}; ports go up to {_MAX_PORT}. {_ZEROMQ_FORM}")


def address_error(address: str, verb: str, number: int, reason: str) -> AddressError:
    """Return the error for an address that ZeroMQ refused.

    Parameters
    ----------
    address
        The address.
    verb
        ``"bound"`` or ``"connected"``.
    number
        ZeroMQ's errno.
    reason
        ZeroMQ's text.
    """
    if number == errno.EADDRINUSE:
        host, _, port = address.partition("://")[2].rpartition(":")
        what = f"port {port} of {host}" if host else "it"
        text = (
            f"{address} can't be {verb}: {what} is in use. Stop what uses it, or take another; "
            "tcp://127.0.0.1:* takes a free port."
        )
    elif number == errno.EADDRNOTAVAIL:
        text = f"{address} can't be {verb}: this machine has no such address. Take one of its own."
    else:
        text = f"{address} can't be {verb}: {reason}. {_ZEROMQ_FORM}"
    return AddressError(address, text)
