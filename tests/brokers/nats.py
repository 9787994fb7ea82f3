"""How do tests start a real NATS server? In a folder and on a port of its own, on this machine alone."""

from __future__ import annotations

import contextlib
import shutil
import signal
import socket
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from time import monotonic
from urllib.parse import quote, urlencode

from tests.brokers.ports import free_ports
from tests.serving import with_parent

USER = "epypes"
PASSWORD = "pa@ss:wörd/1"
MAX_PAYLOAD = 8 * 1024**2
_DEADLINE_S = 60.0


def _binary() -> str | None:
    return shutil.which("nats-server") or shutil.which("nats-server", path="/usr/sbin:/usr/local/bin:/usr/local/sbin")


def is_installed() -> bool:
    """Return whether there is a NATS server on this machine."""
    return _binary() is not None


class Server:
    """A server that can be ended and started again: its port and what it keeps stay.

    Parameters
    ----------
    folder
        Where its settings, its log and what it keeps are.
    host
        The address that it listens at.
    jetstream
        Whether it keeps anything at all.
    tls
        The files of its certificate and of the key to it, for encrypted connections alone.
    """

    name = "NATS"
    # Whether the queues that it has outlive a kill; see the one of RabbitMQ.
    has_written = True

    def __init__(
        self, folder: Path, host: str = "127.0.0.1", *, jetstream: bool = True, tls: tuple[Path, Path] | None = None
    ) -> None:
        self._folder, self.host, self._scheme = folder, host, "tls" if tls else "nats"
        self.user, self.password = USER, PASSWORD
        (self.port,) = free_ports(host, 1)
        self.process: subprocess.Popen[bytes] | None = None
        settings = [
            f'listen: "{host}:{self.port}"',
            f"max_payload: {MAX_PAYLOAD}",
            # Messages that wait to be read by one who is slow: 1,000 of 1 MB, as a test may have them.
            "max_pending: 1073741824",
            f'authorization {{ user: "{USER}", password: "{PASSWORD}" }}',
        ]
        if jetstream:
            settings.append(f'jetstream {{ store_dir: "{folder}/data", max_file_store: 8GB, max_memory_store: 1GB }}')
        if tls:
            settings.append(f'tls {{ cert_file: "{tls[0]}", key_file: "{tls[1]}" }}')
        (folder / "nats.conf").write_text("\n".join(settings), encoding="utf-8")

    def start(self) -> None:
        """Start it, and return when it answers."""
        binary = _binary()
        if binary is None:
            raise RuntimeError("No NATS server was found. Install your system's package 'nats-server'.")
        with (self._folder / "log").open("ab") as log:
            command = [binary, "--config", f"{self._folder}/nats.conf"]
            self.process = subprocess.Popen(
                command, cwd=self._folder, stdin=subprocess.DEVNULL, stdout=log, stderr=log, preexec_fn=with_parent()
            )
        end_s = monotonic() + _DEADLINE_S
        while not self._answers():
            if monotonic() > end_s or self.process.poll() is not None:
                raise RuntimeError((self._folder / "log").read_text())
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(0.02)

    def _answers(self) -> bool:
        """Return whether it greets who connects; it does once what it keeps has been read."""
        try:
            with socket.create_connection((self.host, self.port), timeout=0.2) as connected:
                return connected.recv(4) == b"INFO"
        except OSError:
            return False

    def stop(self, *, at_once: bool = False) -> None:
        """End it: in order, or at once, as a power cut would."""
        process, self.process = self.process, None
        if process is not None:
            process.send_signal(signal.SIGKILL if at_once else signal.SIGINT)
            process.wait(_DEADLINE_S)

    def address(self, name: str, **options: object) -> str:
        """Return the address of a subject, with credentials; options: those of `place_of`."""
        told: Mapping[str, str] = {
            key: str(value).lower() if isinstance(value, bool) else str(value) for key, value in options.items()
        }
        query = f"?{urlencode(told)}" if told else ""
        secret = f"{quote(self.user, safe='')}:{quote(self.password, safe='')}"
        return f"{self._scheme}://{secret}@{self.host}:{self.port}/{name}{query}"


@contextlib.contextmanager
def server(
    host: str = "127.0.0.1", *, jetstream: bool = True, tls: tuple[Path, Path] | None = None
) -> Iterator[Server]:
    """Give a server that runs; it is ended and removed afterwards."""
    folder = Path(tempfile.mkdtemp(prefix="epypes-nats-"))
    try:
        made = Server(folder, host, jetstream=jetstream, tls=tls)
        made.start()
        try:
            yield made
        finally:
            made.stop(at_once=True)
    finally:
        shutil.rmtree(folder)
