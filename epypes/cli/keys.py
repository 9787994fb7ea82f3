"""``epypes keys``: a pair of keys, by which two machines know each other."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Annotated, Final

import typer

from epypes.cli.terminal import out
from epypes.errors import KeysError

_NAME: Final = re.compile(r"\w[\w-]*")


def keys(
    name: Annotated[str, typer.Argument(help="Whose keys: camera, robot. Leave it out with --list.")] = "",
    folder: Annotated[
        Path | None, typer.Option("--to", help="The folder; without it ~/.config/epypes/keys.", show_default=False)
    ] = None,
    listed: Annotated[bool, typer.Option("--list", help="Show the public keys in the folder; make none.")] = False,
) -> None:
    """Make a pair of CURVE keys, and say who gets which file."""
    from epypes.transport import make_keys

    folder = folder or keys_folder()
    if listed:
        _show(folder, name)
        return
    if not _NAME.fullmatch(name):
        text = "Letters, digits, - and _ say whose they are, and --to says where: epypes keys camera --to keys"
        raise KeysError(name, f"{name!r} is no name for keys. {text}")
    made = make_keys(folder / name)
    public, secret = folder / f"{name}.key", folder / f"{name}.key_secret"
    out.print(f"Made the keys of {name}: {made.public}")
    out.print(f"  {public}  is public: copy it to every machine that shall talk to {name},")
    out.print("    and name it there, or the folder it is in, as --allow.")
    out.print(f"  {secret}  is secret: it stays here; name it here as --keys.")
    out.print(
        f"A service and its caller: epypes serve BUNDLE --keys {secret} --allow CALLER.key, "
        f"epypes call BUNDLE IMAGE --keys CALLER.key_secret --allow {public.name}",
    )


def keys_folder() -> Path:
    """Return where keys are without --to: in this user's configuration."""
    home = os.environ.get("XDG_CONFIG_HOME") or str(Path.home() / ".config")
    return Path(home) / "epypes" / "keys"


def _show(folder: Path, name: str) -> None:
    """Print the public keys in a folder, or the one of a name; whether the secret one is there, too."""
    from rich.table import Table

    from epypes.transport.zeromq.curve import public_keys

    files = [folder / f"{name}.key"] if name else sorted(folder.glob("*.key"))
    if not files:
        raise KeysError(folder, f"There are no keys in {folder}. Make some: epypes keys NAME --to {folder}")
    table = Table(title=f"Public keys in {folder}", title_justify="left")
    for column in ("name", "public key", "secret key"):
        table.add_column(column, overflow="fold")
    for file in files:
        (public,) = public_keys(file)
        table.add_row(file.stem, public, _secret_state(file.with_name(f"{file.stem}.key_secret")))
    out.print(table)


def _secret_state(file: Path) -> str:
    if not file.exists():
        return "elsewhere"
    return "here" if file.stat().st_mode & 0o077 == 0 else f"others can read it: chmod 600 {file}"
