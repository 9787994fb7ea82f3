"""JupyterLab and Chromium: notebooks are opened, run and read as a user does it.

::

    with JupyterLab(folder, theme="dark") as lab, chromium() as browser:
        notebook = Notebook(open_lab(browser, lab), "x.ipynb")
        notebook.run_all()

The page of JupyterLab costs some 6 s of processor time, and a notebook that is opened in it 1 s. So tests open their
notebooks one after the other in one page.

Everything stays on loopback, in directories of its own, and only processes started here are ended here.
"""

from __future__ import annotations

import json
import os
import re
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

THEMES = {"light": "JupyterLab Light", "dark": "JupyterLab Dark"}
# Every wait ends on a condition; these only matter when a test fails.
TIMEOUT_MS = 90_000
CELLS_TIMEOUT_MS = 180_000
START_TIMEOUT_S = 90
STOP_TIMEOUT_S = 60
# The shell takes a third of the processor time of the whole browser to open a page.
_BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
_FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
# JupyterLab shows its splash screen twice when a page is loaded again, and may take it away twice.
_SPLASH_REMOVED_AGAIN = re.compile(r"'removeChild' on 'Node'.*\n *at \S*/jlab_core\.\S*$")
_KERNEL = "window.jupyterapp?.shell.currentWidget?.sessionContext?.session?.kernel"


