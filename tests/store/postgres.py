"""A real PostgreSQL server for tests, in a folder and on a port of its own."""

from __future__ import annotations

import contextlib
import glob
import os
import shutil
import signal
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from time import monotonic

from tests.serving import account, with_parent

PASSWORD = "pa@ss:wörd/1"
# It refuses to be root.
_USER = "postgres"
_DEADLINE_S = 60.0


def _binary(name: str) -> str:
    found = shutil.which(name) or next(iter(sorted(glob.glob(f"/usr/lib/postgresql/*/bin/{name}"), reverse=True)), None)
    if found is None:
        raise RuntimeError("No PostgreSQL was found. Install your system's package 'postgresql': sh .ci/postgres")
    return found


class Server:
    """A server that can be ended and started again."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self._process: subprocess.Popen[bytes] | None = None
        secret = folder / "secret"
        secret.write_text(PASSWORD)
        if os.geteuid() == 0:
            shutil.chown(folder, _USER)
            shutil.chown(secret, _USER)
        options = [
            f"--pgdata={folder}/data",
            "--username=epypes",
            "--auth=scram-sha-256",
            f"--pwfile={secret}",
            "--no-sync",
        ]
        self._run(_binary("initdb"), *options, "--encoding=UTF8", "--locale=C.UTF-8", "--no-instructions")

    def _run(self, *command: str) -> None:
        subprocess.run(
            command, cwd=self._folder, check=True, capture_output=True, timeout=_DEADLINE_S, **account(_USER)
        )

    def start(self) -> None:
        options = {"port": self.port, "listen_addresses": "127.0.0.1", "unix_socket_directories": "", "fsync": "off"}
        options = [word for name, value in options.items() for word in ("-c", f"{name}={value}")]
        with (self._folder / "log").open("ab") as log:
            command = [_binary("postgres"), "-D", f"{self._folder}/data", *options]
            self._process = subprocess.Popen(
                command,
                cwd=self._folder,
                stdout=log,
                stderr=log,
                preexec_fn=with_parent(signal.SIGQUIT),
                **account(_USER),
            )
        end_s = monotonic() + _DEADLINE_S
        while True:
            try:
                self.run("SELECT 1")
                return
            except OSError as error:
                if monotonic() > end_s or self._process.poll() is not None:
                    raise RuntimeError((self._folder / "log").read_text()) from error

    def stop(self, *, at_once: bool = False) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.send_signal(signal.SIGQUIT if at_once else signal.SIGINT)
            process.wait(_DEADLINE_S)

    def run(self, statement: str) -> None:
        """Run a statement; OSError if nobody answers."""
        import psycopg

        try:
            with psycopg.connect(
                host="127.0.0.1", port=self.port, user="epypes", password=PASSWORD, dbname="postgres", autocommit=True
            ) as connection:
                connection.execute(statement)
        except psycopg.OperationalError as error:
            raise ConnectionError(str(error)) from error

    def url(self, schema: str = "public") -> str:
        """Return the URL of a schema of its own."""
        secret = "pa%40ss%3Aw%C3%B6rd%2F1"
        self.run(f'CREATE SCHEMA IF NOT EXISTS "{schema}"')
        return f"postgresql://epypes:{secret}@127.0.0.1:{self.port}/postgres?options=-csearch_path%3D{schema}"


@contextlib.contextmanager
def server() -> Iterator[Server]:
    """Give a server that runs; it is ended and removed afterwards."""
    folder = Path(tempfile.mkdtemp(prefix="epypes-postgres-"))
    try:
        made = Server(folder)
        made.start()
        try:
            yield made
        finally:
            made.stop()
    finally:
        shutil.rmtree(folder)
