"""How are attributes put into a 2019 message, and read from it?"""

from __future__ import annotations

import numbers
from typing import TYPE_CHECKING, Any

from epypes.errors import MessageError

if TYPE_CHECKING:
    from google.protobuf.message import Message

_INT32 = range(-(2**31), 2**31)


# Where the value of each type is: STRING = 1, DOUBLE = 2, INT = 3 of messages.proto.
_VALUE_FIELDS = ("", "str_val", "double_val", "int_val")


def _entries(message: Any) -> Any:
    # Asked for, not looked for: hasattr() before it would take as long as adding an attribute does.
    try:
        return message.attributes.entries
    except AttributeError:
        pass
    try:
        return message.entries
    except AttributeError:
        raise MessageError(
            "no attributes",
            f"A {type(message).__name__} has no attributes. "
            "Give an AttributeList, Event, JustBytes, Image or ImagePair.",
        ) from None


def _as_int32(key: str, value: numbers.Integral) -> int:
    number = int(value)
    if number not in _INT32:
        raise MessageError(
            "out of range",
            f"Attribute {key!r} is {number}, and an int of the 2019 messages has 32 bit. "
            f"Give float({number}) or str({number}), or send an Envelope, which has no such limit.",
        )
    return number


def _fields(key: str, value: object) -> dict[str, object]:
    if isinstance(value, str):
        return {"type": 1, "str_val": value}
    if isinstance(value, numbers.Integral) and not isinstance(value, bool):
        return {"type": 3, "int_val": _as_int32(key, value)}
    if isinstance(value, numbers.Real) and not isinstance(value, bool):
        return {"type": 2, "double_val": float(value)}
    raise MessageError(
        "no codec",
        f"Attribute {key!r} is a {type(value).__name__}, and the 2019 messages know str, float and int. "
        "Give int(...), float(...) or str(...) of it, or send an Envelope.",
    )


def add_attribute(message: Message, key: str, value: str | float) -> None:
    """Append an attribute to a 2019 message.

    Parameters
    ----------
    message
        An AttributeList, or a message with a field ``attributes``.
    key
        Name of the attribute.
    value
        A str, float or int (32 bit); numpy's scalars count as such. A bool is refused, since the reader would
        get an int.

    Raises
    ------
    MessageError
        Of reason ``"no codec"`` for a value of another type, ``"out of range"`` for an int beyond 32 bit,
        ``"not utf-8"`` for text with lone surrogates, ``"no attributes"`` for another message.
    """
    entries = _entries(message)
    # Times are added while a message waits to be sent; the way through all types takes four times as long.
    fields = {"type": 2, "double_val": value} if type(value) is float else _fields(key, value)
    try:
        entries.add(key=key, **fields)
    except ValueError as error:
        raise MessageError("not utf-8", f"Attribute {key!r} can't be sent as text: {error}") from error


def attributes(message: Message) -> dict[str, str | float]:
    """Return the attributes of a 2019 message by key; of two with one key the last counts.

    Raises
    ------
    MessageError
        Of reason ``"bad attribute"`` if an entry lacks the value that its type promises, ``"not utf-8"`` for text
        that is none, ``"no attributes"`` for a message that has none.
    """
    result: dict[str, str | float] = {}
    for entry in _entries(message):
        field = _VALUE_FIELDS[entry.type]
        if not entry.HasField(field):
            raise MessageError("bad attribute", f"Attribute {entry.key!r} has no {field}, as its type says.")
        key, value = entry.key, getattr(entry, field)
        # Protobuf gives bytes for text that is not UTF-8.
        if isinstance(key, bytes) or isinstance(value, bytes):
            raise MessageError("not utf-8", f"An attribute is not UTF-8: {key!r}, {value!r}."[:200])
        result[key] = value
    return result
