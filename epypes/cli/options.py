"""What the commands share: how their help is laid out, arguments and options."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

import click

Callback = TypeVar("Callback", bound=Callable[..., Any])

PATH: Final = click.Path(path_type=Path)
# Options that had another name once: both are taken.
_RENAMED: Final[Mapping[str, str]] = {"token-file": "access-key-file"}
_SETTINGS: Final[dict[str, Any]] = {
    "show_default": True,
    "help_option_names": ["-h", "--help"],
    "token_normalize_func": lambda name: _RENAMED.get(name, name),
}


class _Command(click.Command):
    """A command whose help ends with examples."""

    def __init__(self, *args: Any, examples: Sequence[str] = (), **options: Any) -> None:
        options["context_settings"] = _SETTINGS
        super().__init__(*args, **options)
        self.examples = tuple(examples)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the examples, each in a line that can be pasted."""
        _write_examples(formatter, self.examples)


class Group(click.Group):
    """Commands by topic.

    Parameters
    ----------
    topics
        The names of the commands by the title of their topic; without, all stand under one title.
    examples
        Lines that can be pasted.
    """

    def __init__(
        self,
        *args: Any,
        topics: Mapping[str, Sequence[str]] | None = None,
        examples: Sequence[str] = (),
        **options: Any,
    ) -> None:
        super().__init__(*args, context_settings=_SETTINGS, **options)
        self.topics = topics or {"Commands": ()}
        self.examples = tuple(examples)
        self.command_class = _Command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands of each topic with their first sentence, all in the same columns."""
        width = max(map(len, self.commands))
        for title, names in self.topics.items():
            rows = [(name.ljust(width), self.commands[name].get_short_help_str(80)) for name in names or self.commands]
            with formatter.section(title):
                formatter.write_dl(rows)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the examples, each in a line that can be pasted."""
        _write_examples(formatter, self.examples)


def _write_examples(formatter: click.HelpFormatter, examples: Sequence[str]) -> None:
    if examples:
        with formatter.section("Examples" if len(examples) > 1 else "Example"):
            for line in examples:
                # Never wrapped: a line is pasted as it is.
                formatter.write(f"{'':{formatter.current_indent}}{line}\n")


def command(*examples: str, name: str | None = None) -> Callable[[Callable[..., Any]], click.Command]:
    """Return the decorator that makes a function a command, with examples of its use."""
    return click.command(name, cls=_Command, examples=examples)


bundle_argument: Final = click.argument("bundle", type=PATH, help="Folder of the bundle.")
source_argument: Final = click.argument("source", help="Folder of the served bundle, or URL of the service.")
any_source_argument: Final = click.argument(
    "source",
    required=False,
    help="Folder of the served bundle, or URL of the service. Default: all services of this machine.",
)


def refuse_nan(context: click.Context, option: click.Parameter, value: float | None) -> float | None:
    """Refuse NaN, which is in every range of click."""
    if value is not None and math.isnan(value):
        raise click.BadParameter("nan is not a number.", context, option)
    return value


def parse_numbers(context: click.Context, option: click.Parameter, texts: Sequence[str]) -> dict[str, float]:
    """Parse ``NAME=NUMBER`` arguments, numbers of 0 or more."""
    found = {}
    for text in texts:
        name, _, number = text.partition("=")
        try:
            found[name] = float(number)
        except ValueError:
            found[name] = math.nan
        if not name or not 0 <= found[name] < math.inf:
            raise click.BadParameter(f"{text!r} is no NAME=NUMBER with a number of 0 or more.", context, option)
    return found


def seconds_option(name: str, default: float, text: str, least: float = 0.0) -> Callable[[Callback], Callback]:
    """Return an option for a duration, whose text begins with "Seconds" and whose parameter ends in ``_s``."""
    parameter = f"{name.removeprefix('--').replace('-', '_')}_s"
    range_ = click.FloatRange(least)
    return click.option(name, parameter, type=range_, default=default, callback=refuse_nan, help=text)


json_option: Final = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
replica_option: Final = click.option(
    "--replica", default="", show_default=False, help="Name of one replica, if several run on this machine."
)
access_key_option: Final = click.option(
    "--access-key-file",
    type=PATH,
    help="File with the access key of the service. Default: the variable EPYPES_ACCESS_KEY; for a service on this "
    "machine the file that it has written.",
)
insecure_option: Final = click.option(
    "--insecure", is_flag=True, help="Allow addresses that other machines can reach, without keys."
)
keys_option: Final = click.option("--keys", type=PATH, help="Own secret key (.key_secret); epypes keys creates it.")
allow_option: Final = click.option(
    "--allow",
    type=PATH,
    multiple=True,
    callback=lambda context, option, value: list(value) or None,
    help="Public key (.key) of a peer that may connect, or a folder of such files. May be repeated.",
)
