"""A bundle as running processes, and how to call it."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from epypes.optional import optional_import

if TYPE_CHECKING:
    from epypes.service.ops.client import Answer, Client, call
    from epypes.service.ops.verification import verify_service
    from epypes.service.parameters import Parameters
    from epypes.service.service import Service
    from epypes.service.serving import serve

__all__ = ["Answer", "Client", "Parameters", "Service", "call", "serve", "verify_service"]

_HOME = {
    "Answer": "ops.client",
    "Client": "ops.client",
    "Parameters": "parameters",
    "Service": "service",
    "call": "ops.client",
    "serve": "serving",
    "verify_service": "ops.verification",
}


def __getattr__(name: str) -> Any:
    # A worker, which is in this room too, needs none of them.
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    with optional_import():
        return getattr(importlib.import_module(f"epypes.service.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
