"""Protobuf message classes from the compiled schema, and their bytes.

Generated ``_pb2.py`` files break across versions of protobuf, and they register in the default pool, where a
user's own ``Image`` would clash with the one of this package. A compiled FileDescriptorSet in a private pool does
neither. ``make schema`` makes it from ``proto/``.
"""

from __future__ import annotations

import threading
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from epypes.errors import MessageError
from epypes.optional import optional_import

if TYPE_CHECKING:
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message import Message

M = TypeVar("M", bound="Message")

SCHEMA_PATH: Final = Path(__file__).with_name("schema.binpb")
# Numbers of field types in protobuf's FieldDescriptor.
_TEXT, _MESSAGE = 9, 11
# Two pools would give two classes per message, which can't be mixed: so it is filled under a lock.
_lock: Final = threading.Lock()


@cache
def _pool() -> DescriptorPool:
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.descriptor_pool import DescriptorPool

    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(SCHEMA_PATH.read_bytes()).file:
        pool.AddSerializedFile(file.SerializeToString())
    return pool


@cache
def message_class(full_name: str) -> Any:
    """Return the class of a message.

    Parameters
    ----------
    full_name
        With its package: ``"epypes.v1.Envelope"``, ``"JustBytes"``.

    Returns
    -------
    type
        The protobuf message class, always the same one. It is typed Any, since its fields are made at runtime.

    Raises
    ------
    KeyError
        If the schema has no such message.
    """
    with optional_import():
        from google.protobuf.message_factory import GetMessageClass
    with _lock:
        found = GetMessageClass(_pool().FindMessageTypeByName(full_name))
        # Protobuf sets neither; help() fails without a module, and lists no fields.
        found.__module__ = "epypes.wire"
        found.__doc__ = f"The message {full_name}: {', '.join(found.DESCRIPTOR.fields_by_name)}."
        return found


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
    """Return a protobuf message read from bytes: the use of a pipeline's f_in for an event of 2019.

    Parameters
    ----------
    kind
        The class of the message: ``epypes.wire.JustBytes``.
    data
        The bytes that were received.

    Raises
    ------
    MessageError
        Of reason ``"not bytes"`` for anything else than bytes, ``"no message"`` for bytes that are no protobuf
        message, ``"incomplete"`` if a required field is missing, ``"not utf-8"`` for text that is not UTF-8.
        Protobuf itself accepts the last two.
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
def _text_and_messages(descriptor: Any) -> list[tuple[str, bool]]:
    """Return the names of the fields of text and of messages, and whether each is text.

    Fields of bytes are not among them: reading an image would copy it.
    """
    return [(field.name, field.type == _TEXT) for field in descriptor.fields if field.type in (_TEXT, _MESSAGE)]


def _check_text(message: Any, path: str) -> None:
    for name, is_text in _text_and_messages(message.DESCRIPTOR):
        value = getattr(message, name)
        # Protobuf gives bytes for text that is not UTF-8.
        if isinstance(value, bytes):
            raise MessageError("not utf-8", f"{path}.{name} is not UTF-8: {value[:40]!r}.")
        if is_text:
            continue
        if not hasattr(value, "DESCRIPTOR"):
            for index, item in enumerate(value):
                _check_text(item, f"{path}.{name}[{index}]")
        elif message.HasField(name):
            _check_text(value, f"{path}.{name}")
