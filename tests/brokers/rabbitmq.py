"""How do tests get a real RabbitMQ, in a folder and on ports of its own?"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from time import monotonic
from typing import Any
from urllib.parse import quote, urlencode

from tests.brokers.ports import free_ports
from tests.serving import account, with_parent

_BINARIES = Path("/usr/lib/rabbitmq/bin")
# Which Debian made for it.
_ACCOUNT = "rabbitmq"
_DEADLINE_S = 90.0
# As at the other brokers; RabbitMQ itself takes 128 MiB.
MAX_MESSAGE_BYTES = 8 * 1024**2
# Two cores are shared by everybody: schedulers that spin while they wait for work would take them.
_ERLANG = "-noinput +S 2:2 +sbwt none +sbwtdcpu none +sbwtdio none +sssdio 64"
# How a client of AMQP 0-9-1 begins.
_HELLO = b"AMQP\x00\x00\x09\x01"


def is_installed() -> bool:
    """Return whether this machine has RabbitMQ."""
    return (_BINARIES / "rabbitmq-server").exists()


class Server:
    """A broker that can be ended and started again on the same port; what it keeps stays.

    Parameters
    ----------
    folder
        Where it keeps its data, its log and its settings.
    host
        The one address that it listens at.
    certificates
        A folder with ``ca.pem``, ``cert.pem`` and ``key.pem``: then it listens with encryption too, at ``tls_port``.
    """

    def __init__(
        self,
        folder: Path,
        host: str = "127.0.0.1",
        *,
        certificates: Path | None = None,
    ) -> None:
        self.name, self.user, self.password, self.host = "rabbitmq", "robot", "pa@ss:w/rd%1", host
        self.port, self._epmd_port, self._node_port, self.tls_port = free_ports(host, 4)
        self._folder, self._certificates = folder, certificates
        self._epmd: subprocess.Popen[bytes] | None = None
        self._process: subprocess.Popen[bytes] | None = None
        for name in ("home", "data", "log"):
            (folder / name).mkdir(parents=True, exist_ok=True)
        (folder / "plugins").write_text("[].\n")
        self._configure()
        self._hand_over()

    def _configure(self) -> None:
        told: dict[str, object] = {
            "listeners.tcp.1": f"{self.host}:{self.port}",
            "default_user": self.user,
            "default_pass": self.password,
            "default_user_tags.administrator": "true",
            "loopback_users": "none",
            "disk_free_limit.absolute": 1_000_000,
            "vm_memory_high_watermark.relative": 0.8,
            "log.file.level": "warning",
            "queue_index_embed_msgs_below": 4096,
            "max_message_size": MAX_MESSAGE_BYTES,
        }
        if self._certificates is not None:
            names = {"cacertfile": "ca.pem", "certfile": "cert.pem", "keyfile": "key.pem"}
            told |= {f"ssl_options.{name}": self._certificates / file for name, file in names.items()}
            told |= {"listeners.ssl.1": f"{self.host}:{self.tls_port}", "ssl_options.verify": "verify_none"}
        lines = [f"{name} = {value}\n" for name, value in told.items()]
        (self._folder / "rabbitmq.conf").write_text("".join(lines), encoding="utf-8")

    def _hand_over(self) -> None:
        if os.geteuid() == 0:
            for path in (self._folder, *self._folder.rglob("*")):
                shutil.chown(path, _ACCOUNT, _ACCOUNT)

    def _environment(self) -> dict[str, str]:
        folder = self._folder
        interface = self.host.replace(".", ",")
        return {
            "PATH": "/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin",
            "LANG": "C.UTF-8",
            "HOME": f"{folder}/home",
            "ERL_EPMD_ADDRESS": self.host,
            "ERL_EPMD_PORT": str(self._epmd_port),
            "RABBITMQ_NODENAME": f"epypes{self.port}@localhost",
            "RABBITMQ_DIST_PORT": str(self._node_port),
            "RABBITMQ_CONF_ENV_FILE": f"{folder}/none",
            "RABBITMQ_CONFIG_FILE": f"{folder}/rabbitmq.conf",
            "RABBITMQ_ADVANCED_CONFIG_FILE": f"{folder}/none.config",
            "RABBITMQ_ENABLED_PLUGINS_FILE": f"{folder}/plugins",
            "RABBITMQ_MNESIA_BASE": f"{folder}/data",
            "RABBITMQ_LOG_BASE": f"{folder}/log",
            "RABBITMQ_PID_FILE": f"{folder}/pid",
            "RABBITMQ_SERVER_ADDITIONAL_ERL_ARGS": f"{_ERLANG} -kernel inet_dist_use_interface {{{interface}}}",
            # Its script becomes the server, instead of a parent that would be left behind: we end what we started.
            "RABBITMQ_ALLOW_INPUT": "1",
        }

    def _spawn(self, *command: str) -> subprocess.Popen[bytes]:
        with (self._folder / "output").open("ab") as output:
            return subprocess.Popen(
                command,
                cwd=self._folder,
                env=self._environment(),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                preexec_fn=with_parent(),
                **account(_ACCOUNT),
            )

    def start(self) -> None:
        """Start it, and return when it answers; RuntimeError with what it wrote if it doesn't."""
        self._epmd = self._spawn("epmd", "-port", str(self._epmd_port), "-address", self.host)
        self._await(self._epmd, lambda: self._answers(self._epmd_port, b""))
        self._process = self._spawn(f"{_BINARIES}/rabbitmq-server")
        self._await(self._process, lambda: self._answers(self.port, _HELLO))

    def _await(self, process: subprocess.Popen[bytes], is_up: Callable[[], bool]) -> None:
        end_s = monotonic() + _DEADLINE_S
        while not is_up():
            if monotonic() > end_s or process.poll() is not None:
                self.stop(at_once=True)
                raise RuntimeError(self.log)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(0.05)

    def _answers(self, port: int, hello: bytes) -> bool:
        try:
            with socket.create_connection((self.host, port), timeout=5.0) as connection:
                connection.sendall(hello)
                return not hello or bool(connection.recv(8))
        except OSError:
            return False

    def stop(self, *, at_once: bool = False) -> None:
        """End it, and the port mapper that it needs; as often as you like. ``at_once`` kills it."""
        for process in (self._process, self._epmd):
            if process is not None and process.poll() is None:
                process.send_signal(signal.SIGKILL if at_once else signal.SIGTERM)
                process.wait(_DEADLINE_S)
        self._process = self._epmd = None

    @property
    def has_written(self) -> bool:
        """Whether the queues that it has outlive a kill.

        It writes down which quorum queues there are up to a second after they were made (names.dets of rabbitmq/ra). One
        that it had not written down is made anew when it is back: empty, and by 3.10 without a leader, so that it
        confirms nothing.
        """
        (kept,) = self._folder.glob("data/*/quorum/*/names.dets")
        names = kept.read_bytes()
        return all(config.parent.name.encode() in names for config in kept.parent.glob("*/config"))

    def pause(self) -> None:
        """Have it say nothing any more, as if the link to it were cut."""
        if self._process is not None:
            self._process.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        """Have a paused one go on."""
        if self._process is not None:
            self._process.send_signal(signal.SIGCONT)

    def evaluate(self, expressions: str) -> str:
        """Evaluate Erlang expressions in the server, ``"f(1), g(2)."``; return the value of the last."""
        # rabbitmqctl starts a virtual machine of its own for that: a second of processor time.
        (program,) = Path("/usr/lib/erlang").glob("erts-*/bin/erl_call")
        cookie = (self._folder / "home" / ".erlang.cookie").read_text()
        done = subprocess.run(
            [str(program), "-address", f"{self.host}:{self._node_port}", "-c", cookie, "-e"],
            input=f"{expressions}\n",
            cwd=self._folder,
            env=self._environment(),
            capture_output=True,
            text=True,
            timeout=_DEADLINE_S,
            **account(_ACCOUNT),
        )
        kind, _, value = done.stdout.strip("{} \n").partition(", ")
        if done.returncode or kind != "ok":
            raise RuntimeError(done.stderr or done.stdout)
        return value

    @property
    def log(self) -> str:
        """What it wrote."""
        files = [self._folder / "output", *sorted((self._folder / "log").glob("*.log"))]
        return "\n".join(file.read_text(errors="replace") for file in files if file.exists())

    def address(self, name: str, *, user: str = "", password: str = "", scheme: str = "amqp", **options: object) -> str:
        """Return the address of a queue, with user and password, and options such as ``create=True``."""
        who = f"{quote(user or self.user, safe='')}:{quote(password or self.password, safe='')}"
        port = self.tls_port if scheme == "amqps" else self.port
        told = {key: str(value).lower() if isinstance(value, bool) else value for key, value in options.items()}
        query = f"?{urlencode(told)}" if told else ""
        return f"{scheme}://{who}@{self.host}:{port}/{quote(name)}{query}"


@contextlib.contextmanager
def server(host: str = "127.0.0.1", **options: Any) -> Iterator[Server]:
    """Give a broker that runs; it is ended and removed afterwards."""
    folder = Path(tempfile.mkdtemp(prefix="epypes-rabbitmq-"))
    try:
        made = Server(folder, host, **options)
        made.start()
        try:
            yield made
        finally:
            made.stop(at_once=True)
    finally:
        shutil.rmtree(folder)
