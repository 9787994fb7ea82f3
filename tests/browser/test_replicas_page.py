"""The live page of one replica shows them all."""

from __future__ import annotations

import pytest

from epypes.service import Service
from epypes.service.http import HttpServer
from epypes.service.replication.messages import Heartbeat
from tests.browser.contrast import schemes, unreadable
from tests.browser.jupyter import open_page
from tests.service.replicated import publish_to_replicas
from tests.service.served import acting_bundle, until
from tests.service.test_brokered import line_of

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def replicas(tmp_path_factory):
    """Two replicas with their control, and what sends them events."""
    folder = tmp_path_factory.mktemp("replicas")
    bundle = acting_bundle(folder / "acting")
    with pytest.MonkeyPatch.context() as own:
        own.setenv("XDG_STATE_HOME", str(folder / "state"))
        with line_of("replicas-page") as line:
            first = Service(bundle, line.sub, line.pub, replica="1")
            second = Service(bundle, line.sub, line.pub, replica="2")
            with (
                HttpServer(first, "127.0.0.1:*", access_key_file=folder / "first") as at_first,
                HttpServer(second, "127.0.0.1:*", access_key_file=folder / "second") as at_second,
            ):
                first.http, second.http = at_first.url, at_second.url
                with first:
                    yield line, first, second


def rows(page):
    return [row.inner_text().split("\t") for row in page.locator("#replicas tbody tr").all()]


def test_the_page_shows_the_replicas_when_there_is_more_than_one(browser, replicas):
    line, first, second = replicas
    page = open_page(browser, viewport={"width": 1400, "height": 1000})
    try:
        errors = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(first.http)
        page.wait_for_selector("#state:has-text('READY')")
        assert page.locator("#replicas-section").is_hidden()
        with second:
            until(lambda: first.group()["replicas"] == 2)
            for number in range(20):
                line.send(number=number)
            line.take(20)
            page.wait_for_selector("#replicas tbody tr:nth-child(2)")
            page.wait_for_selector("#replicas-note:has-text('2 of 2 are ready')")
            assert [row[0] for row in rows(page)] == ["1 this one", "2"]
            assert page.locator("#replicas tbody a").get_attribute("href") == second.http
            answered = sum(replica.counts()["answered"] for replica in (first, second))
            page.wait_for_selector(f"#replicas-note:has-text('answered {answered} events')")
            for scheme in schemes(page):
                assert unreadable(page, "#replicas-section") == [], scheme
            second.pause()
            page.wait_for_selector("#replicas tbody tr:nth-child(2) .badge.warn:has-text('PAUSED')")
            second.resume()
        page.wait_for_selector("#replicas-section", state="hidden")
        assert errors == []
    finally:
        page.context.close()


def test_the_page_shows_a_lost_replica(browser, replicas):
    line, first, _ = replicas
    page = open_page(browser, viewport={"width": 1400, "height": 1000})
    try:
        page.goto(first.http)
        publish_to_replicas(line.sub, Heartbeat("silent", replica="2", host="elsewhere", counts={"answered": 0}))
        page.wait_for_selector("#replicas tbody tr:nth-child(2) .badge.error:has-text('LOST')")
        assert "it did not stop in order; its counts are of then" in rows(page)[1][1]
        assert page.locator("#replicas tbody a").count() == 0, "it does not answer"
        for scheme in schemes(page):
            assert unreadable(page, "#replicas-section") == [], scheme
    finally:
        page.context.close()
