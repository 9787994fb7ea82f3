"""The command lab: JupyterLab, whose kernel's messages reach the page without delay.

JupyterLab loads this module as a server extension when ``epypes lab`` starts it. TCP holds a small message back while
an earlier one is not acknowledged (Nagle, RFC 896), and the other end delays its acknowledgement by 40 ms;
``TCP_NODELAY`` ends that.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from epypes.cli.options import command
from epypes.errors import ServiceError

if TYPE_CHECKING:
    from jupyter_server.serverapp import ServerApp

_ADDRESS: Final = ("--ip", "--ServerApp.ip")
_CONNECTION_CLASS: Final = "kernel_websocket_connection_class"


@command("epypes lab notebooks", "epypes lab -- --port 8899 --no-browser")
@click.argument("arguments", nargs=-1, metavar="[FOLDER] [-- OPTIONS]", help="Folder to open; options of JupyterLab.")
def lab(arguments: tuple[str, ...]) -> None:
    """Start JupyterLab on this machine.

    Without a folder it opens the current one. It listens on this machine alone, and its kernel websocket sends at once
    (TCP_NODELAY). Ctrl+C ends it.
    """
    command = lab_command(*arguments, is_root=os.geteuid() == 0)
    if importlib.util.find_spec("jupyterlab") is None:
        raise ModuleNotFoundError("JupyterLab is not installed.", name="jupyterlab")
    sys.stdout.flush()
    # In place of this process: signals reach JupyterLab, and its exit status is this command's.
    os.execv(sys.executable, [sys.executable, *command])  # noqa: S606 - our own interpreter, no shell


def lab_command(*arguments: str, is_root: bool = False) -> tuple[str, ...]:
    """Return the arguments for Python.

    Raises
    ------
    ServiceError
        There is no such folder.
    """
    # The parser has removed the two dashes: an option begins with a dash of its own.
    has_folder = bool(arguments) and not arguments[0].startswith("-")
    folder, options = (arguments[0], arguments[1:]) if has_folder else (".", arguments)
    if not Path(folder).is_dir():
        raise ServiceError(folder, f"There is no folder {folder!r} to show in JupyterLab. Name one that exists.")
    return (
        "-P",  # a file of the current folder that is called like a module is not for the server
        "-m",
        "jupyterlab",
        folder,
        # JupyterLab refuses an address that is given twice.
        *(() if any(option.partition("=")[0] in _ADDRESS for option in options) else ("--ip=127.0.0.1",)),
        *(("--allow-root",) if is_root else ()),
        f"--ServerApp.jpserver_extensions={__name__}=True",
        *options,
    )


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
