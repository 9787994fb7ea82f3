"""Which place of which broker does an address name?"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Literal, get_args
from urllib.parse import SplitResult, parse_qsl, quote, unquote, urlsplit

from epypes.errors import AddressError
from epypes.transport.address import is_loopback_host

Kind = Literal["queue", "broadcast", "log"]
KINDS: Final = get_args(Kind)
PORTS: Final[Mapping[str, int]] = {
    "amqp": 5672,
    "amqps": 5671,
    "nats": 4222,
    "tls": 4222,
    "mqtt": 1883,
    "mqtts": 8883,
    "memory": 0,
}
ENCRYPTED_AS: Final[Mapping[str, str]] = {"amqp": "amqps", "nats": "tls", "mqtt": "mqtts"}
ATTEMPTS: Final = 3
_OPTIONS: Final = ("attempts", "ca", "create", "dead", "group", "kind", "password_file", "vhost")
# Who of ZeroMQ's does what the other one does otherwise.
_SIDES: Final = ("", "bind", "connect")
_FORM: Final = (
    "Write amqp://HOST/QUEUE, nats://HOST/SUBJECT or mqtt://HOST/TOPIC, with USER:PASSWORD@ before HOST, :PORT behind "
    "it and ?create=true at the end as needed; or tcp://127.0.0.1:5555 for ZeroMQ."
)
_SIGNS: Final = "In a user, a password or a name write %2F for /, %3F for ?, %40 for @, %5B for [ and %5D for ]."
_CONTROL: Final = re.compile(r"[\x00-\x1f\x7f-\x9f]")
_WORDS: Final[Mapping[str, bool]] = {"true": True, "1": True, "yes": True, "false": False, "0": False, "no": False}


@dataclass(frozen=True, slots=True)
class Place:
    """A queue, a broadcast or a log at a broker.

    Attributes
    ----------
    scheme, host, port
        Who the broker is.
    user, password
        The credentials; empty without.
    name
        Of the queue (RabbitMQ), the subject (NATS) or the topic (MQTT); for ZeroMQ the whole address.
    kind
        ``"queue"``: each message goes to one receiver and is kept until that has acknowledged it. ``"broadcast"``:
        each goes to all who listen just then, and is not kept. ``"log"``: all are kept, in one order, and every
        receiver gets all of them from the first on. MQTT has neither queues nor logs: what comes nearest, and what may
        be lost on the way, says `epypes.transport.channels.mqtt.channel`.
    create
        Whether the broker is to make it if there is none; otherwise that is an error.
    attempts
        How often a message of a queue is delivered at most, before it is a dead letter; MQTT does not count.
    dead
        The name of the queue for dead letters; ``NAME.dead`` (``NAME/dead`` for MQTT) unless given.
    group
        Who shares a queue, for NATS (the durable consumer) and MQTT (the shared subscription); RabbitMQ needs none.
    vhost
        RabbitMQ's virtual host.
    ca
        The file of the certificates that an encrypted broker is checked by; the system's without.
    password_file
        The file that the password was read from; empty if it was in the address.
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

    def __str__(self) -> str:
        """Return the address without the password: for people, logs and state files."""
        if self.scheme in ("tcp", "ipc"):
            return self.name
        user = f"{quote(self.user, safe='')}@" if self.user else ""
        host = f"[{self.host}]" if ":" in self.host else self.host
        port = f":{self.port}" if self.port else ""
        kind = "" if self.kind == "queue" else f"?kind={self.kind}"
        return f"{self.scheme}://{user}{host}{port}/{quote(self.name, safe='/.-_~$#+*>')}{kind}"

    @property
    def is_encrypted(self) -> bool:
        """Whether what is sent can't be read on the way."""
        return self.scheme in ENCRYPTED_AS.values()

    @property
    def is_on_this_machine(self) -> bool:
        """Whether the broker runs on this machine."""
        return self.scheme in ("ipc", "memory") or is_loopback_host(self.host)

    @property
    def refused_way_out(self) -> str:
        """What helps when a broker refuses the user or the password: a sentence."""
        if not self.user and self.password_file:
            return f"Write USER@ before the host; the password was read from {self.password_file}."
        if self.password_file:
            return f"The password was read from {self.password_file}: mend that file, or the user before the host."
        if self.user and self.password:
            return "Mend the user or the password before the host; ?password_file=PATH keeps the latter out of sight."
        return "Write USER@ before the host, and the path of a file with the password at the end: ?password_file=PATH."

    def beside(self, ending: str, kind: Kind, *, create: bool | None = None) -> Place:
        """Return another place of the same broker, of this one's name and an ending."""
        joint = "/" if self.scheme.startswith("mqtt") else "."
        made = self.create if create is None else create
        return replace(self, name=f"{self.name}{joint}{ending}", kind=kind, create=made, dead="")

    @property
    def dead_letters(self) -> Place:
        """Where what was rejected is put."""
        return replace(self, name=self.dead, kind="queue", dead="") if self.dead else self.beside("dead", "queue")


