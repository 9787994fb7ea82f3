"""Is it shown what writing back would change before it changes anything, and told what came of it?"""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import pytest

from epypes.errors import ServiceError
from epypes_widgets.promotion import BundleJob, Outcome

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
def told() -> list[Outcome]:
    return []


class Back:
    """Writes the values of a service back, and keeps what is reported."""

    def __init__(self, service: Service, told: list[Outcome]) -> None:
        self._job, self._service = BundleJob(told.append), service

    def start(self, *, dry_run: bool) -> bool:
        return self._job.write_back(self._service.write_back, dry_run=dry_run)

    def wait(self, timeout_s: float) -> Outcome | None:
        return self._job.wait(timeout_s)


def test_a_dry_run_shows_the_differences_and_writing_tells_the_digest(told: list[Outcome]) -> None:
    service = Service()
    back = Back(service, told)
    assert back.start(dry_run=True)
    assert back.wait(TIMEOUT_S) == Outcome("written", "diff", "This would change in pipeline.toml.", diff=DIFF)
    assert back.start(dry_run=False)
    done = back.wait(TIMEOUT_S)
    assert done == Outcome(
        "written", "done", "Written to pipeline.toml and replayed; the bundle is 3f3f3f3f3f3f now.", diff=DIFF
    )
    assert [each.state for each in told] == ["running", "diff", "running", "done"]
    assert service.asked == [True, False]


def test_without_differences_nothing_is_asked(told: list[Outcome]) -> None:
    back = Back(Service(diff=""), told)
    back.start(dry_run=True)
    done = back.wait(TIMEOUT_S)
    assert done == Outcome("written", "done", "pipeline.toml has these values already; the bundle is 3f3f3f3f3f3f.")


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (ServiceError("x", "The replay differs."), "Not done: The replay differs."),
        (ValueError("oh"), "Not done: ValueError: oh"),
    ],
)
def test_a_refusal_is_told(told: list[Outcome], error: Exception, text: str) -> None:
    back = Back(Service(error=error), told)
    back.start(dry_run=False)
    assert back.wait(TIMEOUT_S) == Outcome("written", "refused", text)


def test_one_is_written_at_a_time(told: list[Outcome]) -> None:
    service = Service()
    back = Back(service, told)
    service.may_end.clear()
    assert back.start(dry_run=True)
    assert not back.start(dry_run=False)
    service.may_end.set()
    back.wait(TIMEOUT_S)
    assert service.asked == [True]
