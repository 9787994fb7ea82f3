"""``epypes lab``: JupyterLab, with answers of the kernel that don't wait on their way to the page."""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from epypes.errors import ServiceError

_EXTENSION = "epypes.cli.websocket"
_ADDRESS = ("--ip", "--ServerApp.ip")


def lab(
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[FOLDER] [-- OPTIONS]",
            help="The folder that it shows, the current one without; after two dashes what JupyterLab is given.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Start JupyterLab on this machine alone, with a kernel websocket that sends at once, until Ctrl+C."""
    arguments = lab_arguments(words or [], is_root=os.geteuid() == 0)
    if importlib.util.find_spec("jupyterlab") is None:
        raise ModuleNotFoundError("JupyterLab is not installed.", name="jupyterlab")
    sys.stdout.flush()
    # In place of this process: signals reach JupyterLab, and its exit status is this command's.
    os.execv(sys.executable, [sys.executable, *arguments])  # noqa: S606 - our own interpreter, no shell


def lab_arguments(words: list[str], *, is_root: bool = False) -> tuple[str, ...]:
    """Return what Python is started with.

    Raises
    ------
    ServiceError
        There is no such folder.
    """
    # Two dashes are gone by now, so an option shows itself by its own.
    has_folder = bool(words) and not words[0].startswith("-")
    folder, options = (words[0], words[1:]) if has_folder else (".", words)
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
        f"--ServerApp.jpserver_extensions={_EXTENSION}=True",
        *options,
    )
