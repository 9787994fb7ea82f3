"""A systemd unit or a container folder for the service of a bundle.

Both are text that a person reads, changes and keeps beside the bundle; their first lines say how to use them.
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from importlib import metadata
from itertools import pairwise
from pathlib import Path
from typing import Final

from epypes.bundle.manifest import SETTINGS, check_manifest
from epypes.bundle.requirements import epypes_source, pins
from epypes.bundle.settings import read_settings
from epypes.errors import ServiceError
from epypes.transport.address import is_broker, scheme_of

# Python 3.11 is the oldest that EPypes runs on; the container takes the one that the bundle was proved with.
_PYTHON: Final = f"{sys.version_info.major}.{sys.version_info.minor}"
# A service drains in bounded time; what has not ended by then is killed.
_STOP_MARGIN_S: Final = 15
# Longer than loading, which includes a replay of all samples, should ever take.
_START_LIMIT_S: Final = 600

_UNIT: Final = """\
# The service of {bundle}, started by systemd and kept running.
#
#   sudo install -m 644 {file} /etc/systemd/system/{file}
#   sudo systemctl daemon-reload
#   sudo systemctl enable --now {units}
#   journalctl --follow --unit {unit}
#
# Commands find the service by the state file that it keeps, as user {user}:
#
#   XDG_RUNTIME_DIR=/run/{name} XDG_STATE_HOME=/var/lib/{name} epypes call {shown} image.png
#
# After a new promotion: epypes deploy, or sudo systemctl restart {units}

[Unit]
Description={description}
After=network{online}.target
{wants}StartLimitIntervalSec=300
StartLimitBurst=5

[Service]
# The service is ready when the samples have been replayed identical and the sockets are bound.
Type=notify
NotifyAccess=main
TimeoutStartSec={start_s}
ExecStart={command}
User={user}
Restart=on-failure
RestartSec=2
# SIGTERM goes to the service alone, which answers what it has accepted; then its worker is ended with it.
KillMode=mixed
TimeoutStopSec={stop_s}
RuntimeDirectory={name}
RuntimeDirectoryMode=0700
{kept}StateDirectory={name}
StateDirectoryMode=0700
Environment=XDG_RUNTIME_DIR=/run/{name}
Environment=XDG_STATE_HOME=/var/lib/{name}
Environment=PYTHONUNBUFFERED=1
NoNewPrivileges=yes
ProtectSystem=full
ProtectControlGroups=yes
ProtectKernelTunables=yes
RestrictSUIDSGID=yes

[Install]
WantedBy=multi-user.target
"""

_CONTAINERFILE: Final = """\
# The service of the bundle {name} in a container.
#
#   docker build --tag {tag} .
#   docker run --rm --init --network host {tag}
#
# With the host's network the service binds the host's loopback, which no other machine reaches. To serve other
# machines, bind 0.0.0.0 with keys (epypes keys), which are mounted when the container starts:
#
#   docker run --rm --init --publish 5555:5555 --publish 5556:5556 --volume ./keys:/keys:ro {tag} \\
#       --sub tcp://0.0.0.0:5555 --pub tcp://0.0.0.0:5556 --keys /keys/service.key_secret --allow /keys/allowed

FROM python:{python}-slim
RUN useradd --create-home --uid 10001 epypes
WORKDIR /service
COPY requirements.txt ./
{wheels}RUN pip install --no-cache-dir {find}--requirement requirements.txt
COPY bundle ./bundle
USER epypes
ENV PYTHONUNBUFFERED=1
STOPSIGNAL SIGTERM
# Arguments after the image's name at docker run are added to this command.
ENTRYPOINT {entrypoint}
"""


def systemd_unit(bundle: str | Path, options: Sequence[str] = (), *, user: str, stop_s: int = _STOP_MARGIN_S) -> str:
    """Return a unit that runs ``epypes serve`` with this Python.

    Parameters
    ----------
    bundle
        The bundle's folder; its seal is checked.
    options
        Further arguments of ``epypes serve``.
    user
        The user that the service runs as; it must be able to read the bundle and this Python.
    stop_s
        Seconds after SIGTERM until what still runs is killed.

    Raises
    ------
    BundleError
        The folder is not the bundle that was promoted.
    ServiceError
        An address has a password in it, which every user could read.

    Notes
    -----
    Replicas, which share the events of a broker, have one unit: a template, of which each is an instance.

    systemd.service(5), systemd.exec(5); quoting by systemd.syntax(7).
    """
    folder, name = _read_bundle(bundle)
    _check_secrets(bundle, options)
    is_template, file = _is_template(options), unit_name(bundle, options)
    command = [sys.executable, "-m", "epypes.cli", "serve", str(folder), *options]
    units = [file.replace("@.", f"@{number}.") for number in ((1, 2) if is_template else (1,))]
    return _UNIT.format(
        units=" ".join(units),
        unit=units[0],
        # All replicas share the folder, which would go with the first that is stopped.
        kept="RuntimeDirectoryPreserve=yes\n" if is_template else "",
        online="-online" if is_template else "",
        wants="Wants=network-online.target\n" if is_template else "",
        bundle=_one_line(str(folder)),
        shown=_one_line(shlex.quote(str(folder))),
        name=f"epypes-{name}",
        file=file,
        description=_specifiers(_one_line(f"EPypes service {name}")) + (", replica %i" if is_template else ""),
        command=" ".join([*map(_quoted, command), *(["--replica", "%i"] if is_template else [])]),
        user=_specifiers(user),
        start_s=_START_LIMIT_S,
        stop_s=stop_s,
    )


def unit_name(bundle: str | Path, options: Sequence[str] = ()) -> str:
    """Return the name of a bundle's unit: ``epypes-edges.service``; ``epypes-edges@.service`` for replicas."""
    return f"epypes-{_read_bundle(bundle)[1]}{'@' if _is_template(options) else ''}.service"


