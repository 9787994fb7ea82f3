"""The command cameras: the cameras that there are, with the addresses that ep.camera takes."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import click

from epypes.cli.options import command, json_option
from epypes.cli.terminal import print_table

_DEVICES: Final = Path("/sys/class/video4linux")


@command("epypes cameras", "epypes cameras --json")
@json_option
def cameras(as_json: bool) -> None:
    """List the cameras of this machine and its networks.

    The column address is what ep.camera takes: Basler's cameras by pylon, cameras of GigE Vision and USB3 Vision, and
    the numbers of video devices. A camera that another program holds can't be opened.
    """
    from epypes.acquisition import find_cameras

    found, missing = find_cameras()
    rows: list[dict[str, Any]] = [{**asdict(each), "address": each.address} for each in found]
    rows += map(_described, sorted(_DEVICES.glob("video*"), key=_number))
    if as_json:
        click.echo(json.dumps({"cameras": rows, "missing": [str(error) for error in missing]}))
        return
    if rows:
        states = {True: "free", False: "held", None: ""}
        table = [
            (str(row["address"]), str(row["model"]), str(row["serial"]), str(row["at"]), states[row["is_free"]])
            for row in rows
        ]
        print_table({name: {"overflow": "fold"} for name in ("address", "model", "serial", "at", "state")}, table)
    else:
        click.echo("No camera was found. With PYLON_CAMEMU=2 before the command, pylon emulates two.")
    for error in missing:
        click.echo(f"Not looked for: {error}")


def _described(folder: Path) -> dict[str, Any]:
    about = {
        "kind": "device",
        "serial": "",
        "model": (folder / "name").read_text().strip(),
        "at": f"/dev/{folder.name}",
    }
    return {**about, "is_free": None, "address": _number(folder)}


def _number(folder: Path) -> int:
    return int(folder.name.removeprefix("video"))
