"""A real MQTT broker for tests, Eclipse mosquitto, in a folder and on a port of its own."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from time import monotonic
from typing import Any
from urllib.parse import quote, urlencode

from tests.brokers.ports import free_ports
from tests.serving import account, with_parent

# Both have what must be quoted in an address.
USER, PASSWORD = "epypes", "pa@ss:wörd/1"
_ACCOUNT = "mosquitto"
_DEADLINE_S = 60.0
_PACKET_BYTES = 8 * 1024 * 1024
# MQTT 5 CONNECT without a user, which is refused: its length, the protocol, a clean start, no properties, no client id.
_CONNECT = b"\x10\x0d\x00\x04MQTT\x05\x02\x00\x3c\x00\x00\x00"


def _binary(name: str) -> str | None:
    return shutil.which(name, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/bin")


def is_installed() -> bool:
    """Return whether Debian's packages mosquitto and mosquitto-clients, or others like them, are here."""
    return _binary("mosquitto") is not None and _binary("mosquitto_passwd") is not None


class Server:
    """A broker that can be ended and started again; what it has taken over it keeps in its folder.

    Parameters
    ----------
    folder
        Where its settings, its log and what it keeps are.
    host
        The address that it listens at.
    settings
        More of mosquitto.conf, or other values: ``{"max_packet_size": 2_000}``.
    tls
        The files of its certificate and of the key to it, for encrypted connections alone.
    """

    def __init__(
        self,
        folder: Path,
        host: str = "127.0.0.1",
        *,
        settings: Mapping[str, object] | None = None,
        tls: tuple[Path, Path] | None = None,
    ) -> None:
        self.name, self.host, self.user, self.password = "mosquitto", host, USER, PASSWORD
        self._folder = folder
        self._process: subprocess.Popen[bytes] | None = None
        (self.port,) = free_ports(host, 1)
        secret = folder / "users"
        made = [_binary("mosquitto_passwd"), "-b", "-c", str(secret), USER, PASSWORD]
        subprocess.run(made, check=True, capture_output=True, timeout=_DEADLINE_S)
        (folder / "data").mkdir()
        self._scheme = "mqtts" if tls else "mqtt"
        lines = {
            "listener": f"{self.port} {host}",
            "allow_anonymous": "false",
            "password_file": secret,
            "persistence": "true",
            "persistence_location": f"{folder}/data/",
            # Written with each change: SIGKILL loses what was not.
            "autosave_on_changes": "true",
            "autosave_interval": 1,
            # Otherwise small packets wait 40 ms for each other: 30 events a second through one replica in place of 430.
            "set_tcp_nodelay": "true",
            "max_queued_messages": 0,
            "max_packet_size": _PACKET_BYTES,
            "log_dest": "stderr",
            "log_type": "all",
        }
        if tls:
            # pytest closes its folders to other accounts, each time that it starts, also while another one runs.
            lines |= {"certfile": shutil.copy(tls[0], folder), "keyfile": shutil.copy(tls[1], folder)}
        told = [f"{key} {value}\n" for key, value in (lines | dict(settings or {})).items()]
        (folder / "mosquitto.conf").write_text("".join(told))
        if os.geteuid() == 0:
            for path in (folder, *folder.rglob("*")):
                shutil.chown(path, _ACCOUNT)

    def start(self) -> None:
        """Start it, and wait until it listens."""
        command = [str(_binary("mosquitto")), "-c", str(self._folder / "mosquitto.conf")]
        # As root it would change its account by itself, and lose the death signal.
        with (self._folder / "log").open("ab") as log:
            started = subprocess.Popen(
                command, cwd=self._folder, stdout=log, stderr=log, preexec_fn=with_parent(), **account(_ACCOUNT)
            )
        self._process = started
        end_s = monotonic() + _DEADLINE_S
        while not self._listens():
            if monotonic() > end_s or started.poll() is not None:
                raise RuntimeError((self._folder / "log").read_text())
            with contextlib.suppress(subprocess.TimeoutExpired):
                started.wait(0.02)

    def _listens(self) -> bool:
        try:
            socket.create_connection((self.host, self.port), 1.0).close()
        except OSError:
            return False
        return True

    @property
    def has_written(self) -> bool:
        """Whether what it has confirmed outlives a kill: it writes at the end of each turn of its loop.

        A new connection is answered in a later turn than what was confirmed before.
        """
        with socket.create_connection((self.host, self.port), _DEADLINE_S) as asking:
            asking.sendall(_CONNECT)
            return bool(asking.recv(1))

    def stop(self, *, at_once: bool = False) -> None:
        """End it; ``at_once`` as a power cut does."""
        process, self._process = self._process, None
        if process is not None:
            process.send_signal(signal.SIGKILL if at_once else signal.SIGTERM)
            process.wait(_DEADLINE_S)

    def pause(self) -> None:
        """Have it be silent, as behind a link that was cut."""
        if self._process is not None:
            self._process.send_signal(signal.SIGSTOP)

    def address(self, name: str, **options: object) -> str:
        """Return the address of a topic, with the credentials."""
        secret = f"{quote(self.user, safe='')}:{quote(self.password, safe='')}"
        told = {key: str(value).lower() if isinstance(value, bool) else str(value) for key, value in options.items()}
        query = f"?{urlencode(told)}" if told else ""
        return f"{self._scheme}://{secret}@{self.host}:{self.port}/{quote(name, safe='/')}{query}"


@contextlib.contextmanager
def server(host: str = "127.0.0.1", **options: Any) -> Iterator[Server]:
    """Give a broker that runs; it is ended and removed afterwards."""
    folder = Path(tempfile.mkdtemp(prefix="epypes-mosquitto-"))
    try:
        made = Server(folder, host, **options)
        made.start()
        try:
            yield made
        finally:
            made.stop(at_once=True)
    finally:
        shutil.rmtree(folder)
