"""Which commands are there?"""

from __future__ import annotations

import typer

from epypes.cli.call import call
from epypes.cli.check import check
from epypes.cli.demo import demo
from epypes.cli.deploy import deploy, rollback
from epypes.cli.doctor import doctor
from epypes.cli.experiment import experiment
from epypes.cli.export import export
from epypes.cli.failures import failures
from epypes.cli.keys import keys
from epypes.cli.lab import lab
from epypes.cli.play import play
from epypes.cli.promote import promote
from epypes.cli.record import record
from epypes.cli.replay import replay
from epypes.cli.serve import serve
from epypes.cli.set import set_parameters
from epypes.cli.status import status
from epypes.cli.stop import stop
from epypes.cli.verify import verify

app = typer.Typer(
    name="epypes",
    help="Vision algorithms as computational graphs: promoted from a notebook, verified, served and called.",
    no_args_is_help=True,
    add_completion=False,
    # A traceback's locals would print whole images.
    pretty_exceptions_enable=False,
)
_COMMANDS = (
    *(promote, verify, check, serve, call, status, stop, deploy, rollback, failures, replay),
    *(record, play, keys, experiment, demo, lab, doctor),
)
for command in _COMMANDS:
    app.command()(command)
app.command("set")(set_parameters)
app.add_typer(export, name="export")
