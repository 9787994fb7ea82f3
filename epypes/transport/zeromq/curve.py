"""CURVE security of ZeroMQ sockets: key files, the peers that are allowed, and the options of a socket (RFC 26, 27).

A pair of keys is two files, as ``zmq.auth`` writes them: ``NAME.key`` with the public key, which others may have, and
``NAME.key_secret`` with both, which only its owner can read.
"""

from __future__ import annotations

import logging
import os
import re
import uuid
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import zmq
from zmq.utils import z85

from epypes.errors import KeysError
from epypes.transport.address import check_bind

log = logging.getLogger("epypes.transport")

_LINE = re.compile(r'^\s*(public|secret)-key\s*=\s*"([^"\n]*)"\s*$', re.MULTILINE)
# Z85 of 32 bytes.
_KEY = re.compile(r"[0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")
_OTHERS = 0o077
_ZAP_ADDRESS: Final = "inproc://zeromq.zap.01"
_BATCH: Final = 100
# Unknown keys that are counted one by one; a peer that makes keys must not fill the memory.
_MOST_UNKNOWN: Final = 1_024


@dataclass(frozen=True, slots=True)
class Keys:
    """A pair of CURVE keys, each 40 characters of Z85.

    Attributes
    ----------
    public
        What others may know.
    secret
        What they must not; it is in no repr.
    """

    public: str
    secret: str = field(repr=False)


# A public key, a file that has one, or a folder of such files.
PublicKey = str | Path | Keys


def make_keys(path: str | Path) -> Keys:
    """Make a new pair and write it: ``path`` with the ending .key, and .key_secret with mode 0600.

    Parameters
    ----------
    path
        ``"keys/camera"`` makes ``keys/camera.key`` and ``keys/camera.key_secret``; the folder is made.

    Raises
    ------
    KeysError
        If one of the files exists already, or can't be written.
    """
    public, secret = (key.decode() for key in zmq.curve_keypair())
    stem = _stem(Path(path))
    try:
        stem.parent.mkdir(parents=True, exist_ok=True)
        _write(stem.with_name(f"{stem.name}.key_secret"), _text(public, secret), 0o600)
        _write(stem.with_name(f"{stem.name}.key"), _text(public), 0o644)
    except FileExistsError as error:
        raise KeysError(error.filename, f"{error.filename} exists. Take another name, or move it away.") from error
    except OSError as error:
        raise KeysError(path, f"No keys can be written to {path}: {error.strerror}.") from error
    return Keys(public, secret)


def read_keys(path: str | Path) -> Keys:
    """Return the pair of a .key_secret file; the ending may be left out.

    Raises
    ------
    KeysError
        If it can't be read, has no pair in it, or if others can read it.
    """
    stem = _stem(Path(path))
    file = stem.with_name(f"{stem.name}.key_secret")
    found = _read(file)
    if os.name == "posix" and file.stat().st_mode & _OTHERS:
        raise KeysError(file, f"Others can read the secret key {file}. Say: chmod 600 {file}")
    if "secret" not in found:
        raise KeysError(file, f"{file} has no secret key. epypes.transport.make_keys makes a pair.")
    return Keys(found["public"], found["secret"])


def public_keys(given: PublicKey | Collection[PublicKey]) -> frozenset[str]:
    """Return the public keys that are meant by keys, pairs, .key files and folders of .key files.

    Raises
    ------
    KeysError
        If one is none of these.
    """
    several = (given,) if isinstance(given, str | Path | Keys) else given
    return frozenset(key for each in several for key in _public(each))


def _public(given: PublicKey) -> list[str]:
    if isinstance(given, Keys):
        return [given.public]
    if isinstance(given, str) and _KEY.fullmatch(given):
        return [given]
    if not isinstance(given, str | Path):
        raise KeysError("", f"{given!r:.60} is no public key. Give its 40 characters, a .key file or a folder of them.")
    path = Path(given)
    files = sorted(path.glob("*.key")) if path.is_dir() else [path]
    return [_read(file)["public"] for file in files]


class AllowList:
    """The keys that may connect to one socket; a peer with another key is refused and counted.

    Parameters
    ----------
    allowed
        Public keys.
    refused
        Gets the counts of refused peers, by public key.

    Attributes
    ----------
    domain
        The socket's ZAP domain, by which ZeroMQ names it.
    """

    def __init__(self, allowed: Collection[str], refused: Counter[str]) -> None:
        self.domain = uuid.uuid4().hex.encode()
        self._allowed, self._refused = frozenset(allowed), refused

    def admits(self, mechanism: bytes, credentials: list[bytes]) -> bool:
        """Return whether a peer may connect; count it if it may not."""
        key = "no key"
        if mechanism == b"CURVE" and len(credentials) == 1 and len(credentials[0]) == 32:
            key = z85.encode(credentials[0]).decode()
        if key in self._allowed:
            return True
        known = key in self._refused or len(self._refused) < _MOST_UNKNOWN
        self._refused[key if known else "others"] += 1
        if self._refused[key] == 1:
            log.warning("refused a peer with the unknown key %s; to let it in, add it to allow=", key)
        return False