def place_of(address: str | Place) -> Place:
    """Return what an address names: ``SCHEME://[USER[:PASSWORD]@]HOST[:PORT]/NAME[?OPTION=VALUE&...]``.

    Parameters
    ----------
    address
        Of RabbitMQ (``amqp``, encrypted ``amqps``), NATS (``nats``, encrypted ``tls``), MQTT (``mqtt``, encrypted
        ``mqtts``), ZeroMQ (``tcp``, ``ipc``; ``connect:`` before it has who sends connect, ``bind:`` who receives
        bind) or a broker within this process, for tests (``memory``). A Place is returned as it is.

        The options, each an attribute of `Place`: ``create=true``, ``attempts=3``, ``dead=NAME``, ``group=NAME``,
        ``kind=queue`` (or ``broadcast``, ``log``), ``vhost=NAME``, ``ca=FILE``, ``password_file=FILE``. Between two of
        them is an ``&``, which a shell takes for its own: quote the address there.

    Raises
    ------
    AddressError
        It can't be understood; the text never has the password in it.

    Examples
    --------
    >>> place_of("amqp://robot:secret@127.0.0.1/events?create=true")
    Place(scheme='amqp', host='127.0.0.1', port=5672, name='events', user='robot', kind='queue', create=True, ...)

    A broker with a certificate of the house, at which an event is delivered five times at most:

    >>> place = place_of("amqps://robot@broker.lab/events?ca=/etc/lab.pem&attempts=5")
    >>> place.ca, place.attempts
    ('/etc/lab.pem', 5)

    Who of NATS shares the events, and where what can't be answered is put:

    >>> place = place_of("nats://127.0.0.1/frames?create=true&group=edges&dead=frames.rejected")
    >>> place.group, place.dead_letters.name
    ('edges', 'frames.rejected')

    What goes to all who listen just then:

    >>> place_of("mqtt://127.0.0.1/camera/1?kind=broadcast").kind
    'broadcast'
    """
    if isinstance(address, Place):
        return address
    scheme, found, _ = address.partition("://") if isinstance(address, str) else (type(address).__name__, "", "")
    side, _, plain = scheme.rpartition(":")
    if found and plain in ("tcp", "ipc") and side in _SIDES:
        return Place(plain, address.partition("://")[2].rpartition(":")[0], 0, address, kind="broadcast")
    if not found or scheme not in PORTS:
        # What comes behind it may be a password.
        scheme = scheme.partition(":")[0]
        raise AddressError(scheme, f"{scheme!r} is not the beginning of an address that EPypes knows. {_FORM}")
    parts = _split(scheme, address)
    options = _options(scheme, parts.query)
    name, port = unquote(parts.path.removeprefix("/")), parts.port
    if not parts.hostname or not name:
        missing = "host" if not parts.hostname else "name behind the host: a queue, subject or topic"
        raise AddressError(scheme, f"An address of {scheme} has no {missing}. {_FORM}")
    if _CONTROL.search(name):
        raise AddressError(scheme, f"The name in an address of {scheme} has control characters in it: {name!r}.")
    user, password = unquote(parts.username or ""), unquote(parts.password or "")
    given = {key: value for key, value in options.items() if key != "password_file"}
    place = Place(scheme, parts.hostname, PORTS[scheme] if port is None else port, name, user, password)
    return _with_options(place, given, options.get("password_file", ""))


def _split(scheme: str, address: str) -> SplitResult:
    """Return the parts of an address. What is wrong with it is not quoted, since a password may be in it."""
    # It has no fragments, and # is a sign of MQTT's topics.
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
    text = f"An address of {scheme} can't be understood: {wrong}. {_FORM} {_SIGNS}"
    raise AddressError(scheme, text)


def _options(scheme: str, query: str) -> dict[str, str]:
    options = dict(parse_qsl(query, keep_blank_values=True))
    unknown = sorted(set(options) - set(_OPTIONS))
    if unknown:
        text = f"An address of {scheme} has no option {', '.join(unknown)}. There are: {', '.join(_OPTIONS)}."
        raise AddressError(scheme, text)
    return options


def _with_options(place: Place, options: Mapping[str, str], password_file: str) -> Place:
    changes: dict[str, object] = dict(options)
    if "kind" in options and options["kind"] not in KINDS:
        raise AddressError(str(place), f"{place} can't be of kind {options['kind']!r}. Take {', '.join(KINDS)}.")
    if "create" in options:
        if options["create"] not in _WORDS:
            raise AddressError(str(place), f"create is true or false, not {options['create']!r}, in {place}.")
        changes["create"] = _WORDS[options["create"]]
    if "attempts" in options:
        if not options["attempts"].isdecimal() or int(options["attempts"]) < 1:
            raise AddressError(
                str(place), f"attempts is a whole number from 1, not {options['attempts']!r}, in {place}."
            )
        changes["attempts"] = int(options["attempts"])
    if password_file:
        changes["password"] = _read_password(place, Path(password_file))
        changes["password_file"] = password_file
    return replace(place, **changes)  # type: ignore[arg-type]  # each was checked above


def _read_password(place: Place, path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8").rstrip("\r\n")
    except (OSError, ValueError) as error:
        # ValueError: it is no text, or its path none.
        text = f"The password for {place} can't be read from {path}: {getattr(error, 'strerror', None) or error}."
        raise AddressError(str(place), text) from error
