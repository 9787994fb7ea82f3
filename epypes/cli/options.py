"""Arguments and options that several commands share."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar

import click

Command = TypeVar("Command", bound=Callable[..., Any])

PATH: Final = click.Path(path_type=Path)

bundle_argument: Final = click.argument("bundle", type=PATH, help="Folder of the bundle.")
source_argument: Final = click.argument("source", help="Folder of the served bundle, or http URL of the service.")
any_source_argument: Final = click.argument(
    "source",
    required=False,
    help="Folder of the served bundle, or http URL of the service; default: all on this machine.",
)


def refuse_nan(context: click.Context, option: click.Parameter, value: float | None) -> float | None:
    """Refuse NaN, which is in every range of click."""
    if value is not None and math.isnan(value):
        raise click.BadParameter("nan is not a number.", context, option)
    return value


def seconds_option(name: str, default: float, text: str, least: float = 0.0) -> Callable[[Command], Command]:
    """Return an option for a duration in seconds, whose parameter ends in ``_s``."""
    parameter = f"{name.removeprefix('--').replace('-', '_')}_s"
    range_ = click.FloatRange(least)
    help_ = f"{text}, in seconds."
    return click.option(name, parameter, type=range_, default=default, callback=refuse_nan, help=help_)


json_option: Final = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
replica_option: Final = click.option(
    "--replica", default="", show_default=False, help="Name of one replica, if several of the bundle run here."
)
token_file_option: Final = click.option(
    "--token-file",
    type=PATH,
    help="File with the service's access token; default: EPYPES_TOKEN, or that of a service here.",
)
insecure_option: Final = click.option("--insecure", is_flag=True, help="Bind addresses that other machines can reach.")
keys_option: Final = click.option("--keys", type=PATH, help="The .key_secret file of this side; epypes keys makes it.")
allow_option: Final = click.option(
    "--allow",
    type=PATH,
    multiple=True,
    callback=lambda context, option, value: list(value) or None,
    help="The .key file of an allowed peer, or a folder of them; may be repeated.",
)
