"""Where do the message classes come from? From a compiled schema, in a pool of its own.

Generated ``_pb2.py`` files break across versions of protobuf, and they register in the default pool, where a
user's own ``Image`` would clash with ours. A compiled FileDescriptorSet in a private pool does neither.
"""

from __future__ import annotations

import threading
from importlib import resources
from typing import TYPE_CHECKING, Any

from epypes.optional import optional_import

if TYPE_CHECKING:
    from google.protobuf.descriptor_pool import DescriptorPool

# Two pools would give two classes per message, which can't be mixed: so it is filled under a lock.
_lock = threading.Lock()
_pools: list[DescriptorPool] = []
_classes: dict[str, Any] = {}


def schema_bytes() -> bytes:
    """Return the shipped FileDescriptorSet, serialized."""
    return resources.files("epypes.wire").joinpath("schema.binpb").read_bytes()


def _filled_pool() -> DescriptorPool:
    with optional_import():
        from google.protobuf.descriptor_pb2 import FileDescriptorSet
        from google.protobuf.descriptor_pool import DescriptorPool

    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(schema_bytes()).file:
        pool.AddSerializedFile(file.SerializeToString())
    return pool


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
    known = _classes.get(full_name)
    if known is not None:
        return known
    with optional_import():
        from google.protobuf.message_factory import GetMessageClass

    with _lock:
        if not _pools:
            _pools.append(_filled_pool())
        found = GetMessageClass(_pools[0].FindMessageTypeByName(full_name))
        # Protobuf sets neither; help() fails without a module, and tells nobody of the fields.
        found.__module__ = "epypes.wire"
        found.__doc__ = f"The message {full_name}: {', '.join(found.DESCRIPTOR.fields_by_name)}."
        return _classes.setdefault(full_name, found)
