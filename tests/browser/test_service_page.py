"""The live page of a service shows what happens, and does what the user asks for."""

from __future__ import annotations

import re
import shutil
import threading
from contextlib import contextmanager

import httpx
import pytest

from epypes.bundle.adapters import REQUEST
from epypes.bundle.manifest import write_manifest
from epypes.service import Service
from epypes.service.http import HttpServer
from epypes.wire import Envelope
from tests.browser.contrast import schemes, unreadable
from tests.browser.jupyter import open_page
from tests.conftest import EDGE_HPARAMS
from tests.service.bundles import written_bundle
from tests.service.served import peer_of

pytestmark = pytest.mark.browser

RANGES = {
    "blur_kernel": "low = 1\nhigh = 31\nodd = true",
    "canny_lo": "low = 0\nhigh = 255",
    "canny_hi": 'low = 0\nhigh = 400\nunit = "grey levels"',
}


SOURCE = '''
    """The edges of a photograph."""

    import cv2


    def grayscale(im):
        return cv2.cvtColor(im, cv2.COLOR_BGR2GRAY)


    def blur(img, k):
        return cv2.GaussianBlur(img, (k, k), 0)


    func_dict = {"grayscale": grayscale, "blur": blur, "canny": cv2.Canny}
    func_io = {
        "grayscale": ("image", "image_gray"),
        "blur": (("image_gray", "blur_kernel"), "image_blurred"),
        "canny": (("image_blurred", "canny_lo", "canny_hi"), "edges"),
    }
'''


class Line:
    """A publisher that sends frames to a service until it is left, none while the service has one: none is dropped."""

    def __init__(self, service, peer, photograph):
        self._service, self._peer, self._photograph = service, peer, photograph
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._send, daemon=True)

    def _send(self):
        while not self._end.wait(0.04):
            counts = self._service.counts()
            if counts["waiting"] == counts["in_flight"] == 0:
                self._peer.requests.put(Envelope(type=REQUEST, parts={"image": self._photograph}))

    def fail(self):
        self._peer.requests.put(Envelope(type=REQUEST, parts={"image": "no image"}))

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *exception):
        self._end.set()
        self._thread.join()


@pytest.fixture(scope="module")
def bundle(tmp_path_factory, photograph, straight_edges):
    """The edge graph, whose parameters have ranges."""
    sample = {"image": photograph}, {"edges": straight_edges}
    folder = tmp_path_factory.mktemp("bundles") / "edges"
    written_bundle(folder, SOURCE, ["image"], ["edges"], hyperparameters=EDGE_HPARAMS, sample=sample)
    text = (folder / "pipeline.toml").read_text()
    for token, lines in RANGES.items():
        text = re.sub(rf"(\[hyperparameters\.{token}\]\nvalue = .*)", rf"\1\n{lines}", text)
    (folder / "pipeline.toml").write_text(text)
    write_manifest(folder)
    return folder


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    with pytest.MonkeyPatch.context() as own:
        for name in ("XDG_STATE_HOME", "XDG_RUNTIME_DIR"):
            own.setenv(name, str(tmp_path_factory.mktemp("home")))
        yield


@pytest.fixture(scope="module")
def served(bundle, photograph, home):
    with Service(bundle) as service, HttpServer(service, "127.0.0.1:*") as http, peer_of(service) as peer:
        http.access_key, http.failures = (
            http.access_key_file.read_text().strip(),
            service.info()["addresses"]["failures"],
        )
        with Line(service, peer, photograph) as line:
            yield service, http, line


def _is_complaint(message):
    # A busy service refuses a picture for now, and the page asks again.
    return message.type == "error" and "status of 503" not in message.text


@contextmanager
def page_of(browser, http, width=1400, access_key=True):
    """Open the page; whatever it complains of is a failure of the test."""
    page = open_page(browser, viewport={"width": width, "height": 1000})
    said = []
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("console", lambda message: said.append(message.text) if _is_complaint(message) else None)
    page.goto(f"{http.url}/?access_key={http.access_key}" if access_key else http.url)
    page.wait_for_selector("#graph svg")
    page.complaints = said
    yield page
    page.context.close()


def change(http, **values):
    """Change parameters as somebody else."""
    headers = {"Authorization": f"Bearer {http.access_key}"}
    answer = httpx.patch(f"{http.url}/v1/parameters", json={"values": values}, headers=headers, trust_env=False)
    assert answer.status_code == 200, answer.text


