r"""How does a row become text that every database takes, and come back as it was?

As JSON that any reader understands, so no NaN in it; and without what PostgreSQL or UTF-8 refuse, NUL and halves of
surrogate pairs, which JSON writes as ``\u0000``.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from typing import Any, Final

# A float that JSON has no word for; and what a dict that looks like one is wrapped into.
_FLOAT, _AS_IT_IS = "$float", "$dict"
_SURROGATE: Final = re.compile("[\ud800-\udfff]")


def to_text(value: Any) -> str:
    """Return a value as JSON.

    Raises
    ------
    TypeError
        It has something in it that JSON has no word for, or a key that is no text.
    ValueError
        It contains itself.
    """
    try:
        text = _dumped(value)
    except ValueError:  # there is a NaN or an infinity in it
        text = ""
    if not text or '{"$' in text:
        text = _dumped(_worded(value))
    _check_keys(value)
    return _SURROGATE.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def _check_keys(value: Any) -> None:
    """Refuse keys that JSON would write as texts, where they may be those of others: 1 and "1"."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            if not isinstance(key, str):
                raise TypeError(f"key {key!r:.80} is no text; as one it is {str(key)!r:.80}")
            _check_keys(item)
    elif isinstance(value, list | tuple):
        for item in value:
            _check_keys(item)


def _dumped(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"), default=_plain)


def _plain(value: Any) -> Any:
    """Return what numpy's numbers and mappings that are no dict stand for."""
    if isinstance(value, Mapping):
        return dict(value)
    if getattr(value, "shape", None) == () and hasattr(value, "item"):
        return _worded(value.item())
    raise TypeError(f"{type(value).__name__!r} is neither a number, a text, a truth value, a list nor a dict")


def _worded(value: Any) -> Any:
    """Return a value in which every float has a word in JSON."""
    if isinstance(value, float) and not math.isfinite(value):
        return {_FLOAT: str(float(value))}
    if isinstance(value, Mapping):
        worded = {key: _worded(item) for key, item in value.items()}
        return {_AS_IT_IS: worded} if worded.keys() & {_FLOAT, _AS_IT_IS} else worded
    if isinstance(value, list | tuple):
        return [_worded(item) for item in value]
    return value


def from_text(text: str) -> Any:
    """Return the value that this text was made from; tuples come back as lists.

    Raises
    ------
    ValueError
        It is no such text.
    """
    value = json.loads(text)
    return _unworded(value) if '{"$' in text else value


def _unworded(value: Any) -> Any:
    if isinstance(value, list):
        return [_unworded(item) for item in value]
    if not isinstance(value, dict):
        return value
    if value.keys() == {_FLOAT}:
        return float(value[_FLOAT])
    inner = value[_AS_IT_IS] if value.keys() == {_AS_IT_IS} else value
    return {key: _unworded(item) for key, item in inner.items()}


def to_word(name: str) -> str:
    """Return a name as text that every database takes, and that is the name itself wherever it can be.

    Raises
    ------
    TypeError
        It is no text.
    """
    if not isinstance(name, str):
        raise TypeError(f"Kinds, names and keys of series are texts, not {type(name).__name__!r}: {name!r:.80}")
    return to_text(name)[1:-1]


def from_word(word: str) -> str:
    """Return the name that a word was made from."""
    name: str = from_text(f'"{word}"')
    return name
