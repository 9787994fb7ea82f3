"""Server extension of JupyterLab: messages of a kernel reach the page without waiting.

JupyterLab loads this module as a server extension when ``epypes lab`` starts it. TCP holds a small message back while
an earlier one is not acknowledged (Nagle, RFC 896), and the other end delays its acknowledgement by 40 ms;
``TCP_NODELAY`` ends that.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jupyter_server.serverapp import ServerApp

SETTING = "kernel_websocket_connection_class"


def undelayed(connection: type[Any]) -> type[Any]:
    """Return the same kind of connection between a page and a kernel, whose socket sends at once."""

    def connect(self: Any) -> Any:
        # Before anything is sent.
        self.websocket_handler.set_nodelay(True)
        return connection.connect(self)

    return type("Undelayed", (connection,), {"connect": connect})


def _jupyter_server_extension_points() -> list[dict[str, str]]:
    return [{"module": __name__}]


def _load_jupyter_server_extension(server: ServerApp) -> None:
    from jupyter_server.services.kernels.connection.channels import ZMQChannelsWebsocketConnection

    # The class that the user configured is extended. That of a gateway is left alone: its kernels are elsewhere.
    settings = server.web_app.settings
    if issubclass(settings[SETTING], ZMQChannelsWebsocketConnection):
        settings[SETTING] = undelayed(settings[SETTING])