def state_is(page, state):
    page.wait_for_function("state => document.getElementById('state').textContent === state", arg=state)


def test_the_page_shows_the_running_service(browser, served):
    _, http, _ = served
    with page_of(browser, http) as page:
        state_is(page, "READY")
        page.wait_for_function("() => parseFloat(document.getElementById('rate').textContent) > 1")
        page.wait_for_function("() => /ms|µs/.test(document.getElementById('p95').textContent)")
        assert page.locator("#name").text_content() == "edges"
        assert page.locator("#graph [id^=token-]").count() == 7
        assert page.locator("#graph image").count() >= 4
        assert page.locator("#counts dd").first.text_content() != "0"
        assert "access_key" not in page.url
        assert http.failures in page.locator("#facts").text_content()
        for scheme in schemes(page):
            assert not unreadable(page, "body"), scheme
        assert not page.complaints


def test_a_narrow_page_needs_no_scrolling_sideways(browser, served):
    _, http, line = served
    line.fail()
    with page_of(browser, http, width=400) as page:
        page.wait_for_selector("#failures tbody tr")
        assert page.evaluate("() => document.documentElement.scrollWidth") <= 400


def test_the_picture_follows_the_runs_without_flicker(browser, served):
    _, http, _ = served
    with page_of(browser, http) as page:
        first = page.locator("#graph svg").get_attribute("aria-label")
        page.wait_for_function(
            "first => document.querySelector('#graph svg').getAttribute('aria-label') !== first", arg=first
        )
        heights = page.evaluate(
            """async () => {
                const found = new Set();
                for (let i = 0; i < 60; i++) {
                    found.add(document.getElementById('graph').getBoundingClientRect().height);
                    await new Promise(requestAnimationFrame);
                }
                return [...found];
            }"""
        )
        assert len(heights) == 1


def test_a_token_is_seen_larger_by_mouse_and_by_keyboard(browser, served):
    _, http, _ = served
    with page_of(browser, http) as page:
        page.locator("#token-edges").click()
        page.wait_for_selector("#look[open] img")
        assert page.locator("#look-title").text_content() == "edges"
        assert page.locator("#look img").evaluate("image => image.naturalWidth") > 500
        page.keyboard.press("Escape")
        page.wait_for_selector("#look", state="hidden")
        page.locator("#token-canny_lo").focus()
        page.keyboard.press("Enter")
        page.wait_for_selector("#look[open] pre")
        assert not page.complaints


def test_a_token_chosen_at_once_after_another_was_closed_is_seen(browser, served):
    _, http, _ = served
    with page_of(browser, http) as page:
        page.locator("#token-edges").click()
        page.wait_for_selector("#look[open] img")
        page.evaluate(
            """() => {
                document.getElementById('look').close();
                document.getElementById('token-canny_lo').dispatchEvent(new MouseEvent('click', {bubbles: true}));
            }"""
        )
        page.wait_for_selector("#look[open] pre")
        assert page.locator("#look-title").text_content() == "canny_lo"


def test_parameters_are_applied_all_at_once(browser, served):
    service, http, _ = served
    change(http, canny_lo=70, blur_kernel=11)
    with page_of(browser, http) as page:
        page.wait_for_selector("#parameter-canny_lo")
        page.locator("#parameter-canny_lo").fill("90")
        page.locator("#parameter-blur_kernel").fill("5")
        assert page.locator(".field.changed").count() == 2
        assert "70 in the service" in page.locator("#parameter-canny_lo-note").text_content()
        assert page.locator("#apply").text_content() == "Apply 2"
        before = service.parameters().revision
        page.locator("#apply").click()
        page.wait_for_function("() => document.querySelectorAll('.field.changed').length === 0")
        now = service.parameters()
        assert now.revision == before + 1
        assert (now.entries["canny_lo"]["value"], now.entries["blur_kernel"]["value"]) == (90, 5)
        page.locator("#parameter-blur_kernel").evaluate(
            "box => { box.value = '4'; box.dispatchEvent(new Event('input', { bubbles: true })) }"
        )
        page.locator("#parameters").evaluate("form => { form.noValidate = true; form.requestSubmit() }")
        page.wait_for_selector(".field.refused")
        assert "odd" in page.locator("#parameter-blur_kernel-note").text_content()
        assert service.parameters() == now
        page.locator("#undo").click()
        assert page.locator("#parameter-blur_kernel").input_value() == "5"