class ZapHandler:
    """Answers ZeroMQ, on the I/O thread, whether a peer may connect to a guarded socket of a context.

    Attributes
    ----------
    allow_lists
        Of the guarded sockets, by ZAP domain.
    descriptor
        Readable when there is something for `read`.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        self.allow_lists: dict[bytes, AllowList] = {}
        self._socket: zmq.Socket[bytes] = context.socket(zmq.REP)
        self._socket.linger = 0
        self._socket.bind(_ZAP_ADDRESS)
        self.descriptor = int(self._socket.get(zmq.FD))

    def close(self) -> None:
        """Close the socket; ZeroMQ lets any peer in from then on, so no guarded socket may be left."""
        self._socket.close()

    def read(self) -> bool:
        """Answer some requests; return whether there may be more."""
        for _ in range(_BATCH):
            if self._socket.closed:
                return False
            try:
                request = self._socket.recv_multipart(zmq.DONTWAIT)
            except zmq.Again:
                return False
            version, number, domain, _, _, mechanism, *credentials = request
            allow_list = self.allow_lists.get(domain)
            ok = allow_list is not None and allow_list.admits(mechanism, credentials)
            status = [b"200", b"OK"] if ok else [b"400", b"This key is not on the list"]
            self._socket.send_multipart([version, number, *status, b"", b""], zmq.DONTWAIT)
        return True


@dataclass(frozen=True, slots=True)
class CurveOptions:
    """The security of one address.

    Attributes
    ----------
    keys
        Its own pair; None to go without.
    allowed
        Public keys of its peers: those that may connect if it is bound, the one that it connects to otherwise.
    bind
        Whether it is bound.
    refused
        How often peers were refused, by their public key.
    """

    keys: Keys | None
    allowed: frozenset[str]
    bind: bool
    refused: Counter[str] = field(default_factory=Counter)

    @classmethod
    def checked(
        cls,
        address: str,
        bind: bool,
        insecure: bool = False,
        keys: Keys | str | Path | None = None,
        allow: PublicKey | Collection[PublicKey] | None = None,
    ) -> CurveOptions:
        """Return the security that a user asked for.

        Raises
        ------
        AddressError
            An address that other machines can reach is to be bound without keys, and not ``insecure``.
        KeysError
            Keys can't be read, or there is no list of allowed keys.
        """
        if bind:
            check_bind(address, insecure or keys is not None)
        if keys is None:
            if allow is not None:
                text = f"allow= was given for {address}, but no keys. Give keys= as well: make_keys makes them."
                raise KeysError("", text)
            return cls(None, frozenset(), bind)
        own = keys if isinstance(keys, Keys) else read_keys(keys)
        if allow is None:
            text = f"Keys were given for {address}, but not whose are allowed. Give the peers' .key files: allow="
            raise KeysError("", text)
        allowed = public_keys(allow)
        if not bind and len(allowed) != 1:
            text = f"{address} is connected to, so allow= must be the public key of the one that is bound there."
            raise KeysError("", f"{text} {len(allowed)} were given.")
        return cls(own, allowed, bind)

    def socket_options(self) -> tuple[AllowList | None, Sequence[tuple[int, int | bytes]]]:
        """Return the options of a new socket, and its list of allowed keys if it is bound with keys."""
        if self.keys is None:
            return None, ()
        secret = self.keys.secret.encode()
        if not self.bind:
            (server,) = self.allowed
            return None, [
                (zmq.CURVE_SERVERKEY, server.encode()),
                (zmq.CURVE_PUBLICKEY, self.keys.public.encode()),
                (zmq.CURVE_SECRETKEY, secret),
            ]
        allow_list = AllowList(self.allowed, self.refused)
        return allow_list, [
            (zmq.CURVE_SERVER, 1),
            (zmq.CURVE_SECRETKEY, secret),
            (zmq.ZAP_DOMAIN, allow_list.domain),
            # Without it any peer would be let in while no handler answers for the domain.
            (zmq.ZAP_ENFORCE_DOMAIN, 1),
        ]


def _stem(path: Path) -> Path:
    return path.with_suffix("") if path.suffix in {".key", ".key_secret"} else path


def _text(public: str, secret: str = "") -> str:
    kind = "SECRET key: keep it on this machine" if secret else "public key: give it to the other machines"
    more = f'    secret-key = "{secret}"\n' if secret else ""
    return f'#   ZeroMQ CURVE {kind}\n\nmetadata\ncurve\n    public-key = "{public}"\n{more}'


def _write(path: Path, text: str, mode: int) -> None:
    # With its mode from the first moment; a chmod afterwards would come too late.
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    with os.fdopen(descriptor, "w", encoding="ascii") as file:
        file.write(text)


def _read(path: Path) -> dict[str, str]:
    try:
        found = dict(_LINE.findall(path.read_text("utf-8")))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is no text"
        raise KeysError(
            path, f"No key can be read from {path}: {reason}. epypes.transport.make_keys makes one."
        ) from error
    if "public" not in found or not all(_KEY.fullmatch(key) for key in found.values()):
        raise KeysError(path, f"{path} is no key file. epypes.transport.make_keys makes one.")
    return found
