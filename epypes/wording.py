"""Wording: numbers of things, what exceptions say, and ways out that several errors name."""

from __future__ import annotations

import re
from typing import Final

# OpenCV begins its messages with its version and the place in its own source; what went wrong comes after.
_OPENCV_PLACE: Final = re.compile(r"OpenCV\([^)\n]*\) [^\n]*?:-?\d+: error: ")
# The name of a template, with all its parameters.
_OPENCV_TEMPLATE: Final = re.compile(r" in function '[^']{60,}'")
# In the link to the page of a service, its present and its former name.
_ACCESS_KEY: Final = re.compile(r"([?&#](?:access_key|token)=)[^&#\s'\"]+")


def counted(count: int, noun: str) -> str:
    """Return how many of something there are, such as ``3 functions``."""
    return f"{count} {noun}{'s' * (count != 1)}"


def ended(text: str) -> str:
    """Return a text with a full stop, unless it has an end of its own: what an exception says may be a sentence."""
    text = text.rstrip()
    return text if text.endswith((".", "!", "?")) else f"{text}."


def without_access_key(text: str) -> str:
    """Return a text without the access key in the link to a service's page."""
    return _ACCESS_KEY.sub(r"\1...", text)


def error_message(error: BaseException) -> str:
    """Return the text of any exception; of OpenCV's one line with what went wrong, without the place in its source."""
    try:
        # A plain string, whatever methods the one that is returned has.
        text = str.__str__(str(error)).strip()
    except BaseException:  # an exception's own __str__ may raise
        return "(its message can't be had)"
    place = _OPENCV_PLACE.match(text)
    if place is None:
        return text
    lines = _OPENCV_TEMPLATE.sub("", text[place.end() :]).splitlines()
    # One reason for each overload, which are often the same.
    reasons = dict.fromkeys(line.strip("> ") for line in lines)
    return " ".join(f"{line[2:]};" if line.startswith("- ") else line for line in reasons).rstrip(";")


def keep_as_state(name: str, initial: str = "None", *, is_object: bool = False) -> str:
    """Return the way out for what a function keeps from call to call: a sentence with a line that can be pasted.

    Parameters
    ----------
    name
        How the code calls it, such as ``"SEEN"`` or ``"tracker.points"``.
    initial
        The expression of what it begins with.
    is_object
        Whether it is an object that can't be a token itself.

    Examples
    --------
    >>> keep_as_state("N", "0")
    "To keep it from event to event, take 'n_before' and make 'n': cg = ep.delay(cg, 'n', 'n_before', initial=0)"
    """
    found = re.search(r"[^\W\d]\w*$", name)
    token = (found[0].strip("_").lower() if found else "") or "state"
    what = "what it remembers, as numbers or arrays," if is_object else "it"
    return (
        f"To keep {what} from event to event, take '{token}_before' and make '{token}': "
        f"cg = ep.delay(cg, '{token}', '{token}_before', initial={initial})"
    )
