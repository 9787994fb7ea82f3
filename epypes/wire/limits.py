"""Limits on what a message may hold. What is beyond them is refused before anything is allocated for it."""

from __future__ import annotations

import secrets
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from epypes.errors import MessageError
from epypes.wire.instead import Path, spoken

# Counting plain hashes would collide as the keys do.
_SALT: Final = secrets.randbits(60)


@dataclass(frozen=True, slots=True)
class Limits:
    """What a decoder accepts, and what an encoder therefore makes.

    Attributes
    ----------
    total_bytes
        All frames of a message together.
    header_bytes
        The Envelope frame alone. A parsed header takes many times its bytes, so its limit is lower.
    frames
        Number of payload frames.
    parts
        Number of parts; of attributes and of timings as well.
    values
        Number of values in the Envelope, those in lists and mappings counted too.
    keys
        Number of mapping keys and set items in a message that are neither str nor bytes. Python hashes those two with
        a secret; a peer can choose other keys so that building the dict or the set takes quadratic time.
    equal_hashes
        Number of such keys with one hash in one mapping or set. A few collide in honest data: hash(-1) == hash(-2),
        so the eight tuples over these two numbers share one hash.
    depth
        Containers within containers. Protobuf parsers stop at 100 messages within each other, and a mapping takes
        three of them.
    """

    total_bytes: int = 256 * 1024**2
    header_bytes: int = 16 * 1024**2
    frames: int = 1024
    parts: int = 1024
    values: int = 1_000_000
    keys: int = 16_384
    equal_hashes: int = 64
    depth: int = 24


DEFAULT_LIMITS = Limits()


class KeyCheck:
    """Checks the mapping keys and set items of one message against `Limits.keys` and `Limits.equal_hashes`."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._count = 0

    def for_container(self, path: Path) -> Callable[[object], None]:
        """Return what checks each key of a new mapping or set, before it is inserted.

        It raises MessageError of reason ``"bad key"`` for what can't be hashed, ``"too many keys"`` or
        ``"colliding keys"``.
        """
        hashes: Counter[int] = Counter()

        def check(key: object) -> None:
            if type(key) is str or type(key) is bytes:
                return
            try:
                salted = hash((_SALT, hash(key)))
            except TypeError as error:
                text = f"{spoken(path)} has a key or an item that can't be one: {error}."
                raise MessageError("bad key", text) from error
            self._count += 1
            hashes[salted] += 1
            if self._count > self._limits.keys:
                text = f"{spoken(path)} exceeds {self._limits.keys:,} keys and set items that are not text."
                raise MessageError("too many keys", f"{text} Use text as keys, a numpy array or a table.")
            if hashes[salted] > self._limits.equal_hashes:
                text = f"{spoken(path)} has more than {self._limits.equal_hashes} keys or items with one hash."
                raise MessageError("colliding keys", f"{text} Use text as keys, or a list of pairs.")

        return check
