"""Who may change a running service? Whoever knows its token: 32 random bytes in a file that only its owner reads."""

from __future__ import annotations

import os
import re
import secrets
from contextlib import suppress
from hmac import compare_digest
from pathlib import Path
from typing import Final

from epypes.errors import KeysError

_OTHERS: Final = 0o077
_BYTES: Final = 32
# What can stand in a header and an address without quoting; 22 characters of it hold 128 bits.
_TOKEN: Final = re.compile(r"[\w.~+/=-]{22,512}", re.ASCII)


def owned_token(path: Path) -> str:
    """Return the token of a file, which is made if it isn't there.

    Raises
    ------
    KeysError
        It can't be read or made, has no token in it, or others can read it.
    """
    try:
        with suppress(FileNotFoundError):
            return _read(path)
        with suppress(FileExistsError):
            _make(path)
        return _read(path)
    except (OSError, UnicodeDecodeError) as error:
        text = f"The token file {path} can't be used: {getattr(error, 'strerror', '') or error}. Name another."
        raise KeysError(path, text) from error


def _read(path: Path) -> str:
    with path.open(encoding="ascii") as file:
        if os.fstat(file.fileno()).st_mode & _OTHERS:
            raise KeysError(path, f"Others can read the token in {path}. Say: chmod 600 {path}")
        token = file.read(1_000).strip()
    if not _TOKEN.fullmatch(token):
        text = f"{path} holds no token: 22 letters and digits or more, in one line. Remove it, and one is made."
        raise KeysError(path, text)
    return token


def _make(path: Path) -> None:
    """Write a new token; whoever reads the file sees all of it or no file."""
    draft = path.with_name(f".{path.name}-{secrets.token_hex(8)}")
    descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        with open(descriptor, "w", encoding="ascii") as file:
            file.write(secrets.token_urlsafe(_BYTES) + "\n")
        # Unlike a renaming, a link does not replace a token that another process has just made.
        os.link(draft, path)
    finally:
        draft.unlink()


def is_bearer(authorization: bytes, token: str) -> bool:
    """Whether an Authorization header has this token; it takes as long whatever the header says."""
    scheme, _, given = authorization.partition(b" ")
    return compare_digest(given.strip(), token.encode("ascii")) and scheme.lower() == b"bearer"
