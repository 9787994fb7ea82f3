"""How a running service is watched and controlled over HTTP, by programs and in a browser."""

from epypes.service.http.server import HttpServer

__all__ = ["HttpServer"]
