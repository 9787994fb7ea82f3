"""A bundle as a running process, and how to call it."""

from epypes.service.call import Answer, call
from epypes.service.server import Service, serve

__all__ = ["Answer", "Service", "call", "serve"]
