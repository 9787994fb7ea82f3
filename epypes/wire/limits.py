"""How much may a message hold? What is beyond is refused before anything is allocated for it."""

from __future__ import annotations

from dataclasses import dataclass


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
    depth
        Containers within containers. Protobuf parsers stop at 100 messages within each other, and a mapping takes
        three of them.
    """

    total_bytes: int = 256 * 1024**2
    header_bytes: int = 16 * 1024**2
    frames: int = 1024
    parts: int = 1024
    values: int = 1_000_000
    depth: int = 24


DEFAULT_LIMITS = Limits()