class JupyterLab:
    """A JupyterLab server over a folder, on a free port of loopback.

    Parameters
    ----------
    root
        The folder that it shows.
    state
        An empty folder for its settings, its log and its runtime files.
    theme
        ``"light"`` or ``"dark"``.
    command
        The module that Python runs, and its first arguments.
    """

    def __init__(
        self, root: Path, state: Path, theme: str = "light", *, command: Sequence[str] = ("jupyterlab",)
    ) -> None:
        self.root, self.state, self.theme, self.command = root.resolve(), state, theme, command
        self.port, self.token = _free_port(), secrets.token_hex(16)
        self.log: list[str] = []
        self._listening = threading.Event()

    def __enter__(self) -> Self:
        self._write_settings()
        self._process = subprocess.Popen(
            [sys.executable, "-m", *self.command, *self._arguments()],
            env=self._environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        self._reader = threading.Thread(target=self._read_log, daemon=True)
        self._reader.start()
        if not self._listening.wait(START_TIMEOUT_S) or not self._takes_calls():
            self.stop()
            raise RuntimeError("JupyterLab did not start:\n" + "".join(self.log))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    @property
    def url(self) -> str:
        """The address of JupyterLab with no notebook open."""
        return f"http://127.0.0.1:{self.port}/lab?token={self.token}&reset"

    def stop(self) -> None:
        """End the kernels, then the server; kill its process group if it does not end by itself."""
        with suppress(OSError):
            for kernel in self.api("kernels"):
                self.api(f"kernels/{kernel['id']}", "DELETE")
        self._process.terminate()
        try:
            self._process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        self._reader.join(STOP_TIMEOUT_S)
        if self._process.stdout is not None:
            self._process.stdout.close()

    def api(self, path: str, method: str = "GET") -> Any:
        """Ask the server itself; return what it answers."""
        request = urllib.request.Request(
            f"http://127.0.0.1:{self.port}/api/{path}",
            method=method,
            headers={"Authorization": f"token {self.token}"},
        )
        with urllib.request.urlopen(request, timeout=STOP_TIMEOUT_S) as answer:
            body = answer.read()
        return json.loads(body) if body else None

    def _takes_calls(self) -> bool:
        """Return once the port can be connected to: it says that it is running before it listens."""
        while self._process.poll() is None:
            with suppress(OSError), socket.create_connection(("127.0.0.1", self.port), STOP_TIMEOUT_S):
                return True
        return False

    def _read_log(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.log.append(line)
            if f":{self.port}/lab" in line:
                self._listening.set()
        self._listening.set()  # the process has ended, which the caller sees

    def _write_settings(self) -> None:
        folder = self.state / "settings" / "@jupyterlab" / "apputils-extension"
        folder.mkdir(parents=True)
        for name, settings in (
            ("themes", {"theme": THEMES[self.theme]}),
            ("notification", {"fetchNews": "false", "checkForUpdates": False}),
        ):
            (folder / f"{name}.jupyterlab-settings").write_text(json.dumps(settings))

    def _environment(self) -> dict[str, str]:
        kept = {name: value for name, value in os.environ.items() if not name.startswith("JUPYTER")}
        return kept | {
            "JUPYTER_CONFIG_DIR": str(self.state / "config"),
            "JUPYTER_DATA_DIR": str(self.state / "data"),
            "JUPYTER_RUNTIME_DIR": str(self.state / "runtime"),
            "JUPYTERLAB_SETTINGS_DIR": str(self.state / "settings"),
            "JUPYTERLAB_WORKSPACES_DIR": str(self.state / "workspaces"),
            "IPYTHONDIR": str(self.state / "ipython"),
            "PYTHONUNBUFFERED": "1",
        }

    def _arguments(self) -> list[str]:
        return [
            "--no-browser",
            "--allow-root",
            "--ip=127.0.0.1",
            f"--port={self.port}",
            "--ServerApp.port_retries=0",
            f"--ServerApp.root_dir={self.root}",
            f"--IdentityProvider.token={self.token}",
            "--expose-app-in-browser",  # window.jupyterapp, by which commands are run
            "--LabApp.news_url=None",
            "--LabApp.check_for_updates_class=jupyterlab.NeverCheckForUpdate",
            "--LabApp.extension_manager=readonly",
            "--KernelSpecManager.ensure_native_kernel=True",
        ]


class Notebook:
    """A notebook in a page of JupyterLab; one at a time is open in a page.

    Parameters
    ----------
    page
        A page of ``open_lab``.
    name
        Of a file in the folder of the server.
    width, height
        Of the window, in pixels.
    """

    # The kernel of the notebook that is open, in JavaScript.
    KERNEL = _KERNEL

    def __init__(self, page: Any, name: str, width: int = 1280, height: int = 900) -> None:
        self.page, self.name = page, name
        self.page_errors: list[str] = []
        self.page.on("pageerror", self._keep_error)
        self.page.set_viewport_size({"width": width, "height": height})
        self.page.mouse.move(0, 0)  # what is under the mouse would show its card
        self._close_all()
        self.page.evaluate(
            """async path => {
                const widget = await jupyterapp.commands.execute('docmanager:open', { path, factory: 'Notebook' });
                await widget.context.ready;
                await widget.revealed;
            }""",
            name,
        )
        self.page.wait_for_selector(".jp-Notebook .jp-Cell")
        self.wait_idle()

    def wait_idle(self) -> None:
        """Return when the kernel has nothing to do."""
        self.page.wait_for_function(f"() => {_KERNEL}?.status === 'idle'", timeout=CELLS_TIMEOUT_MS)

    def run_all(self) -> None:
        """Run every cell; AssertionError with the traceback if one failed."""
        self.page.evaluate("() => jupyterapp.commands.execute('notebook:run-all-cells')")
        self.wait_idle()
        self.check_outputs()

    def check_outputs(self) -> None:
        """Raise AssertionError with the traceback if a cell has failed."""
        failed = self.page.evaluate(
            """() => jupyterapp.shell.currentWidget.content.widgets
                .flatMap(cell => cell.model.outputs?.toJSON() ?? [])
                .filter(output => output.output_type === 'error')
                .map(output => output.traceback.join('\\n'))"""
        )
        assert not failed, "\n".join(failed)

    def save(self) -> None:
        """Save the notebook, again if an output came meanwhile."""
        self.page.evaluate(
            """async () => {
                do await jupyterapp.commands.execute('docmanager:save');
                while (jupyterapp.shell.currentWidget.context.model.dirty);
            }"""
        )

    def start(self, code: str) -> None:
        """Begin to run code in the kernel outside of any cell, and return at once."""
        self.page.evaluate(
            f"""code => {{
                window.isRunning = true;
                const future = {_KERNEL}.requestExecute({{ code, store_history: false }});
                future.done.then(() => {{ window.isRunning = false; }});
            }}""",
            code,
        )

    @property
    def is_running(self) -> bool:
        """Whether what was started has not come to its end; the kernel's status tells of other threads, too."""
        return bool(self.page.evaluate("() => window.isRunning"))

    def execute(self, code: str) -> str:
        """Run code in the kernel outside of any cell; return what it printed, or its traceback."""
        printed = self.page.evaluate(
            f"""async code => {{
                const future = {_KERNEL}.requestExecute({{ code, store_history: false }});
                let text = '';
                future.onIOPub = message => {{
                    if (message.header.msg_type === 'stream') text += message.content.text;
                    if (message.header.msg_type === 'error') text += message.content.traceback.join('\\n');
                }};
                await future.done;
                return text;
            }}""",
            code,
        )
        return str(printed)

    def echo_ms(self, count: int) -> list[float]:
        """Return how long an empty request to the kernel and back takes, ``count`` times."""
        times: list[float] = self.page.evaluate(
            f"""async count => {{
                const times = [];
                for (let i = 0; i < count; i++) {{
                    const start = performance.now();
                    await {_KERNEL}.requestExecute({{ code: '', silent: true }}).done;
                    times.push(performance.now() - start);
                }}
                return times;
            }}""",
            count,
        )
        return times

    def render_all(self) -> None:
        """Scroll through the notebook: JupyterLab renders what comes into view."""
        for cell in self.page.locator(".jp-Notebook .jp-Cell").all():
            cell.scroll_into_view_if_needed()

    def each_theme(self) -> Iterator[str]:
        """Show JupyterLab in its light and in its dark theme, as its menu does; at the end in the one it had."""
        before = self.page.evaluate("() => document.body.dataset.jpThemeName")
        for theme in THEMES:
            self._set_theme(THEMES[theme])
            yield theme
        self._set_theme(before)

    def close(self) -> None:
        """End the kernel and close the notebook; what was not saved is lost."""
        self._close_all()
        self.page.remove_listener("pageerror", self._keep_error)

    def _close_all(self) -> None:
        self.page.evaluate(
            """async () => {
                for (const widget of [...jupyterapp.shell.widgets('main')].filter(each => each.sessionContext)) {
                    await widget.sessionContext.shutdown();
                    widget.dispose();
                }
            }"""
        )
        self.page.wait_for_function("() => !document.querySelector('.jp-Notebook')")

    def _set_theme(self, name: str) -> None:
        self.page.evaluate("theme => jupyterapp.commands.execute('apputils:change-theme', { theme })", name)
        self.page.wait_for_function("theme => document.body.dataset.jpThemeName === theme", arg=name)

    def _keep_error(self, error: Any) -> None:
        if not _SPLASH_REMOVED_AGAIN.search(error.stack or ""):
            self.page_errors.append(error.stack or str(error))


def write_notebook(path: Path, *cells: str) -> None:
    """Write a notebook with these cells of code, which names its kernel: JupyterLab would ask for one."""
    import nbformat  # takes seconds

    code = [nbformat.v4.new_code_cell(cell) for cell in cells]
    metadata = {"kernelspec": {"name": "python3", "display_name": "Python 3"}}
    nbformat.write(nbformat.v4.new_notebook(cells=code, metadata=metadata), path)


@contextmanager
def running_notebook(page: Any, path: Path, *cells: str, width: int = 1280, height: int = 900) -> Iterator[Notebook]:
    """Write a notebook with these cells of code, open it in a page of `open_lab` and run it; close it at the end."""
    write_notebook(path, *(cell.strip() for cell in cells))
    notebook = Notebook(page, path.name, width, height)
    try:
        notebook.run_all()
        yield notebook
    finally:
        notebook.close()


def open_page(browser: Any, **options: Any) -> Any:
    """Open a page in a context of its own, with the time-out of all waits and no transitions of colours.

    Close it with ``page.context.close()``.
    """
    context = browser.new_context(reduced_motion="reduce", **options)
    context.set_default_timeout(TIMEOUT_MS)
    return context.new_page()


def open_lab(browser: Any, lab: JupyterLab) -> Any:
    """Open JupyterLab in a page, with the file browser folded away."""
    page = open_page(browser)
    page.goto(lab.url)
    wait_for_lab(page)
    page.evaluate("() => jupyterapp.commands.execute('application:toggle-left-area')")
    page.wait_for_selector("#jp-left-stack", state="hidden")
    return page


def wait_for_lab(page: Any) -> None:
    """Return when JupyterLab takes commands."""
    page.wait_for_function("() => window.jupyterapp?.restored.then(() => true)")


def browser_path() -> str:
    """Return where Chromium is; RuntimeError if it is nowhere."""
    path = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, _BROWSERS)), None)
    if path is None:
        raise RuntimeError(
            "No Chromium was found. Install one (apt install chromium-headless-shell, or chromium), or name it: "
            "CHROMIUM=/path/to/chromium."
        )
    return path


@contextmanager
def chromium() -> Iterator[Any]:
    """Give a headless Chromium, driven by Playwright."""
    from playwright.sync_api import sync_playwright

    path = browser_path()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, headless=True, args=_FLAGS)
        try:
            yield browser
        finally:
            browser.close()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
