"""The extension of Jupyter's server, which sends the messages of a kernel to the page without delay.

A server loads it if EPypes is installed in its environment: the wheel brings
``etc/jupyter/jupyter_server_config.d/epypes.json``. TCP holds a small message back while an earlier one is not
acknowledged (Nagle, RFC 896), and the other end delays its acknowledgement by 40 ms; ``TCP_NODELAY`` ends that.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from jupyter_server.serverapp import ServerApp

_CONNECTION_CLASS: Final = "kernel_websocket_connection_class"


def _jupyter_server_extension_points() -> list[dict[str, str]]:
    return [{"module": __name__}]


def _load_jupyter_server_extension(server: ServerApp) -> None:
    from jupyter_server.services.kernels.connection.channels import ZMQChannelsWebsocketConnection

    # The class that the user configured is extended. That of a gateway is left alone: its kernels are elsewhere.
    settings = server.web_app.settings
    if issubclass(settings[_CONNECTION_CLASS], ZMQChannelsWebsocketConnection):
        settings[_CONNECTION_CLASS] = _undelayed(settings[_CONNECTION_CLASS])


def _undelayed(connection: type[Any]) -> type[Any]:
    """Return a subclass of a connection between page and kernel whose socket sends at once."""

    def connect(self: Any) -> Any:
        # Before anything is sent.
        self.websocket_handler.set_nodelay(True)
        return connection.connect(self)

    return type("Undelayed", (connection,), {"connect": connect})
