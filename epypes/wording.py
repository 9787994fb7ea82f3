"""How are numbers of things written in a sentence?"""

from __future__ import annotations


def counted(count: int, noun: str) -> str:
    """Return how many of something there are, such as ``3 functions``."""
    return f"{count} {noun}{'s' * (count != 1)}"
