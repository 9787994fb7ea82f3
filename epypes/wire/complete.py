"""Is a protobuf message complete, when it is sent and when it has come?

Protobuf itself does not tell: on its way in it takes a message without its required fields, and gives bytes for text
that is not UTF-8.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

from epypes.errors import MessageError

if TYPE_CHECKING:
    from google.protobuf.message import Message

M = TypeVar("M", bound="Message")

# Protobuf's numbers for the types of fields, which its class FieldDescriptor has as names.
_TEXT, _MESSAGE = 9, 11


def serialized(message: Message) -> bytes:
    """Return the bytes of a protobuf message.

    Raises
    ------
    MessageError
        Of reason ``"incomplete"`` if a required field is missing.
    """
    from google.protobuf.message import EncodeError

    try:
        return message.SerializeToString()
    except (EncodeError, ValueError) as error:
        name = type(message).__name__
        raise MessageError("incomplete", f"This {name} can't be sent: {error}. Fill these fields.") from error


def parsed(kind: type[M], data: bytes | bytearray | memoryview) -> M:
    """Return a protobuf message read from bytes, as a pipeline's f_in does with an event of 2019.

    Parameters
    ----------
    kind
        The class of the message: ``epypes.wire.JustBytes``.
    data
        What has come.

    Raises
    ------
    MessageError
        Of reason ``"not bytes"`` for anything else than bytes, ``"no message"`` for bytes that are no protobuf
        message, ``"incomplete"`` if a required field is missing, ``"not utf-8"`` for text that is none.
    """
    from google.protobuf.message import DecodeError

    name = kind.__name__
    if not isinstance(data, bytes | bytearray | memoryview):
        raise MessageError("not bytes", f"A {name} is read from bytes, not from a {type(data).__name__}.")
    try:
        message = kind.FromString(bytes(data))
    except UnicodeDecodeError as error:
        raise MessageError("not utf-8", f"This is no {name}: {error}.") from error
    except (DecodeError, ValueError, RecursionError) as error:
        raise MessageError("no message", f"These {len(data)} bytes are no {name}: {error}.") from error
    if not message.IsInitialized():
        missing = ", ".join(message.FindInitializationErrors())  # type: ignore[attr-defined]  # not in the stubs
        raise MessageError("incomplete", f"This is no {name}: it lacks {missing}.")
    _check_text(message, name)
    return message


@cache
def _looked_at(descriptor: Any) -> list[tuple[str, bool]]:
    """Return the names of the fields of text and of messages, and whether it is text.

    Fields of bytes are left alone: to look at an image would copy it.
    """
    return [(field.name, field.type == _TEXT) for field in descriptor.fields if field.type in (_TEXT, _MESSAGE)]


def _check_text(message: Any, path: str) -> None:
    for name, is_text in _looked_at(message.DESCRIPTOR):
        value = getattr(message, name)
        if isinstance(value, bytes):
            raise MessageError("not utf-8", f"{path}.{name} is not UTF-8: {value[:40]!r}.")
        if is_text:
            continue
        if not hasattr(value, "DESCRIPTOR"):
            for index, item in enumerate(value):
                _check_text(item, f"{path}.{name}[{index}]")
        elif message.HasField(name):
            _check_text(value, f"{path}.{name}")
