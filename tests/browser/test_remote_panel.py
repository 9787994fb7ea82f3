"""The panel of a running service follows the user and the events, in JupyterLab, in a real browser."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Self

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.bundle.adapters import REQUEST
from epypes.wire import Envelope
from tests.browser.jupyter import JupyterLab, Notebook, running_notebook
from tests.browser.panel import PanelOnScreen
from tests.service.processes import running
from tests.service.states import read_state

pytestmark = pytest.mark.browser

TIMEOUT_S = 90.0
FRAMES_PER_S = 5


def grayscale(im):
    return cv2.cvtColor(im, cv2.COLOR_BGR2GRAY)


def blur(img, k: Annotated[int, ep.Param(1, 31, odd=True)]):
    return cv2.GaussianBlur(img, (k, k), 0)


def canny(img, lo: Annotated[int, ep.Param(1, 255)], hi: Annotated[int, ep.Param(1, 255)]):
    return cv2.Canny(img, lo, hi)


class Line:
    """A camera's place: publishes a frame some times per second, each another one, and keeps the last answer."""

    def __init__(self, state: Any, photograph: Any) -> None:
        self.answers: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._frames: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._subscriber = ep.ZMQSubscriber(state.pub, self.answers)
        self._publisher = ep.ZMQPublisher(state.sub, self._frames, bind=False)
        self._photograph, self._stopped = photograph, threading.Event()
        self.is_paused = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)

    def __enter__(self) -> Self:
        self._subscriber.start()
        self._publisher.start()
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._stopped.set()
        self._thread.join(TIMEOUT_S)
        self._publisher.stop()
        self._subscriber.stop()

    def send(self, image: Any) -> None:
        self._frames.put(Envelope(type=REQUEST, parts={"image": image}))

    def answer_of(self, revision: int) -> Any:
        """Return the first answer of this revision or a later one."""
        while True:
            answer = self.answers.get(timeout=TIMEOUT_S)
            if answer.revision >= revision:
                return answer

    def _work(self) -> None:
        number = 0
        while not self._stopped.wait(1 / FRAMES_PER_S):
            if not self.is_paused.is_set():
                number += 1
                self.send(np.ascontiguousarray(np.roll(self._photograph, 6 * number, axis=1)))


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory, photograph: Any) -> Path:
    io = {
        "grayscale": ("image", "image_gray"),
        "blur": (("image_gray", "blur_kernel"), "image_blurred"),
        "canny": (("image_blurred", "canny_lo", "canny_hi"), "edges"),
    }
    cg = ep.CompGraph({"grayscale": grayscale, "blur": blur, "canny": canny}, io)
    runner = ep.CompGraphRunner(cg, {"blur_kernel": 11, "canny_lo": 70, "canny_hi": 200})
    runner.run(image=photograph)
    return ep.promote(runner, tmp_path_factory.mktemp("bundles") / "edges").path


@pytest.fixture(scope="module")
def state(bundle: Path) -> Iterator[Any]:
    with running(bundle, "--http", "127.0.0.1:0"):
        state = read_state(bundle)
        assert state is not None
        yield state


@pytest.fixture(scope="module")
def line(state: Any, photograph: Any) -> Iterator[Line]:
    with Line(state, photograph) as line:
        yield line


@pytest.fixture(scope="module")
def open_notebook(lab_page: Any, lab: JupyterLab, state: Any, line: Line) -> Iterator[Notebook]:
    line.answer_of(0)
    token = Path(state.access_key_file).read_text().strip()
    cells = (
        f"import epypes as ep\nfrom epypes_widgets import tune\nservice = ep.connect('{state.http}', token='{token}')",
        "panel = tune(service)\npanel",
        "service",
    )
    with running_notebook(lab_page, lab.root / "remote.ipynb", *cells) as notebook:
        yield notebook
        notebook.execute("panel.close(); service.close()")


@pytest.fixture(scope="module")
def panel(open_notebook: Notebook) -> PanelOnScreen:
    return PanelOnScreen(open_notebook)


