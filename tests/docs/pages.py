"""A reader of the documentation: it runs the blocks of a page from top to bottom, as cells and as commands."""

from __future__ import annotations

import ast
import itertools
import linecache
import re
import shlex
import subprocess
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

from tests.brokers.ports import free_ports
from tests.service.processes import running
from tests.transport.peers import wait_until

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
_BLOCK = re.compile(r"^```(python|sh)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_PORT = re.compile(r"(?<=127\.0\.0\.1:)[1-9]\d*\b")
_RAISES = re.compile(r"  # raises (\w+)$")
_EXITS = re.compile(r"  # exits with (\d+)$")
# The address of the broker on the pages, and its port, which the scheme implies.
BROKER, NATS_PORT = "nats://127.0.0.1", "4222"
_NUMBERS = itertools.count(1)


def blocks(page: Path) -> Iterator[tuple[str, str]]:
    """Return the language and the text of each block that a reader can run."""
    for found in _BLOCK.finditer(page.read_text(encoding="utf-8")):
        yield found[1], found[2]


class Reader:
    """Runs the blocks of pages in one namespace and in the current folder.

    Parameters
    ----------
    command
        Runs one ``epypes`` command to its end.
    """

    def __init__(self, command: Callable[..., Any]) -> None:
        self.names: dict[str, Any] = {"__name__": "__main__"}
        self._command = command
        self._ports: dict[str, str] = {}
        self._started = ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self._started.close()

    def read(self, page: Path) -> None:
        """Run the blocks of a page, with free ports in place of those on the page."""
        for language, text in blocks(page):
            text = _PORT.sub(lambda port: self._free_port(port[0]), text.replace(BROKER, f"{BROKER}:{NATS_PORT}"))
            if language == "python":
                self._cell(text)
                continue
            for line in text.replace("\\\n", "").splitlines():
                for part in line.split(" && "):
                    self._line(part)

    def _free_port(self, port: str) -> str:
        if port not in self._ports:
            self._ports[port] = str(free_ports("127.0.0.1", 1)[0])
        return self._ports[port]

    def _cell(self, text: str) -> None:
        """Run a block as a notebook does: what its last line gives is displayed."""
        name = f"<cell {next(_NUMBERS)} of a page>"
        linecache.cache[name] = (len(text), None, text.splitlines(keepends=True), name)
        expected = _RAISES.search(text.rstrip())
        try:
            self._run(ast.parse(text, name), name)
        except Exception as error:
            if expected is None or expected[1] not in {kind.__name__ for kind in type(error).__mro__}:
                raise
        else:
            assert expected is None, f"nothing was raised: {text}"

    def _run(self, tree: ast.Module, name: str) -> None:
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, name, "exec"), self.names)
        if isinstance(last, ast.Expr):
            shown = eval(compile(ast.Expression(last.value), name, "eval"), self.names)
            displayed = getattr(shown, "_repr_mimebundle_", lambda **_: repr(shown))(include=None, exclude=None)
            # What is shown in place of a preview whose function has raised.
            assert "no preview" not in str(displayed)

    def _line(self, line: str) -> None:
        words = shlex.split(line, comments=True)
        if words[:2] == ["epypes", "serve"]:
            served = self._started.enter_context(running(*words[2:]))
            assert served.ready.startswith("READY"), served.stderr.read()
        elif words[0] == "epypes":
            if words[1] == "failures":
                # A service writes a failure down after it has answered, which a reader does not overtake.
                wait_until(lambda: not self._command(*words[1:]).stdout.startswith("No failures"))
            done = self._command(*words[1:])
            expected = _EXITS.search(line)
            assert done.returncode == (int(expected[1]) if expected else 0), done.stdout + done.stderr
        elif " nats-server " in line:
            self._start_broker(line)
        elif words[0] in ("cmake", "ctest") or words[0].startswith("edges_cpp/"):
            subprocess.run(words, check=True, capture_output=True)
        elif words[0] == "make":
            subprocess.run(["make", "-n", *words[1:]], cwd=ROOT, check=True, capture_output=True)
        else:
            assert words[:2] == ["pip", "install"], line
            extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
            assert set(words[2].removeprefix(".[").removesuffix("]").split(",")) <= extras.keys()

    def _start_broker(self, line: str) -> None:
        port = self._free_port(NATS_PORT)
        # The shell becomes the server, which is ended then.
        line = f"{line.replace('nats-server', 'exec nats-server', 1)} --port {port}"
        server = subprocess.Popen(["sh", "-c", line], stderr=subprocess.PIPE, text=True)
        self._started.callback(server.communicate, timeout=60)
        self._started.callback(server.terminate)
        assert any("Server is ready" in text for text in server.stderr)
