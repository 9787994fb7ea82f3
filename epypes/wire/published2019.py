"""Messages of the system published in 2019, and their attributes.

The field numbers are the published ones, so that a peer built on the published library can be talked to.
The classes are made when they are first used; ``published2019.pyi`` declares their fields for type checkers.
"""

from __future__ import annotations

import numbers
from typing import TYPE_CHECKING, Any

from epypes.errors import MessageError
from epypes.wire.protobuf import message_class

if TYPE_CHECKING:
    from google.protobuf.message import Message

NAMES = ("Attribute", "AttributeList", "Event", "Image", "ImagePair", "JustBytes", "TimeStamp", "TimeStampList")
_INT32 = range(-(2**31), 2**31)
# The field with the value of each type: STRING = 1, DOUBLE = 2, INT = 3 of messages.proto.
_VALUE_FIELDS = ("", "str_val", "double_val", "int_val")


def __getattr__(name: str) -> Any:
    if name not in NAMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return message_class(name)


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
    # Times are added while a message waits to be sent, and the path through all types takes four times as long.
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
        Of reason ``"bad attribute"`` if an entry lacks the value of its type, ``"not utf-8"`` for text that is not
        UTF-8, ``"no attributes"`` for a message that has none.
    """
    result: dict[str, str | float] = {}
    for entry in _entries(message):
        field = _VALUE_FIELDS[entry.type]
        if not entry.HasField(field):
            raise MessageError("bad attribute", f"Attribute {entry.key!r} has no {field}, which its type requires.")
        key, value = entry.key, getattr(entry, field)
        # Protobuf gives bytes for text that is not UTF-8.
        if isinstance(key, bytes) or isinstance(value, bytes):
            raise MessageError("not utf-8", f"An attribute is not UTF-8: {key!r}, {value!r}."[:200])
        result[key] = value
    return result


def _entries(message: Any) -> Any:
    # Without hasattr(), which would take as long as adding an attribute does.
    try:
        return getattr(message, "attributes", message).entries
    except AttributeError:
        text = f"A {type(message).__name__} has no attributes. Give an AttributeList, Event, JustBytes, Image or "
        raise MessageError("no attributes", f"{text}ImagePair.") from None


def _fields(key: str, value: object) -> dict[str, object]:
    if isinstance(value, str):
        return {"type": 1, "str_val": value}
    if isinstance(value, numbers.Integral) and not isinstance(value, bool):
        number = int(value)
        if number in _INT32:
            return {"type": 3, "int_val": number}
        text = f"Attribute {key!r} is {number}, and an int of the 2019 messages has 32 bit. Give float({number}) or "
        raise MessageError("out of range", f"{text}str({number}), or send an Envelope, which has no such limit.")
    if isinstance(value, numbers.Real) and not isinstance(value, bool):
        return {"type": 2, "double_val": float(value)}
    text = f"Attribute {key!r} is a {type(value).__name__}, and the 2019 messages hold str, float and int."
    raise MessageError("no codec", f"{text} Give int(...), float(...) or str(...) of it, or send an Envelope.")
