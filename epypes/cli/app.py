"""The command ``epypes``: its commands by name, each imported when it is called."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any, Final

import typer
from typer.core import TyperGroup

# The module and the name of each command, and its line in ``epypes --help``, which imports none of them.
_COMMANDS: Final[Mapping[str, tuple[str, str]]] = {
    "promote": ("promote:promote", "Execute a notebook, write its graph as a bundle, and prove it."),
    "verify": ("verify:verify", "Replay a bundle's samples in a fresh process."),
    "check": ("check:check", "Run a bundle on a labelled set of images."),
    "serve": ("serve:serve", "Serve a bundle until SIGTERM or Ctrl+C."),
    "call": ("call:call", "Send an image to a service, and write its answer to a file."),
    "status": ("status:status", "Show the state of a running service."),
    "stop": ("stop:stop", "End a running service; it answers first what it accepted."),
    "deploy": ("deploy:deploy", "Have a running service serve another bundle."),
    "rollback": ("deploy:rollback", "Have a running service serve the previous bundle again."),
    "failures": ("failures:failures", "List the failures of a service."),
    "replay": ("replay:replay", "Run an event that failed again, in a process of its own."),
    "record": ("record:record", "Write messages that are published into a file."),
    "play": ("play:play", "Publish the messages of a file again."),
    "keys": ("keys:keys", "Make a pair of CURVE keys."),
    "experiment": ("experiment:experiment", "Run the experiment of the paper."),
    "demo": ("demo:demo", "Promote, verify, serve, call and compare a notebook's graph."),
    "lab": ("lab:lab", "Start JupyterLab on this machine."),
    "doctor": ("doctor:doctor", "Check versions, ports, Graphviz, browser, keys, round trips."),
    "set": ("set:set_parameters", "Set hyperparameters of a running service."),
    "export": ("export:export", "Write a systemd unit or a container file for a bundle."),
}


class LazyGroup(TyperGroup):
    """A group that knows the names of its commands, and imports a command when it is called."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the name of the command that is called, the command itself and its arguments."""
        name, command, rest = super().resolve_command(ctx, args)
        return name, command_named(name) if name is not None and name in _COMMANDS else command, rest


app = typer.Typer(
    cls=LazyGroup,
    name="epypes",
    help="Vision algorithms as computational graphs: promoted from a notebook, verified, served and called.",
    no_args_is_help=True,
    add_completion=False,
    # Plain help: to import what draws boxes takes as long as all else.
    rich_markup_mode=None,
    # A traceback's locals would print whole images.
    pretty_exceptions_enable=False,
)


def command_named(name: str) -> Any:
    """Import a command and return it as Typer's; or a group of commands."""
    module, _, attribute = _COMMANDS[name][0].partition(":")
    found = getattr(importlib.import_module(f"epypes.cli.{module}"), attribute)
    if isinstance(found, typer.Typer):
        return typer.main.get_command(found)
    alone = typer.Typer(add_completion=False, rich_markup_mode=None)
    alone.command(name)(found)
    return typer.main.get_command(alone)


def _not_imported() -> None:
    """Stand for a command that only `LazyGroup.resolve_command` imports."""


for _name, (_, _line) in _COMMANDS.items():
    app.command(_name, help=_line)(_not_imported)
