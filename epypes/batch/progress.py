"""Progress bars, on standard error or as text below a cell."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any, Final

from epypes.optional import optional_import

# Takes how many more are done, and how many of these have failed.
Advance = Callable[[int, int], None]


@contextmanager
def progress_bar(progress: bool | None, total: int | None, what: str, *, unit: str = "image") -> Iterator[Advance]:
    """Show a bar on standard error, or below the cell of a notebook, and yield what moves it on.

    Parameters
    ----------
    progress
        Whether there is one; None: in a terminal or a notebook, if tqdm is installed.
    total
        How many there will be; None if that is not known.
    what
        What is written before the bar.
    unit
        What is counted.
    """
    is_seen = find_spec("tqdm") is not None and _is_seen() if progress is None else progress
    if not is_seen:
        yield lambda count, failures: None
        return
    with optional_import():
        from tqdm import tqdm
    failed = 0
    with tqdm(total=total, desc=what, unit=unit, file=_Cell() if _is_in_notebook() else sys.stderr) as bar:

        def advance(count: int, failures: int) -> None:
            nonlocal failed
            failed += failures
            if failures:
                bar.set_postfix(failed=failed, refresh=False)
            bar.update(count)

        yield advance


class _Cell:
    """A file below a cell of a notebook, of which the last line is seen.

    Text, and no widget: a saved notebook shows how it ended, without a kernel.
    """

    # So that the bar is drawn in blocks.
    encoding: Final = "utf-8"

    def __init__(self) -> None:
        self._shown: Any = None

    def write(self, text: str) -> None:
        """Show a line in the place of the one before."""
        import IPython.display

        line = {"text/plain": text.strip()}
        if not line["text/plain"]:
            return
        if self._shown is None:
            self._shown = IPython.display.display(line, raw=True, display_id=True)
        else:
            self._shown.update(line, raw=True)

    def flush(self) -> None:
        """Do nothing: each line is shown at once."""


def _is_seen() -> bool:
    return sys.stderr is not None and (sys.stderr.isatty() or _is_in_notebook())


def _is_in_notebook() -> bool:
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return getattr(shell, "kernel", None) is not None
