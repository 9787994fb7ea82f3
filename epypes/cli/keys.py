"""The command keys: CURVE keys, by which two machines know each other."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Final

import click

from epypes.cli.options import PATH
from epypes.cli.terminal import print_table
from epypes.errors import KeysError

_NAME: Final = re.compile(r"\w[\w-]*")


@click.command()
@click.argument("name", default="", help="Name of the pair, as camera or robot; optional with --list.")
@click.option("--to", "folder", type=PATH, help="Folder of the keys; default: ~/.config/epypes/keys.")
@click.option("--list", "listed", is_flag=True, help="Print the public keys in the folder; make none.")
def keys(name: str, folder: Path | None, listed: bool) -> None:
    """Make a pair of CURVE keys.

    The output explains which machine needs which file.
    """
    from epypes.transport import make_keys

    config = os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config"
    folder = folder or Path(config) / "epypes" / "keys"
    if listed:
        _print_keys(folder, name)
        return
    if not _NAME.fullmatch(name):
        text = "Use letters, digits, - and _; --to names the folder: epypes keys camera --to keys"
        raise KeysError(name, f"{name!r} is no name for keys. {text}")
    made = make_keys(folder / name)
    public, secret = folder / f"{name}.key", folder / f"{name}.key_secret"
    click.echo(
        f"Made the keys of {name}: {made.public}\n"
        f"  {public}  is public: copy it to every machine that shall talk to {name},\n"
        "    and name it there, or the folder it is in, as --allow.\n"
        f"  {secret}  is secret: it stays here; name it here as --keys.\n"
        f"A service and its caller: epypes serve BUNDLE --keys {secret} --allow CALLER.key, "
        f"epypes call BUNDLE IMAGE --keys CALLER.key_secret --allow {public.name}"
    )


def _print_keys(folder: Path, name: str) -> None:
    """Print the public keys in a folder, or the one of a name, and where the secret keys are."""
    from epypes.transport.zeromq.curve import public_keys

    files = [folder / f"{name}.key"] if name else sorted(folder.glob("*.key"))
    if not files:
        raise KeysError(folder, f"There are no keys in {folder}. Make some: epypes keys NAME --to {folder}")
    rows = [(file.stem, *public_keys(file), _secret_state(file.with_name(f"{file.stem}.key_secret"))) for file in files]
    columns = {name: {"overflow": "fold"} for name in ("name", "public key", "secret key")}
    print_table(columns, rows, f"Public keys in {folder}")


def _secret_state(file: Path) -> str:
    if not file.exists():
        return "elsewhere"
    return "here" if file.stat().st_mode & 0o077 == 0 else f"others can read it: chmod 600 {file}"
