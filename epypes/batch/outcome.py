"""What is left of one item under one setting?"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Final

from epypes.errors import ImageFileError, ScaleError

# What reading a file raises.
_UNREADABLE: Final = frozenset({ImageFileError.__name__, ScaleError.__name__})
# Python can be told to refuse numbers of more than 640 digits.
_MOST_BITS: Final = 2_126


@dataclass(frozen=True, slots=True)
class Trouble:
    """What failed.

    Attributes
    ----------
    function
        Its name in the graph; "" if the input could not be read, or is none that the graph takes.
    kind
        Name of the exception's class.
    message
        What the exception says.
    """

    function: str
    kind: str
    message: str

    @property
    def is_unreadable(self) -> bool:
        """Whether it is a file of the input that could not be read: with other hyperparameters it can't be either."""
        return not self.function and self.kind in _UNREADABLE

    def __str__(self) -> str:
        where = f"{self.function}: " if self.function else ""
        return f"{where}{self.kind}{': ' + self.message if self.message else ''}"


@dataclass(frozen=True, slots=True)
class Thumbnail:
    """A small picture of a token's value.

    Attributes
    ----------
    media_type
        ``"image/jpeg"``, ``"image/png"`` or ``"image/svg+xml"``.
    data
        The bytes of such a file.
    caption
        What it is of, as ``"uint8 400 x 600"``.
    """

    media_type: str
    data: bytes
    caption: str


@dataclass(frozen=True, slots=True)
class Outcome:
    """What is left of one item under one setting.

    Attributes
    ----------
    number, name
        Of the item.
    setting
        The hyperparameters that were varied, by token; nothing in a map.
    values
        By sink token: a number, text or truth value as it is, of anything else a short text.
    times_ns
        Nanoseconds by function that ran; what was reused from the setting before is not among them.
    total_ns
        Nanoseconds of the run, without reading files.
    trouble
        What failed; None if nothing did.
    thumbnails
        By token, if they were asked for.
    kept
        Whole values by token, if they were asked for.
    texts
        Of tokens whose pictures were asked for and that have none: what is said of them instead.
    """

    number: int
    name: str
    setting: Mapping[str, Any] = field(default_factory=dict)
    values: Mapping[str, Any] = field(default_factory=dict)
    times_ns: Mapping[str, int] = field(default_factory=dict)
    total_ns: int = 0
    trouble: Trouble | None = None
    thumbnails: Mapping[str, Thumbnail] = field(default_factory=dict)
    kept: Mapping[str, Any] = field(default_factory=dict)
    texts: Mapping[str, str] = field(default_factory=dict)

    @property
    def has_failed(self) -> bool:
        """Whether something failed."""
        return self.trouble is not None

    def to_json(self) -> dict[str, Any]:
        """Return what JSON can hold of it: all but ``kept``."""
        return {
            "number": self.number,
            "name": self.name,
            "setting": {token: _plain(value) for token, value in self.setting.items()},
            "values": dict(self.values),
            "times_ns": dict(self.times_ns),
            "total_ns": self.total_ns,
            "trouble": None if self.trouble is None else asdict(self.trouble),
            "thumbnails": {
                token: {
                    "media_type": shown.media_type,
                    "data": base64.b64encode(shown.data).decode(),
                    "caption": shown.caption,
                }
                for token, shown in self.thumbnails.items()
            },
            "texts": dict(self.texts),
        }

    @staticmethod
    def from_json(data: Mapping[str, Any]) -> Outcome:
        """Return the outcome that ``to_json`` wrote."""
        trouble = data["trouble"]
        return Outcome(
            data["number"],
            data["name"],
            {token: _read(value) for token, value in data["setting"].items()},
            dict(data["values"]),
            dict(data["times_ns"]),
            data["total_ns"],
            None if trouble is None else Trouble(**trouble),
            {
                token: Thumbnail(shown["media_type"], base64.b64decode(shown["data"]), shown["caption"])
                for token, shown in data["thumbnails"].items()
            },
            texts=dict(data.get("texts", {})),
        )


def _plain(value: Any) -> Any:
    """Return a hyperparameter's value as JSON can hold it; a tuple is told from a list."""
    if isinstance(value, int) and is_endless(value):
        return {"text": long_number(value)}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, tuple | list):
        items = [_plain(item) for item in value]
        return {"tuple": items} if isinstance(value, tuple) else items
    number = plain_number(value)
    return {"text": str(value)} if number is None else number


def _read(data: Any) -> Any:
    if isinstance(data, list):
        return [_read(item) for item in data]
    if not isinstance(data, Mapping):
        return data
    return tuple(_read(item) for item in data["tuple"]) if "tuple" in data else data["text"]


def is_endless(value: int) -> bool:
    """Whether a number has more digits than can be read from a text, whatever Python is told to refuse."""
    return value.bit_length() > _MOST_BITS


def long_number(value: int) -> str:
    """Return what a table says of a number that nobody reads."""
    return f"int of {value.bit_length():,} bits"


def plain_number(value: Any) -> bool | int | float | None:
    """Return numpy's numbers and truth values as Python's; None for what is neither."""
    if getattr(value, "shape", None) != () or not hasattr(value, "item"):
        return None
    item = value.item()
    return item if isinstance(item, bool | int | float) else None
