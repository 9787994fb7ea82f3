"""Where do the keys come from by which two machines know each other? From files, made once (CURVE, RFC 26).

A pair is two files, as ``zmq.auth`` writes them: ``NAME.key`` with the public key, which others may have, and
``NAME.key_secret`` with both, which only its owner can read.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from epypes.errors import KeysError
from epypes.optional import optional_import

_LINE = re.compile(r'^\s*(public|secret)-key\s*=\s*"([^"\n]*)"\s*$', re.MULTILINE)
# Z85 of 32 bytes.
_KEY = re.compile(r"[0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")
_OTHERS = 0o077


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
Options = Sequence[tuple[int, int | bytes]]


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
    with optional_import():
        import zmq

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


def server_options(keys: Keys, domain: bytes) -> Options:
    """Return ZeroMQ's options for a socket that is bound with keys; a gate must know its domain."""
    with optional_import():
        import zmq

    return [
        (zmq.CURVE_SERVER, 1),
        (zmq.CURVE_SECRETKEY, keys.secret.encode()),
        (zmq.ZAP_DOMAIN, domain),
        # Without it everybody would be let in while nobody answers for the domain.
        (zmq.ZAP_ENFORCE_DOMAIN, 1),
    ]


def client_options(keys: Keys, server: str) -> Options:
    """Return ZeroMQ's options for a socket that connects to one with the public key ``server``."""
    with optional_import():
        import zmq

    return [
        (zmq.CURVE_SERVERKEY, server.encode()),
        (zmq.CURVE_PUBLICKEY, keys.public.encode()),
        (zmq.CURVE_SECRETKEY, keys.secret.encode()),
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
