"""How does a test run what wants an event loop of its own, while a browser of another test has one on this thread?"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Result = TypeVar("Result")


def apart(function: Callable[[], Result]) -> Result:
    """Return what a function returns that is called on a thread of its own."""
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(function).result()