def test_a_number_that_is_whole_and_may_have_a_fraction_is_given_one(browser, bundle, home, tmp_path):
    folder = shutil.copytree(bundle, tmp_path / "edges")
    text = (folder / "pipeline.toml").read_text()
    text = re.sub(r"value = 200\nlow.*\nhigh.*", "value = 200.0\nsoft = [0.0, 400.0]", text)
    (folder / "pipeline.toml").write_text(text)
    write_manifest(folder)
    with Service(folder) as service, HttpServer(service, "127.0.0.1:*") as http:
        http.access_key = http.access_key_file.read_text().strip()
        with page_of(browser, http) as page:
            page.wait_for_function("() => document.getElementById('graph-note').textContent.startsWith('Waiting for')")
            address = service.info()["addresses"]["sub"]
            assert page.locator("#graph-note").text_content() == f"Waiting for the first event at {address}."
            for text in ("150.25", "151"):
                page.locator("#parameter-canny_hi").fill(text)
                page.locator("#apply").click()
                page.wait_for_function("() => document.querySelectorAll('.field.changed').length === 0")
                assert service.parameters().entries["canny_hi"]["value"] == float(text)
            assert page.locator("#parameters input[type=range]").count() == 3
            change(http, canny_hi=150)  # told by an event, which JSON takes for whole too
            page.wait_for_function("() => document.getElementById('parameter-canny_hi').value === '150'")
            assert page.locator("#parameter-canny_hi").get_attribute("step") == "any"


def test_what_somebody_else_changed_is_shown_and_not_overwritten(browser, served):
    service, http, _ = served
    change(http, canny_lo=70, canny_hi=200)
    with page_of(browser, http) as page:
        page.wait_for_selector("#parameter-canny_lo")
        # What is told of a change arrives after this one was asked for.
        page.route("**/v1/parameters", lambda route: (change(http, canny_lo=33, canny_hi=150), route.continue_()))
        page.locator("#parameter-canny_lo").fill("90")
        page.locator("#apply").click()
        page.wait_for_selector("#parameters-note:not([hidden])")
        page.unroute("**/v1/parameters")
        said = page.locator("#parameters-note").text_content()
        assert "Another client" in said
        assert "canny_lo: 70 → 33; canny_hi: 200 → 150" in said
        assert service.parameters().entries["canny_lo"]["value"] == 33
        assert page.locator("#parameter-canny_lo").input_value() == "90"
        assert page.locator("#parameter-canny_hi").input_value() == "150"
        assert "33 in the service" in page.locator("#parameter-canny_lo-note").text_content()
        page.locator("#apply").click()
        page.wait_for_function("() => document.querySelectorAll('.field.changed').length === 0")
        assert service.parameters().entries["canny_lo"]["value"] == 90


def test_a_failure_is_listed_with_what_opens_it_again(browser, served):
    _, http, line = served
    with page_of(browser, http) as page:
        rows = page.locator("#failures tbody tr").count()
        line.fail()
        page.wait_for_function("rows => document.querySelectorAll('#failures tbody tr').length > rows", arg=rows)
        name = page.locator("#failures tbody tr").first.get_attribute("data-id")
        row = page.locator(f"#failures tbody tr[data-id='{name}']")
        assert f"epypes replay {name} {http.url}" in row.text_content()
        assert f'ep.load_failure("{name}", "{http.url}")' in row.text_content()
        assert "grayscale" in row.text_content()
        page.context.grant_permissions(["clipboard-read", "clipboard-write"])
        row.locator("th a").click()
        page.wait_for_selector("#ask[open] pre")
        assert "in grayscale" in page.locator("#ask-title").text_content()
        assert "cvtColor" in page.locator("#ask pre").text_content()
        assert "canny_lo = " in page.locator("#ask .record").text_content()
        for scheme in schemes(page):
            assert not unreadable(page, "#ask"), scheme
        page.locator("#ask-no").click()
        row.locator("button").first.click()
        assert page.evaluate("() => navigator.clipboard.readText()") == f"epypes replay {name} {http.url}"