def _is_template(options: Sequence[str]) -> bool:
    """Whether there may be several services of the bundle."""
    has_name = any(option.partition("=")[0] == "--replica" for option in options)
    subs = [option.removeprefix("--sub=") for option in options if option.startswith("--sub=")]
    subs += [after for option, after in pairwise(options) if option == "--sub"]
    return not has_name and any(map(is_broker, subs))


def _check_secrets(bundle: str | Path, options: Sequence[str]) -> None:
    """Raise ServiceError for an address with a password in it: every user can read units, images and process lists."""
    for option in options:
        found = re.search(r"\b([a-z]+://[^/@\s:]*):[^/@\s]*@", option)
        if found:
            text = (
                f"{found[1]}:... has the password in it, which others could read. Put it in a file: ?password_file=PATH"
            )
            raise ServiceError(bundle, text)


def write_container(bundle: str | Path, to: str | Path, options: Sequence[str] = ()) -> Path:
    """Write a folder from which a container is built: Containerfile, requirements and a copy of the bundle.

    Parameters
    ----------
    bundle
        The bundle's folder; its seal is checked.
    to
        The folder to write; it must not exist, or be empty.
    options
        Further arguments of ``epypes serve``.

    Returns
    -------
    Path
        The Containerfile. Where EPypes runs from a checkout, which no index has, a wheel of it lies beside.

    Raises
    ------
    BundleError
        The folder is not the bundle that was promoted.
    ServiceError
        The folder can't be written, no wheel can be built, or an address has a password in it.
    """
    folder, name = _read_bundle(bundle)
    _check_secrets(bundle, options)
    target = Path(to)
    try:
        if target.exists() and (not target.is_dir() or any(target.iterdir())):
            raise ServiceError(to, f"{to} is there already and not empty. Name another folder.")
        target.mkdir(parents=True, exist_ok=True)
        shutil.copytree(folder, target / "bundle")
        pinned = (folder / "requirements.txt").read_text(encoding="utf-8")
        kept = [line for line in pinned.splitlines() if re.split(r"[^\w-]", line, maxsplit=1)[0].lower() != "epypes"]
        has_wheel = _add_wheel(target, epypes_source(pins(pinned.splitlines())))
        own = f"epypes[{','.join(sorted(_extras(options)))}]=={metadata.version('epypes')}"
        (target / "requirements.txt").write_text("\n".join([*kept, own]) + "\n", encoding="utf-8")
        entrypoint = ["epypes", "serve", "/service/bundle", *options]
        text = _CONTAINERFILE.format(
            name=name,
            tag=f"epypes-{name}",
            python=_PYTHON,
            wheels="COPY wheels ./wheels\n" if has_wheel else "",
            find="--find-links wheels " if has_wheel else "",
            entrypoint=json.dumps(entrypoint, ensure_ascii=False),
        )
        path = target / "Containerfile"
        path.write_text(text, encoding="utf-8")
    except (OSError, UnicodeError) as error:
        if isinstance(error, ServiceError):
            raise
        raise ServiceError(to, f"{to} can't be written: {error}. Name another folder.") from error
    return path


def _extras(options: Sequence[str]) -> set[str]:
    """Return the extras that a service with these options needs."""
    found = {"serve"}
    for before, option in pairwise(("", *options)):
        name, _, value = option.partition("=") if option.startswith("--") else (before, "", option)
        if name == "--store":
            found.add("postgres" if value.startswith("postgres") else "store")
        else:
            scheme = scheme_of(value)
            found.add("serve" if scheme is None else scheme.extra)
    return found - {""}


def _add_wheel(target: Path, source: str) -> bool:
    """Build a wheel of a checkout into the folder ``wheels``; return False where an index has what is wanted."""
    if not Path(source).is_dir():
        return False
    wheels = str(target / "wheels")
    command = [sys.executable, "-I", "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", wheels, source]
    done = subprocess.run(  # noqa: S603 - pip of this interpreter
        command, stdin=subprocess.DEVNULL, capture_output=True, check=False
    )
    if done.returncode != 0:
        output = " ".join(done.stderr.decode(errors="replace").split())[-300:]
        raise ServiceError(target, f"No wheel can be built of {source}: {output}. Connect to the network.")
    return True


def _read_bundle(bundle: str | Path) -> tuple[Path, str]:
    """Return the folder of a whole bundle, and its name in the characters that systemd and containers take."""
    folder = Path(bundle).resolve()
    check_manifest(folder)
    name = read_settings(folder / SETTINGS).name
    return folder, re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-") or "service"


def _one_line(text: str) -> str:
    return text.replace("\n", " ").replace("\r", " ")


def _specifiers(text: str) -> str:
    """Return text in which systemd expands nothing."""
    return text.replace("%", "%%")


def _quoted(argument: str) -> str:
    """Return one argument of a unit's command as systemd reads it back."""
    if re.fullmatch(r"[\w@+=:,./*-]+", argument, re.ASCII):
        return argument
    escaped = argument.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n").replace("\r", "\\r")
    return f'"{_specifiers(escaped).replace("$", "$$")}"'
