"""The command ``epypes`` and its subcommands.

A command imports what it needs in its body, so that ``--help`` imports neither other rooms nor their libraries.
"""

from __future__ import annotations

import click

from epypes.cli.bundles import check, promote, verify
from epypes.cli.call import call, demo
from epypes.cli.cameras import cameras
from epypes.cli.experiment import experiment
from epypes.cli.failures import failures, replay
from epypes.cli.lab import lab
from epypes.cli.machine import completion, doctor, export, keys
from epypes.cli.options import Group
from epypes.cli.recordings import play, record
from epypes.cli.services import deploy, reset, rollback, serve, set_parameters, stop
from epypes.cli.status import status

_TOPICS = {
    "From a notebook to a bundle": (promote, verify, check, demo),
    "A running service": (serve, call, status, set_parameters, reset, deploy, rollback, stop),
    "Failures": (failures, replay),
    "Recordings": (record, play),
    "This machine": (lab, cameras, doctor, keys, export, completion),
    "The paper": (experiment,),
}
app = Group(
    "epypes",
    commands=[each for commands in _TOPICS.values() for each in commands],
    topics={title: [str(each.name) for each in commands] for title, commands in _TOPICS.items()},
    help="Run computer vision graphs as services.\n\n"
    "A bundle is a folder with the code of a graph, its hyperparameters and recorded samples. A service runs a bundle: "
    "it computes an answer for each event, such as an image.",
    examples=(
        "epypes promote 01_edge_detection.ipynb --output edges --to services/edges",
        "epypes serve services/edges --http 127.0.0.1:8642",
        "epypes serve -h",
    ),
)
click.version_option(package_name="epypes", message="%(prog)s %(version)s")(app)
