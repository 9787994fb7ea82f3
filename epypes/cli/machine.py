"""Commands that prepare a machine: doctor, keys, export, completion."""

from __future__ import annotations

import getpass
import json
import os
import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final, Literal

import click

from epypes.cli.options import PATH, Group, bundle_argument, command, json_option
from epypes.cli.terminal import print_table
from epypes.errors import KeysError, ServiceError

_NAME: Final = re.compile(r"\w[\w-]*")
_COLOURS: Final = {"ok": "green", "warning": "yellow", "failed": "red"}

_serve_options: Final = click.argument(
    "options", nargs=-1, metavar="-- OPTIONS", help="Options of epypes serve, as in the example."
)


@command("epypes keys camera --to keys", "epypes keys --list")
@click.argument("name", default="", help="Name of the pair, such as camera or robot. Optional with --list.")
@click.option("--to", "folder", type=PATH, help="Folder of the key files. Default: ~/.config/epypes/keys.")
@click.option("--list", "listed", is_flag=True, help="List the public keys in the folder, and create none.")
def keys(name: str, folder: Path | None, listed: bool) -> None:
    """Create a key pair for encrypted connections (ZeroMQ CURVE).

    The output says which file belongs on which machine.
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


@command("epypes doctor services/edges --address tcp://127.0.0.1:5555")
@click.argument("bundle", type=PATH, required=False, help="Folder of a bundle to check, too.")
@click.option("--address", multiple=True, help="Address to check: to bind, or to connect to. May be repeated.")
@click.option("--keys", type=PATH, multiple=True, help="Key file to check. May be repeated.")
@json_option
def doctor(bundle: Path | None, address: Sequence[str], keys: Sequence[Path], as_json: bool) -> None:
    """Check whether this machine has what a service needs.

    It checks versions, extras, OpenCV, Graphviz, the browser, ports, keys and the round-trip time of a message, and
    prints advice. The exit status is 1 if a check fails.
    """
    from epypes.service.ops.doctor import examine

    checks = []
    for check in examine(bundle, addresses=address, keys=keys):
        checks.append(check)
        if not as_json:
            colour = _COLOURS[check.outcome]
            click.echo(f"{click.style(f'{check.outcome:>7}', fg=colour)}  {check.name}: {check.found}")
            if check.way_out:
                click.secho(f"{'':9}{check.way_out}", fg=colour)
    if as_json:
        click.echo(json.dumps([asdict(check) for check in checks], indent=1))
    failed = [check.name for check in checks if check.outcome == "failed"]
    if failed:
        text = f"Not ready: {', '.join(failed)}. See the advice beside each check above."
        raise ServiceError(bundle or "this machine", text)


@click.group(cls=Group, examples=["epypes export systemd services/edges -- --http 127.0.0.1:8642"])
def export() -> None:
    """Write files for systemd or a container, or the graph in C++.

    Options of epypes serve follow after two dashes (--).
    """


@export.command(examples=["epypes export systemd services/edges --to /etc/systemd/system -- --http 127.0.0.1:8642"])
@bundle_argument
@_serve_options
@click.option("--to", type=PATH, help="File or folder to write to. Default: print the unit.")
@click.option("--user", default=getpass.getuser, show_default="you", help="User account that runs the service.")
def systemd(bundle: Path, options: Sequence[str], to: Path | None, user: str) -> None:
    """Write a systemd unit that serves the bundle.

    systemd starts the service at boot, and restarts it when it ends.
    """
    from epypes.service.ops.export import systemd_unit, unit_name

    _check_serve_options(bundle, options)
    unit = systemd_unit(bundle, options, user=user)
    if to is None:
        click.echo(unit, nl=False)
        return
    file = to / unit_name(bundle, options) if to.is_dir() else to
    file.write_text(unit, encoding="utf-8")
    click.echo(f"Wrote {file}. What to do with it stands at its top.")


@export.command(
    examples=["epypes export docker services/edges --to edges-image -- --sub 'tcp://0.0.0.0:5555' --insecure"]
)
@bundle_argument
@_serve_options
@click.option("--to", type=PATH, required=True, help="Folder to write. It must not exist yet.")
def docker(bundle: Path, options: Sequence[str], to: Path) -> None:
    """Write a folder that docker or podman builds an image from.

    It has a Containerfile, the requirements and a copy of the bundle.
    """
    from epypes.service.ops.export import write_container

    _check_serve_options(bundle, options)
    path = write_container(bundle, to, options)
    click.echo(f"Wrote {path}. What to do with it stands at its top.")


@export.command(examples=["epypes export cpp services/edges --to edges_cpp"])
@bundle_argument
@click.option("--to", type=PATH, required=True, help="Folder to write; an earlier export there is replaced.")
@click.option(
    "--service", is_flag=True, help="Add a program that serves the graph behind ZeroMQ, as epypes serve does."
)
@json_option
def cpp(bundle: Path, to: Path, service: bool, as_json: bool) -> None:
    """Write the graph as a C++ project that replays the samples.

    Functions that cannot be translated are left to be written by hand, in by_hand.cpp, which is never replaced.
    """
    from epypes.cpp import export_cpp

    done = export_cpp(bundle, to, service=service)
    if as_json:
        click.echo(json.dumps(done.to_dict(), indent=1))
        return
    click.echo(str(done))
    click.echo(f"Wrote {to}. Build and test it as its README.md says.")


def _check_serve_options(bundle: Path, options: Sequence[str]) -> None:
    """Refuse now, with the same error, options that ``epypes serve`` would refuse at every boot."""
    from epypes.cli.services import serve

    serve.make_context("epypes serve", [str(bundle), *options])


@command("epypes completion bash")
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]), help="Shell that runs the script.")
def completion(shell: Literal["bash", "zsh", "fish"]) -> None:
    """Print a script that completes commands with the Tab key.

    It completes options, their choices and files, too.

    \b
    bash: add this line to ~/.bashrc
      source <(epypes completion bash)
    zsh: add this line to ~/.zshrc, after compinit
      source <(epypes completion zsh)
    fish: run this once
      epypes completion fish > ~/.config/fish/completions/epypes.fish
    """  # noqa: D301 - click keeps the lines of a paragraph that begins with it
    from click.shell_completion import get_completion_class

    app = click.get_current_context().find_root().command
    click.echo(get_completion_class(shell)(app, {}, "epypes", "_EPYPES_COMPLETE").source())
