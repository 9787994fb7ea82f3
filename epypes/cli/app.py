"""The command ``epypes`` and its subcommands.

A command imports what it needs in its body, so that ``--help`` imports neither other rooms nor their libraries.
"""

from __future__ import annotations

import click

from epypes.cli.bundles import check, promote, verify
from epypes.cli.call import call, demo
from epypes.cli.experiment import experiment
from epypes.cli.failures import failures, replay
from epypes.cli.lab import lab
from epypes.cli.machine import doctor, export, keys
from epypes.cli.recordings import play, record
from epypes.cli.services import deploy, reset, rollback, serve, set_parameters, stop
from epypes.cli.status import status

_COMMANDS = (
    *(promote, verify, check, serve, call, status, set_parameters, reset, stop, deploy, rollback, failures, replay),
    *(record, play, keys, doctor, export, lab, demo, experiment),
)
app = click.Group(
    "epypes",
    commands=_COMMANDS,
    help="Vision algorithms as computational graphs: promoted from a notebook, verified, served and called.",
    context_settings={"show_default": True},
)