def test_a_drag_changes_what_the_service_answers(panel: PanelOnScreen, line: Line, state: Any) -> None:
    start = last = panel.values["canny_lo"]
    service = ep.connect(state.http, token=Path(state.access_key_file).read_text().strip())
    before = service.parameters().revision
    x, y = panel.grab("canny_lo")
    for step in range(1, 6):
        panel.page.mouse.move(x - 6 * step, y)
        panel.wait(
            "last => JSON.parse(document.querySelector('img.epypes-picture').dataset.values).canny_lo < last",
            last,
        )
        last = panel.values["canny_lo"]
    panel.page.mouse.up()
    panel.settle()
    shown, there = panel.values, service.parameters()
    service.close()
    assert shown["canny_lo"] < start
    assert {token: entry["value"] for token, entry in there.entries.items()} == shown
    assert there.revision > before
    answer = line.answer_of(there.revision)
    assert answer.revision == there.revision
    assert answer.parts["edges"].mean() > 0


def test_the_picture_follows_the_line(panel: PanelOnScreen, line: Line) -> None:
    seq, digest = panel.seq, panel.digest
    panel.wait("seq => Number(document.querySelector('img.epypes-picture').dataset.seq) > seq + 3", seq)
    assert panel.digest != digest


def test_what_somebody_else_sets_moves_the_control(panel: PanelOnScreen, state: Any) -> None:
    with ep.connect(state.http, token=Path(state.access_key_file).read_text().strip()) as service:
        service.set(canny_hi=150)
    panel.wait_for("canny_hi", 150)
    panel.wait("() => true")
    assert panel.page.locator(".epypes-code").inner_text().startswith("service.set(")


def test_a_frame_that_fails_marks_its_function(panel: PanelOnScreen, line: Line) -> None:
    line.is_paused.set()
    line.send(np.zeros((0, 0, 3), np.uint8))
    panel.wait_for_status("grayscale: error")
    line.is_paused.clear()
    panel.wait_for_status("")


def test_a_panel_of_a_service_can_be_looked_at(open_notebook: Notebook, panel: PanelOnScreen) -> None:
    assert panel.page.locator(".epypes-promote").is_hidden()
    assert panel.page.locator(".epypes-write-back").is_visible()
    assert panel.page.locator(".epypes-filmstrip").is_hidden()
    assert not open_notebook.page_errors


def test_what_would_be_written_back_is_shown_first(panel: PanelOnScreen, state: Any, bundle: Path) -> None:
    before = (bundle / "pipeline.toml").read_text()
    with ep.connect(state.http, token=Path(state.access_key_file).read_text().strip()) as service:
        service.set(canny_lo=41)
    panel.page.locator(".epypes-write-back").click()
    panel.wait("() => document.querySelector('.epypes-diff').textContent.includes('+value')")
    assert (bundle / "pipeline.toml").read_text() == before
    panel.page.locator(".epypes-write").click()
    panel.wait("() => document.querySelector('.epypes-foot').textContent.includes('Written to pipeline.toml')")
    assert (bundle / "pipeline.toml").read_text() != before


def test_a_service_that_ends_leaves_its_last_picture(panel: PanelOnScreen, state: Any) -> None:
    with ep.connect(state.http, token=Path(state.access_key_file).read_text().strip()) as service:
        service.pause()
        panel.wait_for_status("paused")
        service.resume()
    panel.wait_for_status("")


def test_a_closed_panel_takes_no_orders_and_its_code_can_be_copied(
    open_notebook: Notebook, panel: PanelOnScreen
) -> None:
    open_notebook.execute("panel.close()")
    panel.wait("() => document.querySelector('.epypes-write-back').closest('[inert]')")
    for name in ("save", "load", "write-back"):
        assert panel.page.locator(f"[inert] .epypes-{name}").count() == 1
    assert panel.page.locator("[inert] .epypes-copy").count() == 0
