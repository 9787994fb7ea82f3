"""How far is it?"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from epypes.errors import ScaleError
from epypes.scale.needed import needed

# Takes how many more are done, and how many of these have failed.
Advance = Callable[[int, int], None]


@contextmanager
def progress_bar(progress: bool | None, total: int | None, what: str, *, unit: str = "image") -> Iterator[Advance]:
    """Show a bar on standard error, or in the notebook, and yield what moves it on.

    Parameters
    ----------
    progress
        Whether there is one; None: where somebody sees it, in a terminal or a notebook, if tqdm is installed.
    total
        How many there will be; None if that is not known.
    what
        What is written before the bar.
    unit
        What is counted.
    """
    if progress is False or (progress is None and not _is_seen()):
        yield _tell_nobody
        return
    try:
        tqdm = needed("tqdm.auto").tqdm
    except ScaleError:
        if progress:
            raise
        yield _tell_nobody
        return
    failed = 0
    with tqdm(total=total, desc=what, unit=unit) as bar:

        def advance(count: int, failures: int) -> None:
            nonlocal failed
            failed += failures
            if failures:
                bar.set_postfix(failed=failed, refresh=False)
            bar.update(count)

        yield advance


def _tell_nobody(count: int, failures: int) -> None:
    """Take how far it is, where nobody wants to know."""


def _is_seen() -> bool:
    return sys.stderr is not None and (sys.stderr.isatty() or _is_in_notebook())


def _is_in_notebook() -> bool:
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return getattr(shell, "kernel", None) is not None
