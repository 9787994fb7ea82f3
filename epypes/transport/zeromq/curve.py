"""CURVE security of ZeroMQ sockets: key files, the peers that are allowed, and the options of a socket (RFC 26, 27).

A pair of keys is two certificates of ``zmq.auth``: ``NAME.key`` with the public key, which others may have, and
``NAME.key_secret`` with both, which only its owner can read.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import tempfile
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

# Z85 of 32 bytes.
_KEY = re.compile(r"[0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")
_OTHERS = 0o077
_ZAP_ADDRESS: Final = "inproc://zeromq.zap.01"
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
    from zmq.auth import create_certificates

    stem = _stem(Path(path))
    try:
        stem.parent.mkdir(parents=True, exist_ok=True)
        # zmq.auth replaces files, and lets others read the secret key: so it writes into a folder of this user alone.
        with tempfile.TemporaryDirectory(dir=stem.parent) as private, contextlib.ExitStack() as undo:
            public, secret = map(Path, create_certificates(private, stem.name))
            secret.chmod(0o600)
            for file in (secret, public):
                place = stem.with_name(file.name)
                place.touch(exist_ok=False)
                undo.callback(place.unlink)
                file.replace(place)
            undo.pop_all()
    except FileExistsError as error:
        raise KeysError(error.filename, f"{error.filename} exists. Take another name, or move it away.") from error
    except OSError as error:
        raise KeysError(path, f"No keys can be written to {path}: {error.strerror}.") from error
    return read_keys(stem)


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
    if not found.secret:
        raise KeysError(file, f"{file} has no secret key. epypes.transport.make_keys makes a pair.")
    return found


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
    return [_read(file).public for file in files]


class ZapHandler:
    """Answers ZeroMQ, on the I/O thread, whether a peer may connect to a guarded socket of a context (RFC 27).

    Attributes
    ----------
    guarded
        The options of the guarded sockets, by ZAP domain.
    socket
        Readable when there is a request for `read`.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        self.guarded: dict[bytes, CurveOptions] = {}
        self.socket: zmq.Socket[bytes] = context.socket(zmq.REP)
        self.socket.linger = 0
        self.socket.bind(_ZAP_ADDRESS)

    def read(self) -> bool:
        """Answer one request; always returns False."""
        version, number, domain, _, _, _, *credentials = self.socket.recv_multipart(zmq.DONTWAIT)
        options = self.guarded.get(domain)
        ok = options is not None and options.admits(credentials)
        status = [b"200", b"OK"] if ok else [b"400", b"This key is not on the list"]
        self.socket.send_multipart([version, number, *status, b"", b""], zmq.DONTWAIT)
        return False


@dataclass(frozen=True, slots=True, eq=False)
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
    domain
        Of the socket in ZAP, by which ZeroMQ names it.
    """

    keys: Keys | None
    allowed: frozenset[str]
    bind: bool
    refused: Counter[str] = field(default_factory=Counter)
    domain: bytes = field(default_factory=lambda: uuid.uuid4().hex.encode())

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

    @property
    def is_guarded(self) -> bool:
        """Whether ZeroMQ asks which peers may connect."""
        return self.bind and self.keys is not None

    def admits(self, credentials: Sequence[bytes]) -> bool:
        """Return whether the peer with a key of 32 bytes may connect; count it if it may not."""
        key = z85.encode(b"".join(credentials)).decode()
        if key in self.allowed:
            return True
        known = key in self.refused or len(self.refused) < _MOST_UNKNOWN
        self.refused[key if known else "others"] += 1
        if self.refused[key] == 1:
            log.warning("refused a peer with the unknown key %s; to let it in, add it to allow=", key)
        return False

    def socket_options(self) -> Sequence[tuple[int, int | bytes]]:
        """Return the options of a new socket."""
        if self.keys is None:
            return ()
        secret = (zmq.CURVE_SECRETKEY, self.keys.secret.encode())
        if not self.bind:
            (server,) = self.allowed
            return [
                (zmq.CURVE_SERVERKEY, server.encode()),
                (zmq.CURVE_PUBLICKEY, self.keys.public.encode()),
                secret,
            ]
        # Without ZAP_ENFORCE_DOMAIN any peer would be let in while no handler answers for the domain.
        return [(zmq.CURVE_SERVER, 1), secret, (zmq.ZAP_DOMAIN, self.domain), (zmq.ZAP_ENFORCE_DOMAIN, 1)]


def _stem(path: Path) -> Path:
    if not path.name:
        raise KeysError(path, f"{path} names no keys. Give a name: {path / 'camera'}")
    return path.with_suffix("") if path.suffix in {".key", ".key_secret"} else path


def _read(path: Path) -> Keys:
    """Return the keys of a file; the secret one is empty if the file has none."""
    # Imported here, since it takes 10 ms, and few sockets have keys.
    from zmq.auth import load_certificate

    try:
        keys = [(key or b"").decode("ascii", "replace") for key in load_certificate(path)]
    except OSError as error:
        text = f"No key can be read from {path}: {error.strerror or 'there is no such file'}."
        raise KeysError(path, f"{text} epypes.transport.make_keys makes one.") from error
    except (ValueError, IndexError):  # the latter for a line that has no value
        keys = [""]
    if not _KEY.fullmatch(keys[0]) or not all(_KEY.fullmatch(key) for key in keys if key):
        raise KeysError(path, f"{path} is no key file. epypes.transport.make_keys makes one.")
    return Keys(*keys)
