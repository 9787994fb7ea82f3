"""The command lab, which starts JupyterLab for this machine alone."""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path
from typing import Final

import click

from epypes.cli.options import command
from epypes.errors import ServiceError

_ADDRESS: Final = ("--ip", "--ServerApp.ip")


@command("epypes lab notebooks", "epypes lab -- --port 8899 --no-browser")
@click.argument(
    "arguments", nargs=-1, metavar="[FOLDER] [-- OPTIONS]", help="Folder to open, and options of JupyterLab."
)
def lab(arguments: tuple[str, ...]) -> None:
    """Start JupyterLab for this machine alone.

    It opens the folder, by default the current one, and listens on 127.0.0.1. Ctrl+C ends it.
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
        *options,
    )
