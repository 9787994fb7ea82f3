"""Promotion of a notebook file: it is executed in a new kernel, and its graph is promoted there."""

from __future__ import annotations

import json
import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from epypes.bundle.promote import promote
from epypes.errors import BundleError, EpypesError, PromotionRefused, UnknownName
from epypes.optional import optional_import
from epypes.pipeline import Pipeline
from epypes.run import CompGraphRunner

Progress = Callable[[int, int], None]
OnText = Callable[[str], None]


def promote_notebook(
    notebook: str | Path,
    name: str,
    to: str | Path,
    outputs: Sequence[str] | None = None,
    on_cell: Progress = lambda done, total: None,
    on_progress: OnText = lambda text: None,
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
        Called on a thread of its own with what the promotion in the kernel is doing.
    samples
        The variables that hold further payloads, as ``promote`` takes them, or lists of such.

    Raises
    ------
    BundleError
        The file can't be read, or a cell raises; the cell is named.
    PromotionRefused
        The graph can't be promoted, or there is no such variable.
    """
    path = Path(notebook)
    with tempfile.TemporaryDirectory(prefix="epypes-promote-") as scratch:
        outcome = Path(scratch) / "outcome.json"
        code = (
            "from epypes.bundle.notebook import promote_here as _promote_here\n"
            f"_promote_here({name!r}, {str(Path(to).resolve())!r}, "
            f"{None if outputs is None else list(outputs)!r}, {str(outcome)!r}, {str(Path(scratch) / 'progress')!r}, "
            f"{list(samples)!r})"
        )
        with _lines_of(Path(scratch) / "progress", on_progress):
            _execute(path, code, on_cell, Path(scratch))
        ended = json.loads(outcome.read_text(encoding="utf-8"))
    if ended["reasons"]:
        raise PromotionRefused(to, ended["reasons"])


@contextmanager
def _lines_of(pipe: Path, on_line: OnText) -> Iterator[None]:
    """While the block runs, pass on every line that is written into a named pipe."""
    os.mkfifo(pipe)
    # Opened for both, it opens at once, and does not end when the kernel closes its side.
    descriptor = os.open(pipe, os.O_RDWR)

    def read() -> None:
        with os.fdopen(descriptor, encoding="utf-8", closefd=False) as lines:
            for line in iter(lines.readline, "\n"):
                on_line(line.rstrip("\n"))

    reader = threading.Thread(target=read, name="epypes-promotion-progress", daemon=True)
    reader.start()
    try:
        yield
    finally:
        os.write(descriptor, b"\n")
        reader.join()
        os.close(descriptor)


def _execute(path: Path, last_cell: str, on_cell: Progress, scratch: Path) -> None:
    with optional_import():
        import nbformat
        from nbclient import NotebookClient
        from nbclient.exceptions import CellExecutionError, DeadKernelError

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

    client = NotebookClient(
        document,
        timeout=None,
        kernel_name="python3",
        resources={"metadata": {"path": str(path.resolve().parent)}},
        on_cell_executed=cell_executed,
    )
    # Sockets in a folder of this user: over TCP others on the machine could listen.
    client.config.KernelManager.transport = "ipc"
    client.config.KernelManager.ip = str(scratch / "kernel")
    try:
        client.execute()
    except CellExecutionError as error:
        text = f"{path}: code cell {done} of {total} raised {error.ename}: {error.evalue}"
        raise BundleError(path, text) from error
    except DeadKernelError as error:
        raise BundleError(path, f"{path}: the kernel died in code cell {done + 1} of {total}.") from error


def promote_here(
    name: str, to: str, outputs: Sequence[str] | None, outcome: str, pipe: str, samples: Sequence[str] = ()
) -> None:
    """Promote a variable of the notebook that this kernel runs; write the reasons against it, if any, as JSON."""

    def on_progress(text: str) -> None:
        with open(pipe, "w", encoding="utf-8") as file:
            file.write(" ".join(text.split()) + "\n")

    names = vars(sys.modules["__main__"])
    try:
        if name not in names:
            known = [key for key, value in names.items() if isinstance(value, CompGraphRunner | Pipeline)]
            raise UnknownName("variable", name, known, "that holds a runner or pipeline in the notebook")
        promote(names[name], to, outputs, samples=_payloads(names, samples), on_progress=on_progress)
    except PromotionRefused as refused:
        reasons = list(refused.reasons)
    except EpypesError as error:
        reasons = [str(error)]
    else:
        reasons = []
    Path(outcome).write_text(json.dumps({"reasons": reasons}), encoding="utf-8")


def _payloads(names: Mapping[str, Any], variables: Sequence[str]) -> list[Any]:
    """Return the payloads that variables hold: one, or those of a list or tuple."""
    found: list[Any] = []
    for name in variables:
        if name not in names:
            known = [key for key, value in names.items() if not key.startswith("_") and not callable(value)]
            raise UnknownName("variable", name, known, "that holds a payload in the notebook")
        found += names[name] if isinstance(names[name], list | tuple) else [names[name]]
    return found