def test_without_the_access_key_nothing_can_be_changed_and_with_it_the_service_is_paused(browser, served):
    service, http, _ = served
    with page_of(browser, http, access_key=False) as page:
        state_is(page, "READY")
        assert page.locator("#pause").is_disabled()
        page.locator("#access-key").fill("x" * 43)
        page.locator("#access-key-form button").click()
        page.wait_for_selector("#notice:not([hidden])")
        assert "not the service's access key" in page.locator("#notice").text_content()
        assert page.locator("#pause").is_disabled()
        page.locator("#access-key").fill(http.access_key)
        page.locator("#access-key-form button").click()
        page.locator("#pause").click()
        state_is(page, "PAUSED")
        assert service.state == "PAUSED"
        page.locator("#resume").click()
        state_is(page, "READY")


@pytest.mark.parametrize("link", ["?access_key={}", "#token={}", "?access_key={}&other=1#part"])
def test_the_key_of_the_link_is_kept_in_the_tab_and_in_no_address(browser, served, link):
    _, http, _ = served
    with page_of(browser, http, access_key=False) as page:
        requested = []
        page.on("request", lambda request: requested.append(request.url))
        page.goto("about:blank")
        page.goto(f"{http.url}/{link.format(http.access_key)}")
        page.wait_for_function("() => document.getElementById('access-key-hint').textContent.includes('is right')")
        assert http.access_key not in page.url
        assert http.access_key not in page.evaluate("() => location.href + JSON.stringify(history.state)")
        assert [url for url in requested if http.access_key in url][1:] == []
        page.reload()
        page.wait_for_selector("#pause:enabled")
        page.locator("#access-key-form button").click()
        page.wait_for_selector("#pause:disabled")
        assert not page.complaints


def test_a_button_that_can_not_be_used_says_why_beside_it(browser, served):
    _, http, _ = served
    operation, parameters = "#operation-why", "#parameters-why"
    with page_of(browser, http, access_key=False) as page:
        state_is(page, "READY")
        assert page.locator(operation).text_content() == "These need the access key."
        page.wait_for_selector("#parameter-canny_lo")
        nothing = "Apply and Undo: nothing is changed here."
        assert page.locator(parameters).text_content() == f"{nothing} Write back needs the access key."
        page.locator("#parameter-canny_lo").fill("91")
        assert page.locator(parameters).text_content() == "Apply and Write back need the access key."
        for scheme in schemes(page):
            assert not unreadable(page, "body"), scheme
    with page_of(browser, http) as page:
        page.wait_for_selector("#pause:enabled")
        assert page.locator(operation).text_content() == "Resume: not while READY."
        page.wait_for_selector("#parameter-canny_lo")
        assert page.locator(parameters).text_content() == nothing
        page.locator("#parameter-canny_lo").fill("91")
        assert page.locator(parameters).text_content() == "Write back: apply or undo the changes first."


def test_values_are_written_back_after_their_difference_was_seen(browser, bundle, photograph, home, tmp_path):
    folder = shutil.copytree(bundle, tmp_path / "edges")
    with Service(folder) as service, HttpServer(service, "127.0.0.1:*") as http:
        http.access_key = http.access_key_file.read_text().strip()
        change(http, canny_lo=64)
        with page_of(browser, http) as page:
            page.locator("#write-back:enabled").click()
            page.wait_for_selector("#ask[open]")
            assert "+value = 64" in page.locator("#ask pre").text_content()
            page.locator("#ask-yes").click()
            page.wait_for_selector("#parameters-note:not([hidden])")
            assert "Written" in page.locator("#parameters-note").text_content()
    assert "value = 64" in (folder / "pipeline.toml").read_text()


def test_a_service_that_is_faulted_says_why_and_one_that_is_gone_is_asked_again(browser, bundle, home, tmp_path):
    folder = shutil.copytree(bundle, tmp_path / "wrong")
    text = (folder / "pipeline.toml").read_text()
    (folder / "pipeline.toml").write_text(text.replace("value = 200", "value = 20"))
    write_manifest(folder)
    page = open_page(browser, viewport={"width": 1400, "height": 700})
    with Service(folder) as service, HttpServer(service, "127.0.0.1:*") as http:
        page.goto(http.url)
        state_is(page, "FAULTED")
        assert "edges" in page.locator("#reason").text_content()
    page.wait_for_selector("#notice:not([hidden])")
    assert "can't be reached" in page.locator("#notice").text_content()
    with Service(bundle) as service, HttpServer(service, http.url):
        state_is(page, "READY")
        page.wait_for_selector("#notice", state="hidden")
    page.context.close()
