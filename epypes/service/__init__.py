"""A bundle as a running process, and how to call it."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from epypes.service.client import Answer, Client, call
    from epypes.service.server import Service, serve

__all__ = ["Answer", "Client", "Service", "call", "serve"]

_HOME = {"Answer": "client", "Client": "client", "Service": "server", "call": "client", "serve": "server"}


def __getattr__(name: str) -> Any:
    # A worker, which is in this room too, needs none of them.
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"epypes.service.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
