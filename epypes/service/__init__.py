"""A bundle as a running process, and how to call it."""

from epypes.service.call import Answer, Client, call
from epypes.service.server import Service, serve

__all__ = ["Answer", "Client", "Service", "call", "serve"]
