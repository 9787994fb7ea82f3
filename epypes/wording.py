"""How are numbers of things, and what others say, written in a sentence?"""

from __future__ import annotations


def counted(count: int, noun: str) -> str:
    """Return how many of something there are, such as ``3 functions``."""
    return f"{count} {noun}{'s' * (count != 1)}"


def ended(text: str) -> str:
    """Return a text with a full stop, unless it has an end of its own: what an exception says may be a sentence."""
    text = text.rstrip()
    return text if text.endswith((".", "!", "?")) else f"{text}."
