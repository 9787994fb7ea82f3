"""Progress bars: lines of text on standard error, no widgets, so that a saved notebook shows how they ended."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from epypes.optional import optional_import

# Takes how many more are done, and how many of these have failed.
Advance = Callable[[int, int], None]


@contextmanager
def progress_bar(progress: bool | None, total: int | None, what: str, *, unit: str = "image") -> Iterator[Advance]:
    """Show a bar on standard error, which a notebook shows below the cell, and yield what moves it on.

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
    with tqdm(total=total, desc=what, unit=unit, file=sys.stderr) as bar:

        def advance(count: int, failures: int) -> None:
            nonlocal failed
            failed += failures
            if failures:
                bar.set_postfix(failed=failed, refresh=False)
            bar.update(count)

        yield advance


def _is_seen() -> bool:
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return sys.stderr is not None and (sys.stderr.isatty() or getattr(shell, "kernel", None) is not None)
