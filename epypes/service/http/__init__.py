"""HTTP control of a running service: health, metrics, previews, parameters, failures, deployment and a live page."""

from epypes.service.http.server import HttpServer

__all__ = ["HttpServer"]
