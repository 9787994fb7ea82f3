"""What starts with a ``with`` block, and stops at its end? What sends and what receives messages."""

from __future__ import annotations

from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self


class Within(ABC):
    """Is started at the beginning of a ``with`` block, and stopped at its end, whatever happens in it."""

    @abstractmethod
    def start(self) -> Self:
        """Begin; nothing happens if it runs already."""

    @abstractmethod
    def stop(self, timeout_s: float = 5.0) -> None:
        """End; as often as you like."""

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
