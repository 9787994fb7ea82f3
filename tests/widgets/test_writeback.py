"""Is it shown what writing back would change before it changes anything, and told what came of it?"""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import pytest

from epypes.errors import ServiceError
from epypes_widgets.writeback import WritingBack, Written

TIMEOUT_S = 60.0
DIFF = "--- pipeline.toml\n+++ pipeline.toml\n-value = 70\n+value = 60\n"


class Service:
    """Writes back what a test says."""

    def __init__(self, diff: str = DIFF, error: Exception | None = None) -> None:
        self.diff, self.error, self.asked = diff, error, []  # type: ignore[var-annotated]
        self.may_end = threading.Event()
        self.may_end.set()

    def write_back(self, dry_run: bool = False) -> Any:
        self.asked.append(dry_run)
        assert self.may_end.wait(TIMEOUT_S)
        if self.error is not None:
            raise self.error
        return SimpleNamespace(diff=self.diff, digest="3f" * 32)


@pytest.fixture
def told() -> list[Written]:
    return []


@pytest.fixture
def back(told: list[Written]) -> WritingBack:
    return WritingBack(told.append)


def test_a_dry_run_shows_the_differences_and_writing_tells_the_digest(back: WritingBack, told: list[Written]) -> None:
    service = Service()
    assert back.start(service, dry_run=True)
    assert back.wait(TIMEOUT_S) == Written("diff", "This would change in pipeline.toml.", DIFF)
    assert back.start(service, dry_run=False)
    done = back.wait(TIMEOUT_S)
    assert done == Written("done", "Written to pipeline.toml and replayed; the bundle is 3f3f3f3f3f3f now.", DIFF)
    assert [each.state for each in told] == ["running", "diff", "running", "done"]
    assert service.asked == [True, False]


def test_without_differences_nothing_is_asked(back: WritingBack) -> None:
    back.start(Service(diff=""), dry_run=True)
    done = back.wait(TIMEOUT_S)
    assert done == Written("done", "pipeline.toml has these values already; the bundle is 3f3f3f3f3f3f.")


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (ServiceError("x", "The replay differs."), "Not written: The replay differs."),
        (ValueError("oh"), "Not written: ValueError: oh"),
    ],
)
def test_a_refusal_is_told(back: WritingBack, error: Exception, text: str) -> None:
    back.start(Service(error=error), dry_run=False)
    assert back.wait(TIMEOUT_S) == Written("refused", text)


def test_one_is_written_at_a_time(back: WritingBack) -> None:
    service = Service()
    service.may_end.clear()
    assert back.start(service, dry_run=True)
    assert not back.start(service, dry_run=False)
    service.may_end.set()
    back.wait(TIMEOUT_S)
    assert service.asked == [True]
