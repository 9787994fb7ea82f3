"""``epypes export``: a systemd unit or a container of a bundle's service."""

from __future__ import annotations

import getpass
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from epypes.cli.terminal import out
from epypes.errors import ServiceError

export = typer.Typer(
    help="Write a systemd unit or a container file for a bundle. Options of epypes serve come behind a --.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

_Bundle = Annotated[Path, typer.Argument(help="The folder of the bundle.")]
_Options = Annotated[list[str] | None, typer.Argument(help="Behind --: options of epypes serve.", metavar="-- OPTIONS")]


@export.command()
def systemd(
    bundle: _Bundle,
    options: _Options = None,
    to: Annotated[Path | None, typer.Option(help="The file, or the folder for it; standard output without.")] = None,
    user: Annotated[str | None, typer.Option(help="Whom the service runs as; you without.")] = None,
) -> None:
    """Write a unit by which systemd starts the service at boot, and again when it ends."""
    from epypes.service.ops.export import systemd_unit, unit_name

    _check_serve_options(bundle, options or ())
    unit = systemd_unit(bundle, options or (), user=user or getpass.getuser())
    if to is None:
        out.print(unit, end="")
        return
    file = to / unit_name(bundle, options or ()) if to.is_dir() else to
    try:
        file.write_text(unit, encoding="utf-8")
    except OSError as error:
        raise ServiceError(file, f"{file} can't be written: {error.strerror or error}.") from error
    out.print(f"Wrote {file}. What to do with it stands at its top.")


@export.command()
def docker(
    bundle: _Bundle,
    to: Annotated[Path, typer.Option(help="The folder to write; it must not be there yet.")],
    options: _Options = None,
) -> None:
    """Write a folder from which docker or podman builds the service: container file, requirements, bundle."""
    from epypes.service.ops.export import write_container

    _check_serve_options(bundle, options or ())
    path = write_container(bundle, to, options or ())
    out.print(f"Wrote {path}. What to do with it stands at its top.")


def _check_serve_options(bundle: Path, options: Sequence[str]) -> None:
    """Refuse now what ``epypes serve`` would refuse at every boot, in the same words."""
    from epypes.cli.app import command_named

    command_named("serve").make_context("epypes serve", [str(bundle), *options])
