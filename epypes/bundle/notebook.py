"""Promotion of a notebook file: it is executed in a new kernel, and its graph is promoted there.

The kernel sends the progress, and the reasons against a promotion, as displayed data of a type of its own.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from epypes.bundle.promote import promote
from epypes.errors import BundleError, EpypesError, PromotionRefused, UnknownName
from epypes.optional import optional_import
from epypes.pipeline import Pipeline
from epypes.run import CompGraphRunner

_MEDIA_TYPE: Final = "application/vnd.epypes.promotion+json"


def promote_notebook(
    notebook: str | Path,
    name: str,
    to: str | Path,
    outputs: Sequence[str] | None = None,
    on_cell: Callable[[int, int], None] = lambda done, total: None,
    on_progress: Callable[[str], None] = lambda text: None,
    samples: Sequence[str] = (),
) -> None:
    """Execute every cell of a notebook in a new kernel of this Python, then promote one of its objects there.

    Parameters
    ----------
    notebook
        An ``.ipynb`` file; it is not changed.
    name
        The variable that holds the runner or pipeline.
    to, outputs
        As for ``promote``.
    on_cell
        Called with the number of code cells done and their total.
    on_progress
        Called with what the promotion in the kernel is doing.
    samples
        The variables that hold further payloads, as ``promote`` takes them, or lists of such.

    Raises
    ------
    BundleError
        The file can't be read, or a cell raises; the cell is named.
    PromotionRefused
        The graph can't be promoted, or there is no such variable.
    """
    given = name, str(Path(to).resolve()), None if outputs is None else list(outputs), list(samples)
    last_cell = f"from epypes.bundle.notebook import promote_here as _promote_here\n_promote_here{given!r}"
    reasons: list[str] = []

    def on_message(message: Mapping[str, Any]) -> None:
        if "progress" in message:
            on_progress(message["progress"])
        reasons.extend(message.get("reasons", ()))

    _execute(Path(notebook), last_cell, on_cell, on_message)
    if reasons:
        raise PromotionRefused(to, reasons)


def _execute(
    path: Path,
    last_cell: str,
    on_cell: Callable[[int, int], None],
    on_message: Callable[[Mapping[str, Any]], None],
) -> None:
    """Execute a notebook and one cell more, and pass on what is displayed with our media type."""
    with optional_import():
        import nbformat
        from nbclient import NotebookClient
        from nbclient.exceptions import CellExecutionError, DeadKernelError

    class Client(NotebookClient):  # type: ignore[misc]
        def process_message(self, msg: dict[str, Any], cell: Any, cell_index: int) -> Any:
            if _MEDIA_TYPE in msg["content"].get("data", ()):
                on_message(msg["content"]["data"][_MEDIA_TYPE])
            return super().process_message(msg, cell, cell_index)

    try:
        document = nbformat.read(path, as_version=4)
    except OSError as error:
        raise BundleError(path, f"Notebook {path} can't be read: {error.strerror or error}.") from error
    except Exception as error:  # nbformat raises its own and json's errors for what is no notebook
        reason = f"{type(error).__name__}: {error}".replace("\n", " ")[:120]
        raise BundleError(path, f"{path} is not a notebook that Jupyter opens: {reason}") from error
    total = sum(cell.cell_type == "code" for cell in document.cells)
    document.cells.append(nbformat.v4.new_code_cell(last_cell))
    done = 0

    def cell_executed(cell: Any, cell_index: int, **_: Any) -> None:
        nonlocal done
        done += 1
        on_cell(min(done, total), total)

    with tempfile.TemporaryDirectory(prefix="epypes-promote-") as scratch:
        client = Client(
            document,
            timeout=None,
            kernel_name="python3",
            resources={"metadata": {"path": str(path.resolve().parent)}},
            on_cell_executed=cell_executed,
        )
        # Sockets in a folder of this user: over TCP others on the machine could listen.
        client.config.KernelManager.transport = "ipc"
        client.config.KernelManager.ip = str(Path(scratch) / "kernel")
        try:
            client.execute()
        except CellExecutionError as error:
            text = f"{path}: code cell {done} of {total} raised {error.ename}: {error.evalue}"
            raise BundleError(path, text) from error
        except DeadKernelError as error:
            raise BundleError(path, f"{path}: the kernel died in code cell {done + 1} of {total}.") from error


def promote_here(name: str, to: str, outputs: Sequence[str] | None, samples: Sequence[str]) -> None:
    """Promote a variable of the notebook that this kernel runs; display the progress and the reasons against it."""
    from IPython.display import display

    def send(**message: Any) -> None:
        display({_MEDIA_TYPE: message}, raw=True)

    names = vars(sys.modules["__main__"])
    try:
        if name not in names:
            known = [key for key, value in names.items() if isinstance(value, CompGraphRunner | Pipeline)]
            raise UnknownName("variable", name, known, "that holds a runner or pipeline in the notebook")
        payloads = _payloads(names, samples)
        promote(names[name], to, outputs, samples=payloads, on_progress=lambda text: send(progress=text))
    except EpypesError as error:
        send(reasons=list(error.reasons) if isinstance(error, PromotionRefused) else [str(error)])


def _payloads(names: Mapping[str, Any], variables: Sequence[str]) -> list[Any]:
    """Return the payloads that variables hold: one, or those of a list or tuple."""
    found: list[Any] = []
    for name in variables:
        if name not in names:
            known = [key for key, value in names.items() if not key.startswith("_") and not callable(value)]
            raise UnknownName("variable", name, known, "that holds a payload in the notebook")
        found += names[name] if isinstance(names[name], list | tuple) else [names[name]]
    return found
