"""The view of a panel does what the user asks for, in whatever order the kernel's messages arrive."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.browser.contrast import unreadable
from tests.browser.view_page import ViewPage

pytestmark = pytest.mark.browser

FAILURE = ("canny failed: the thresholds are 300 and 200.", "canny", ["canny_lo", "canny_hi"])


@pytest.fixture(scope="module")
def shared_view(browser: Any) -> Iterator[ViewPage]:
    """The page of all tests: a new page takes five times as long as one that is loaded anew."""
    view = ViewPage(browser)
    yield view
    view.close()


@pytest.fixture
def view(shared_view: ViewPage) -> Iterator[ViewPage]:
    shared_view.open()
    yield shared_view
    assert shared_view.errors == []


def _fail(view: ViewPage) -> None:
    view.page.evaluate("given => kernel.fail(...given)", list(FAILURE))


# -- frames -----------------------------------------------------------------------------------------------------


def test_a_painted_frame_is_acknowledged_and_tells_its_values(view: ViewPage) -> None:
    view.do("kernel.values.canny_lo = 90; await kernel.run()")
    view.settle()
    assert view.seen() == view.js("kernel.seq")
    assert view.js("JSON.parse(document.querySelector('img.epypes-picture').dataset.values).canny_lo") == 90
    assert view.text(".epypes-times") == "compute 2.1 ms / to screen 31.0 ms"


def test_an_older_frame_that_comes_late_is_acknowledged_and_not_shown(view: ViewPage) -> None:
    view.do("window.one = await kernel.frame(); window.two = await kernel.frame();")
    view.do("kernel.deliver(...two); kernel.deliver(...one); await kernel.painted(); await kernel.painted(one[0].seq)")
    view.settle()
    assert view.seen() == view.js("two[0].seq")
    assert {view.js("one[0].seq"), view.js("two[0].seq")} <= {message["seq"] for message in view.sent("painted")}


def test_a_picture_that_takes_long_to_decode_does_not_replace_a_newer_one(view: ViewPage) -> None:
    view.do(
        "window.large = await kernel.bytesOf('image', 5000); window.one = await kernel.frame(); window.two = await kernel.frame()"
    )
    view.do(
        "kernel.deliver(one[0], [large]); kernel.deliver(...two); await kernel.painted(); await kernel.painted(one[0].seq)"
    )
    view.until("kernel.kinds('painted').some(each => each.seq === one[0].seq)")
    assert view.seen() == view.js("two[0].seq")


def test_a_frame_that_comes_twice_is_acknowledged_twice(view: ViewPage) -> None:
    view.do("window.one = await kernel.frame(); kernel.deliver(...one); await kernel.painted()")
    view.do("kernel.deliver(...one)")
    view.until("kernel.kinds('painted').filter(each => each.seq === kernel.seq).length === 2")


def test_the_last_of_many_frames_is_the_one_on_the_screen(view: ViewPage) -> None:
    view.do("const all = []; for (let i = 0; i < 30; i++) all.push(await kernel.frame());")
    view.do(
        "const all = []; for (let i = 0; i < 30; i++) all.push(await kernel.frame());"
        "for (const i of [4, 2, 29, 7, 7, 28, 11, 0]) kernel.deliver(...all[i]);"
    )
    view.settle()
    assert view.seen() == view.js("kernel.seq")


def test_bytes_that_are_no_picture_are_told_and_the_next_frame_is_shown(view: ViewPage) -> None:
    before = view.seen()
    view.do("const [frame] = await kernel.frame(); kernel.deliver(frame, [new DataView(new ArrayBuffer(9))]);")
    said = "The picture of edges can't be shown: its bytes are no image/jpeg."
    view.until(f"document.querySelector('.epypes-status').textContent.includes(`{said}`)")
    assert view.seen() == before
    view.do("await kernel.run()")
    view.settle()
    assert view.seen() == view.js("kernel.seq")
    assert view.text(".epypes-status") == ""


def test_many_frames_leave_few_pictures_behind(view: ViewPage) -> None:
    view.do("kernel.pinned = ['gray']; kernel.compared = { kind: 'stage', token: 'gray' };")
    view.page.select_option(".epypes-compare", '{"kind":"stage","token":"gray"}')
    view.do("for (let i = 0; i < 200; i++) { await kernel.run(); await kernel.painted(); }")
    view.settle()
    assert view.seen() == view.js("kernel.seq")
    assert view.js("urls.size") <= 8
    view.do("kernel.close()")
    assert view.js("urls.size") == 0


def test_a_value_that_is_no_picture_is_shown_as_text(view: ViewPage) -> None:
    view.click(".epypes-chip[data-token=n_edges]")
    view.until("document.querySelector('.epypes-text').textContent === '1843'")
    assert view.shown(".epypes-text")
    assert not view.shown(".epypes-canvas")


# -- nothing moves ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("width", [600, 1280])
def test_nothing_moves_and_nothing_sticks_out_when_frames_and_failures_come_and_go(view: ViewPage, width: int) -> None:
    view.open(width=width)
    assert view.js("document.documentElement.scrollWidth") <= width
    places = "[...document.querySelectorAll('.epypes-box, .epypes-row, .epypes-history, .epypes-chip, .epypes-name, #after')]"
    measured = f"{places}.map(node => [node.getBoundingClientRect().x, node.getBoundingClientRect().y].join())"
    before = view.js(measured)
    _fail(view)
    view.do("await kernel.run({ stale: true, stages: { edges: 'failed', blurred: 'stale' } })")
    view.settle()
    view.page.mouse.move(*view.pixel(100, 100))
    view.until("!document.querySelector('.epypes-probe').hidden")
    assert view.js(measured) == before
    view.click(".epypes-chip[data-token=n_edges]")
    view.do("await kernel.run()")
    view.settle()
    assert view.js(measured) == before


@pytest.mark.parametrize("width", [600, 880])
def test_on_a_narrow_page_the_folders_stand_above_the_picture_and_leave_room_for_it(view: ViewPage, width: int) -> None:
    view.open(width=width, height=900)
    column, box = view.box(".epypes-controls"), view.box(".epypes-box")
    assert column["y"] + column["height"] < box["y"] < view.box(".epypes-foot")["y"] < view.box(".epypes-history")["y"]
    assert column["height"] < 0.4 * 900
    assert box["width"] > width - 50
    assert view.js("Math.min(...[...document.querySelectorAll('.slider-container')].map(e => e.offsetWidth))") > 120


def test_at_1440_x_900_the_picture_and_what_keeps_it_are_on_the_screen_together(view: ViewPage) -> None:
    view.open(width=1290, height=900)  # what JupyterLab leaves of 1440
    promote = view.box(".epypes-promote")
    top = view.box(".epypes-bar")["y"]
    assert view.box(".epypes-controls")["x"] + 300 < view.box(".epypes-box")["x"]
    assert promote["y"] + promote["height"] - top < 740
    assert view.box(".epypes-box")["height"] > 430


def test_the_picture_is_made_higher_by_its_handle_and_stays_so(view: ViewPage) -> None:
    usual = view.box(".epypes-box")["height"]
    x, y = view.middle(".epypes-resize")
    view.drag((x, y), (x, y + 90))
    assert view.box(".epypes-box")["height"] == usual + 90
    view.focus(".epypes-resize")
    view.press("ArrowUp")
    assert view.box(".epypes-box")["height"] == usual + 70
    view.open()
    assert view.box(".epypes-box")["height"] == usual + 70
    view.page.dblclick(".epypes-resize")
    assert view.box(".epypes-box")["height"] == usual


def test_the_picture_has_the_full_width_and_gives_it_back(view: ViewPage) -> None:
    before = view.box(".epypes-box")["width"]
    view.click(".epypes-full-width")
    assert view.box(".epypes-box")["width"] > before + 300
    assert view.box(".epypes-controls")["y"] < view.box(".epypes-box")["y"]
    assert view.attribute(".epypes-full-width", "aria-pressed") == "true"
    view.click(".epypes-full-width")
    assert view.box(".epypes-box")["width"] == before


def test_names_are_whole_and_two_handles_have_both(view: ViewPage) -> None:
    rows = view.js("[...document.querySelectorAll('.epypes-label')].map(each => each.textContent)")
    assert rows == ["blur_kernel", "sigma", "canny_lo", "canny_hi"]
    cut = "[...document.querySelectorAll('.epypes-label')].filter(each => each.scrollWidth > each.clientWidth).length"
    assert view.js(cut) == 0
    assert view.js("document.querySelectorAll('.epypes-label wbr').length") >= 4
    assert "canny_lo, canny_hi" in (view.attribute(".epypes-row-4", "title") or "")


def test_a_box_is_as_wide_as_its_number(view: ViewPage) -> None:
    view.page.fill("input[data-name=sigma]", "2.12345678901")
    view.press("Enter")
    view.settle()
    assert view.js("document.querySelector('input[data-name=sigma]').value") == "2.12345678901"
    assert view.js("(e => e.scrollWidth <= e.clientWidth)(document.querySelector('input[data-name=sigma]'))")


def test_a_failing_row_without_a_box_can_be_reset(view: ViewPage) -> None:
    assert view.page.locator(".epypes-row-3 .epypes-reset").is_disabled()
    view.do(
        "kernel.deliver({ kind: 'error', seq: kernel.seq + 1, text: 'no such border', function: 'blur', names: ['border'] })"
    )
    view.until("!document.querySelector('.epypes-row-3 .epypes-reset').disabled")
    view.click(".epypes-row-3 .epypes-reset")
    assert view.sent("reset")[-1]["names"] == ["border"]


def test_a_long_message_is_whole_and_moves_nothing(view: ViewPage) -> None:
    before = view.box(".epypes-foot")["y"]
    view.do("kernel.deliver({ kind: 'note', text: 'A long sentence. '.repeat(60) })")
    view.until("document.querySelector('.epypes-status').textContent.length > 900")
    assert view.box(".epypes-status")["height"] > 60
    assert view.box(".epypes-foot")["y"] == before
    view.do("kernel.deliver({ kind: 'settings', names: [], text: 'Much is wrong with it. '.repeat(30), ok: false })")
    view.until("document.querySelector('.epypes-outcome').textContent.length > 600")
    assert view.js(
        "(e => e.scrollWidth <= e.clientWidth && e.scrollHeight <= e.clientHeight)(document.querySelector('.epypes-outcome'))"
    )


def test_where_nothing_was_found_a_text_takes_the_place_of_the_picture_and_the_stage_has_a_sign(view: ViewPage) -> None:
    view.do(
        "window.none = await kernel.frame({ skipped: 2, stages: { edges: 'nothing', n_edges: 'nothing' } });"
        "none[0].pictures[0] = { token: 'edges', role: 'main', media_type: 'text/plain', text: 'edges: nothing found.', overlay: null };"
        "kernel.deliver(none[0], [])"
    )
    view.until("document.querySelector('.epypes-text')?.textContent === 'edges: nothing found.'")
    assert not view.page.locator("img.epypes-picture").is_visible()
    chip = view.page.locator(".epypes-chip[data-token=edges]")
    assert (chip.text_content(), chip.get_attribute("title")) == ("edges\u2205", "edges: nothing found")
    assert view.text(".epypes-count") == "3 ran, 1 reused, 2 skipped"
    view.do("await kernel.run()")
    view.until("document.querySelector('img.epypes-picture').offsetParent !== null")
    assert view.text(".epypes-count") == "3 ran, 1 reused"
    assert chip.text_content() == "edges"


@pytest.mark.parametrize("colours", ["light", "dark"])
def test_every_text_can_be_read(view: ViewPage, colours: str) -> None:
    view.open(theme=colours)
    view.click(".epypes-histogram-button")
    _fail(view)
    view.do(
        "await kernel.run({ stale: true, stages: { edges: 'failed', blurred: 'stale', n_edges: 'absent', gray: 'nothing' } })"
    )
    view.do("kernel.deliver({ kind: 'log', lines: [{ at: '12:03:11', text: 'A frame was sent again.' }] })")
    view.click(".epypes-log summary")
    view.click(".epypes-load")
    view.page.mouse.move(*view.pixel(100, 100))
    view.settle()
    assert unreadable(view.page, ".epypes-panel") == []


# -- looking ----------------------------------------------------------------------------------------------------


def _scale(view: ViewPage) -> float:
    return float(view.attribute(".epypes-box", "data-scale") or 0)


def test_the_wheel_zooms_only_after_a_click_and_keeps_what_is_under_the_pointer(view: ViewPage) -> None:
    fitted = _scale(view)
    view.page.mouse.move(*view.pixel(128, 96))
    view.page.mouse.wheel(0, -200)
    view.do("await new Promise(requestAnimationFrame)")
    assert _scale(view) == fitted
    at = view.pixel(128, 96)
    view.page.mouse.click(*at)
    view.page.mouse.wheel(0, -600)
    view.until(f"Number(document.querySelector('.epypes-box').dataset.scale) > {2 * fitted}")
    x, y = view.pixel(128, 96)
    assert (x, y) == (pytest.approx(at[0], abs=2), pytest.approx(at[1], abs=2))


def test_zoom_and_place_stay_when_values_and_stages_change(view: ViewPage) -> None:
    view.focus()
    view.press("+", "+", "+", "ArrowRight", "ArrowDown")
    before = view.box(".epypes-canvas")
    view.do("await kernel.run()")
    view.settle()
    view.click(".epypes-chip[data-token=gray]")
    view.until("document.querySelector('img.epypes-picture').alt.startsWith('gray ')")
    view.settle()
    assert view.box(".epypes-canvas") == before


def test_a_drag_pans_and_the_edges_of_the_picture_stay_outside_of_the_box(view: ViewPage) -> None:
    view.focus()
    view.press("+", "+", "+", "+")
    before = view.box(".epypes-canvas")
    x, y = view.middle(".epypes-pane")
    view.drag((x, y), (x - 60, y - 40))
    after = view.box(".epypes-canvas")
    assert (after["x"] - before["x"], after["y"] - before["y"]) == (-60, -40)
    view.drag((x, y), (x + 2000, y + 2000))
    assert view.box(".epypes-canvas")["x"] <= view.box(".epypes-pane")["x"]


def test_keys_fit_and_show_pixel_for_pixel(view: ViewPage) -> None:
    fitted = _scale(view)
    view.focus()
    view.press("1")
    assert _scale(view) == 1
    view.press("+")
    assert _scale(view) == 1.5
    view.press("-", "0")
    assert _scale(view) == fitted


def test_the_probe_asks_one_question_at_a_time_and_stays_in_the_box(view: ViewPage) -> None:
    view.do("kernel.isQuiet = true")
    view.page.mouse.move(*view.pixel(10, 10))
    view.page.mouse.move(*view.pixel(500, 370), steps=20)
    view.until("kernel.kinds('probe').length === 1")
    view.do(
        "const { id, x, y } = kernel.kinds('probe')[0];"
        "kernel.deliver({ kind: 'probe', id, x, y, rows: [{ token: 'gray', text: '1', state: 'fresh' }] });"
    )
    assert [(each["x"], each["y"]) for each in view.sent("probe")][1] == (500, 370)
    assert not view.shown(".epypes-probe")
    view.do(
        "const { id, x, y } = kernel.kinds('probe')[1];"
        "kernel.deliver({ kind: 'probe', id, x, y, rows: [{ token: 'gray', text: '77', state: 'fresh' }] });"
    )
    assert "77" in view.text(".epypes-probe")
    probe, box = view.box(".epypes-probe"), view.box(".epypes-box")
    assert probe["x"] + probe["width"] <= box["x"] + box["width"]
    assert probe["y"] + probe["height"] <= box["y"] + box["height"]


def test_the_crosshair_is_moved_by_keys(view: ViewPage) -> None:
    view.focus()
    view.press("p")
    view.until("kernel.kinds('probe').length === 1")
    view.press("Shift+ArrowRight", "Shift+ArrowDown")
    view.until("document.querySelector('.epypes-probe-at').textContent === 'x 257  y 193'")
    view.press("Escape")
    assert not view.shown(".epypes-probe")


def test_marks_are_vectors_whose_width_does_not_grow(view: ViewPage) -> None:
    view.do(
        "kernel.overlay = { points: [[100, 80, 30, 45], [9, 9, 0, -1]], lines: [[1, 1, 50, 1, 50, 40]], closed: true, total: 3, what: 'marks' };"
        "await kernel.run()"
    )
    view.settle()
    line = ".epypes-mark-line:not(.epypes-dots)"
    assert "M1 1L50 1L50 40Z" in str(view.attribute(line, "d"))
    assert view.js(f"getComputedStyle(document.querySelector('{line}')).vectorEffect") == "non-scaling-stroke"
    # The kernel measures from the corner of the first pixel, as the drawing does.
    assert view.attribute(".epypes-overlay", "viewBox") == "0 0 512 384"
    assert view.attribute(line, "transform") is None
    assert view.text(".epypes-marks") == "3 marks"
    view.focus()
    view.press("o")
    assert not view.shown(".epypes-overlay")
    view.do("kernel.overlay = null; await kernel.run()")
    view.settle()
    assert view.attribute(line, "d") == ""


# -- comparing --------------------------------------------------------------------------------------------------


def test_a_held_key_flips_to_the_default_and_its_release_back(view: ViewPage) -> None:
    view.focus()
    view.page.keyboard.down("f")
    view.until("document.querySelector('.epypes-other').getClientRects().length > 0")
    assert view.sent("compare") == [{"kind": "compare", "with": {"kind": "default"}}]
    view.page.keyboard.up("f")
    assert not view.shown(".epypes-other")


def test_the_divider_of_a_wipe_follows_mouse_and_keys(view: ViewPage) -> None:
    picture = view.page.query_selector("img.epypes-picture")
    view.click(".epypes-wipe")
    view.until("document.querySelector('.epypes-other').src")
    x, y = view.middle(".epypes-divider")
    view.drag((x, y), (x - 100, y))
    assert view.middle(".epypes-divider")[0] == pytest.approx(x - 100, abs=1)
    before = int(view.attribute(".epypes-divider", "aria-valuenow") or 0)
    view.focus(".epypes-divider")
    view.press("ArrowRight")
    assert int(view.attribute(".epypes-divider", "aria-valuenow") or 0) == before + 2
    clip = view.js("document.querySelector('.epypes-layer').style.clipPath")
    assert clip.startswith("inset(0px 0px 0px ")
    assert picture.evaluate("node => node.isConnected && node.matches('img.epypes-picture')")


def test_side_by_side_both_pictures_are_zoomed_and_panned_together(view: ViewPage) -> None:
    view.page.select_option(".epypes-compare", '{"kind":"stage","token":"gray"}')
    view.until("document.querySelector('.epypes-other').src")
    view.click(".epypes-side-button")
    view.until("!document.querySelector('.epypes-second').hidden")
    view.focus()
    view.press("+", "+", "+")
    x, y = view.middle(".epypes-second")
    view.drag((x, y), (x + 30, y + 20))
    one, two = view.box("img.epypes-picture"), view.box("img.epypes-other")
    left, right = view.box(".epypes-pane"), view.box(".epypes-second")
    assert one["width"] == two["width"]
    assert one["x"] - left["x"] == pytest.approx(two["x"] - right["x"], abs=2.5)
    assert one["y"] == two["y"]


def test_the_second_picture_has_marks_of_its_own(view: ViewPage) -> None:
    marks = "{ points: [], lines: [[1, 1, 50, 1, 50, 40]], closed: true, total: 1, what: 'contours' }"
    view.page.select_option(".epypes-compare", '{"kind":"default"}')
    view.until("document.querySelector('.epypes-other').src")
    view.do(
        f"const [frame, bytes] = await kernel.frame(); kernel.deliver({{ kind: 'reference', seq: frame.seq, label: 'default',"
        f" picture: {{ ...frame.pictures[0], role: 'other', overlay: {marks} }} }}, bytes)"
    )
    view.until("document.querySelector('.epypes-layer .epypes-mark-line').getAttribute('d').startsWith('M1 1')")
    assert view.js("document.querySelector('.epypes-overlay .epypes-mark-line').getAttribute('d')") == ""
    assert view.shown(".epypes-layer")


def test_a_stage_that_is_compared_with_follows_the_values(view: ViewPage) -> None:
    view.page.select_option(".epypes-compare", '{"kind":"stage","token":"gray"}')
    view.until("document.querySelector('.epypes-other').src")
    view.do("await kernel.run()")
    view.settle()
    assert view.attribute("img.epypes-other", "data-seq") == str(view.js("kernel.seq"))
    view.page.select_option(".epypes-compare", "null")
    assert view.sent("compare")[-1]["with"] is None
    assert not view.shown(".epypes-other")


# -- stages -----------------------------------------------------------------------------------------------------


def test_chips_are_tabs_that_arrows_walk_along(view: ViewPage) -> None:
    view.focus(".epypes-chip[aria-selected=true]")
    view.press("ArrowLeft")
    view.until("kernel.kinds('stage').at(-1)?.token === 'blurred'")
    view.settle()
    view.press("Home")
    view.until("document.querySelector('.epypes-chip[aria-selected=true]').dataset.token === 'image'")
    assert view.page.locator(".epypes-chip[tabindex='0']").count() == 1


def test_a_pinned_stage_stands_below_the_picture_and_is_shown_by_a_click(view: ViewPage) -> None:
    view.click(".epypes-chip-box:has([data-token=gray]) .epypes-pin")
    view.until("document.querySelector('.epypes-pinned [data-token=gray] img')?.src")
    assert view.sent("pin") == [{"kind": "pin", "token": "gray", "on": True}]
    view.click(".epypes-pinned [data-token=gray]")
    view.until("document.querySelector('.epypes-chip[aria-selected=true]').dataset.token === 'gray'")
    view.click(".epypes-chip-box:has([data-token=gray]) .epypes-pin")
    view.until("!document.querySelector('.epypes-pinned [data-token=gray]')")


# -- controls ---------------------------------------------------------------------------------------------------

KERNEL = ".epypes-row-1 .epypes-number"


def _values(view: ViewPage, commit: bool = True) -> list[dict[str, Any]]:
    return [message["values"] for message in (view.sent("set") if commit else view.moves)]


def test_a_typed_number_is_committed_by_enter(view: ViewPage) -> None:
    view.page.fill(KERNEL, "9")
    assert view.sent("set") == []
    view.press("Enter")
    assert _values(view) == [{"blur_kernel": 9}]


def test_an_even_number_becomes_the_next_odd_one_and_the_panel_says_so_until_the_next_value(view: ViewPage) -> None:
    view.page.fill(KERNEL, "8")
    view.press("Tab")
    assert _values(view) == [{"blur_kernel": 9}]
    view.settle()
    assert view.page.input_value(KERNEL) == "9"
    assert view.text(".epypes-status") == "blur_kernel takes odd numbers: 8 became 9."
    view.page.fill(KERNEL, "11")
    view.press("Enter")
    assert view.text(".epypes-status") == ""


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("99", "its range is 1 to 31"),
        ("2.5", "takes whole numbers"),
        ("", "Type a number"),
        ("abc", "Type a number for blur_kernel, not abc."),
    ],
)
def test_what_can_not_be_taken_is_marked_and_not_sent(view: ViewPage, typed: str, said: str) -> None:
    view.page.fill(KERNEL, typed)
    view.press("Enter")
    assert view.sent("set") == []
    assert view.attribute(KERNEL, "aria-invalid") == "true"
    assert said in view.text(".epypes-status")
    assert said in str(view.attribute(KERNEL, "title"))
    view.press("Escape")
    assert view.attribute(KERNEL, "aria-invalid") == "false"
    assert view.page.input_value(KERNEL) == "5"


def test_what_was_refused_goes_when_the_slider_is_moved(view: ViewPage) -> None:
    view.page.fill(KERNEL, "99")
    view.press("Enter")
    view.do("kernel.models['model-1'].set(21, true)")
    view.until("document.querySelector('.epypes-row-1 .epypes-number, [data-name=blur_kernel]').value === '21'")
    assert view.attribute(KERNEL, "aria-invalid") == "false"
    assert "range" not in view.text(".epypes-status")


def test_a_pair_keeps_its_order(view: ViewPage) -> None:
    view.page.fill(".epypes-row-4 .epypes-number >> nth=0", "201")
    view.press("Enter")
    assert view.sent("set") == []
    assert "200 (canny_hi)" in view.text(".epypes-status")


def test_arrow_keys_step_and_leaving_commits(view: ViewPage) -> None:
    view.focus(KERNEL)
    view.press("ArrowUp")
    view.until("kernel.moves().length === 1")
    view.press("ArrowUp")
    view.until("kernel.moves().length === 2")
    assert _values(view, commit=False) == [{"blur_kernel": 7}, {"blur_kernel": 9}]
    view.press("Tab")
    assert _values(view) == [{"blur_kernel": 9}]


def test_a_logarithmic_number_is_multiplied(view: ViewPage) -> None:
    view.focus(".epypes-row-2 .epypes-number")
    view.press("ArrowUp")
    view.until("kernel.moves().length === 1")
    assert _values(view, commit=False)[0]["sigma"] == pytest.approx(1.5 * 10**0.05, rel=1e-5)


def test_text_that_is_being_typed_is_never_overwritten(view: ViewPage) -> None:
    view.page.fill(KERNEL, "11")
    view.do("kernel.models['model-1'].set(21, false); kernel.values.blur_kernel = 21; await kernel.run()")
    view.settle()
    assert view.page.input_value(KERNEL) == "11"
    view.press("Escape")
    assert view.page.input_value(KERNEL) == "21"


def test_the_box_shows_the_sliders_value_while_it_moves_and_the_exact_one_at_rest(view: ViewPage) -> None:
    view.do("kernel.isQuiet = true; kernel.models['model-2'].set(1.6, true)")
    assert view.page.input_value(".epypes-row-2 .epypes-number") == "1.6"
    view.do("kernel.values.sigma = 1.61234; await kernel.run()")
    view.settle()
    assert view.page.input_value(".epypes-row-2 .epypes-number") == "1.61234"


def test_a_drag_of_a_slider_is_held_and_released(view: ViewPage) -> None:
    x, y = view.middle(".epypes-row-1 .noUi-handle")
    view.drag((x, y), (x + 60, y))
    assert view.sent("hold") == [{"kind": "hold", "names": ["blur_kernel"]}]
    assert view.sent("release") == [{"kind": "release", "names": ["blur_kernel"]}]
    kinds = [message["kind"] for message in view.js("kernel.sent")]
    assert kinds.index("hold") < kinds.index("release")
    view.focus(".epypes-row-1 .noUi-handle")
    view.press("ArrowRight")
    assert len(view.sent("hold")) == 1
    view.press("Enter")
    assert len(view.sent("release")) == 2


def test_a_drag_is_told_on_the_way_also_if_something_else_had_the_focus(view: ViewPage) -> None:
    view.focus(".epypes-row-2 .epypes-number")
    x, y = view.middle(".epypes-row-1 .noUi-handle")
    view.page.mouse.move(x, y)
    view.page.mouse.down()
    for step in range(1, 9):
        view.page.mouse.move(x + 8 * step, y)
        view.settle()
    model = view.js("kernel.rows[1].model")
    places = [message["places"][model] for message in view.moves]
    assert len(places) > 2
    assert places == sorted(places)
    assert view.page.input_value(KERNEL) == str(places[-1])
    assert view.sent("release") == []
    view.page.mouse.up()
    assert len(view.sent("release")) == 1


def test_a_changed_row_is_marked_and_can_be_reset(view: ViewPage) -> None:
    changed = "document.querySelector('.epypes-row-1').classList.contains('epypes-changed')"
    assert not view.js(changed)
    assert not view.shown(".epypes-row-1 .epypes-reset")
    view.page.fill(KERNEL, "9")
    view.press("Enter")
    view.settle()
    assert view.js(changed)
    view.click(".epypes-row-1 .epypes-reset")
    view.until(f"!{changed}")
    assert view.sent("reset") == [{"kind": "reset", "names": ["blur_kernel"]}]


def test_all_values_are_reset_at_once(view: ViewPage) -> None:
    view.click(".epypes-reset-all")
    assert view.sent("reset") == [{"kind": "reset", "names": []}]


def test_the_filter_finds_tokens_functions_and_what_is_said_of_them(view: ViewPage) -> None:
    rows = "[...document.querySelectorAll('.epypes-row')].filter(row => row.offsetHeight).map(row => row.dataset.kind)"
    for asked, left in (("canny_h", ["range"]), ("blur", ["slider", "log", "choice"]), ("deviation", ["log"])):
        view.page.fill(".epypes-filter input", asked)
        assert view.js(rows) == left
    view.page.fill(".epypes-filter input", "nothing")
    assert view.js(rows) == []
    assert "No hyperparameter matches" in view.text(".epypes-status")
    view.page.fill(".epypes-filter input", "")
    assert len(view.js(rows)) == 5


def test_a_heading_folds_its_rows_and_the_filter_still_finds_them(view: ViewPage) -> None:
    view.focus(".epypes-folder-1 .epypes-heading")
    view.press("Enter")
    assert view.attribute(".epypes-folder-1 .epypes-heading", "aria-expanded") == "false"
    assert not view.shown(".epypes-row-1")
    view.page.fill(".epypes-filter input", "blur_kernel")
    assert view.shown(".epypes-row-1")
    view.page.fill(".epypes-filter input", "")
    view.click(".epypes-folder-1 .epypes-heading")
    assert view.shown(".epypes-row-1")


def test_each_function_tells_its_time(view: ViewPage) -> None:
    assert view.text(".epypes-folder-1 .epypes-time") == "1.1 ms"


# -- failures ---------------------------------------------------------------------------------------------------


def test_a_failure_is_shown_where_it_is_and_goes_with_the_next_good_frame(view: ViewPage) -> None:
    picture = view.attribute("img.epypes-picture", "src")
    _fail(view)
    view.do("await kernel.run({ stale: true, stages: { edges: 'failed' } })")
    view.settle()
    assert view.text(".epypes-status") == FAILURE[0]
    assert view.shown(".epypes-badge")
    assert view.text(".epypes-folder-2 .epypes-heading-fault") == "! failed"
    assert view.attribute(".epypes-row-4", "title") == FAILURE[0]
    assert view.text(".epypes-row-4 .epypes-fault") == "!"
    assert "failed" in str(view.attribute(".epypes-chip[data-token=edges]", "aria-label"))
    assert picture
    view.do("await kernel.run()")
    view.settle()
    assert view.text(".epypes-status") == ""
    assert not view.shown(".epypes-badge")
    assert view.text(".epypes-folder-2 .epypes-heading-fault") == ""
    assert view.page.locator(".epypes-failed").count() == 0


def test_a_failure_that_a_better_frame_has_overtaken_is_not_shown(view: ViewPage) -> None:
    view.do("kernel.isQuiet = true; kernel.seq += 5; await kernel.run()")
    view.settle()
    view.do("kernel.deliver({ kind: 'error', seq: kernel.seq - 2, text: 'late', function: 'canny', names: [] })")
    assert view.text(".epypes-status") == ""


def test_the_log_is_there_only_when_it_says_something(view: ViewPage) -> None:
    assert not view.shown(".epypes-log")
    view.do("kernel.deliver({ kind: 'log', lines: [{ at: '12:03:11', text: 'A frame was lost.' }] })")
    view.click(".epypes-log summary")
    assert view.text(".epypes-lines li") == "12:03:11 A frame was lost."


# -- histogram and rectangle ------------------------------------------------------------------------------------


def test_a_threshold_is_dragged_on_the_histogram(view: ViewPage) -> None:
    view.focus()
    view.press("h")
    view.until("document.querySelector('.epypes-cut[data-name=canny_lo]')")
    chart = view.box(".epypes-histogram[data-token=blurred]")
    at = lambda value: chart["x"] + chart["width"] * value / 255  # noqa: E731
    y = chart["y"] + 70
    view.drag((at(70), y), (at(120), y))
    assert _values(view)[-1] == {"canny_lo": pytest.approx(120, abs=2)}
    assert [message["names"] for message in view.sent("hold")] == [["canny_lo"]]
    assert [message["names"] for message in view.sent("release")] == [["canny_lo"]]
    view.drag((at(120), y), (at(250), y))
    assert _values(view)[-1] == {"canny_lo": 200}


def test_a_threshold_is_moved_by_keys(view: ViewPage) -> None:
    view.click(".epypes-histogram-button")
    view.until("document.querySelector('.epypes-cut[data-name=canny_hi]')")
    view.focus(".epypes-cut[data-name=canny_hi]")
    view.press("ArrowRight")
    view.press("Shift+ArrowRight")
    assert view.attribute(".epypes-cut[data-name=canny_hi]", "aria-valuenow") == "211"
    view.press("Tab")
    assert _values(view)[-1] == {"canny_hi": 211}


def _crop(view: ViewPage) -> list[int]:
    found: list[int] = [
        message["values"]["crop"] for message in [*view.moves, *view.sent("set")] if "crop" in message["values"]
    ][-1]
    return found


def test_a_rectangle_is_drawn_moved_and_resized(view: ViewPage) -> None:
    view.click(".epypes-chip[data-token=image]")
    view.until("document.querySelector('.epypes-roi-one').style.display === ''")
    view.focus()
    view.press("r")
    view.drag(view.pixel(100.4, 50.4), view.pixel(300.4, 250.4))
    assert _crop(view) == pytest.approx([100, 50, 201, 201], abs=2)
    drawn = _crop(view)
    view.drag(view.pixel(200, 150), view.pixel(210, 170))
    assert _crop(view) == pytest.approx([drawn[0] + 10, drawn[1] + 20, drawn[2], drawn[3]], abs=1)
    moved = _crop(view)
    view.drag(view.middle("[data-handle=e]"), view.pixel(2000, 100))
    assert _crop(view)[0] + _crop(view)[2] == 512
    assert _crop(view)[:2] == moved[:2]
    assert [message["names"] for message in view.sent("hold")] == [["crop"]] * 3
    assert len(view.sent("release")) == 3


def test_a_rectangle_is_moved_by_keys_and_given_up_by_delete(view: ViewPage) -> None:
    view.click(".epypes-chip[data-token=image]")
    view.until("document.querySelector('.epypes-roi-one').style.display === ''")
    view.focus(".epypes-roi-frame")
    view.press("ArrowRight", "ArrowRight", "ArrowRight", "Shift+ArrowDown", "Alt+ArrowUp")
    view.until("kernel.moves().at(-1)?.values.crop?.[1] === 30")
    assert _crop(view) == [63, 30, 200, 161]
    view.press("Delete")
    assert view.attribute(".epypes-roi-frame", "width") == "512"
    assert _values(view)[-1] == {"crop": [0, 0, 512, 384]}


def test_a_frame_of_older_values_does_not_take_a_rectangle_back(view: ViewPage) -> None:
    view.click(".epypes-chip[data-token=image]")
    view.until("document.querySelector('.epypes-roi-one').style.display === ''")
    view.settle()
    view.do("kernel.isQuiet = true")
    view.focus(".epypes-roi-frame")
    view.press("ArrowRight")
    view.do("await kernel.run()")
    view.settle()
    view.press("ArrowRight")
    view.until("kernel.moves().at(-1)?.values.crop?.[0] === 62")


def test_escape_gives_back_the_rectangle_that_was(view: ViewPage) -> None:
    view.click(".epypes-chip[data-token=image]")
    view.until("document.querySelector('.epypes-roi-one').style.display === ''")
    view.click(".epypes-roi-button")
    view.page.mouse.move(*view.pixel(10, 10))
    view.page.mouse.down()
    view.page.mouse.move(*view.pixel(200, 200), steps=4)
    view.press("Escape")
    view.page.mouse.up()
    assert _crop(view) == [60, 40, 200, 160]
    assert "epypes-drawing" not in str(view.attribute(".epypes-box", "class"))


# -- what is kept -----------------------------------------------------------------------------------------------


def test_history_is_gone_back_to_and_undone(view: ViewPage) -> None:
    view.page.fill(KERNEL, "9")
    view.press("Enter")
    view.until("document.querySelectorAll('.epypes-entry').length === 2")
    assert "blur_kernel 5 -> 9" in view.text(".epypes-entry[aria-current=true]")
    view.click(".epypes-entry >> nth=0")
    view.click(".epypes-undo")
    view.focus()
    view.press("Control+z")
    assert view.sent("goto") == [{"kind": "goto", "number": 0}]
    assert len(view.sent("undo")) == 2
    assert view.page.locator(".epypes-redo").is_disabled()


def test_settings_are_saved_and_loaded_by_name(view: ViewPage) -> None:
    view.click(".epypes-save")
    assert view.text(".epypes-outcome") == "! Give the settings a name."
    view.page.fill(".epypes-setting", "bright")
    view.press("Enter")
    view.until("document.querySelector('.epypes-outcome').textContent === 'saved bright.toml'")
    view.click(".epypes-load")
    view.until("document.querySelector('.epypes-outcome').textContent === '! There are no settings bright.'")


def test_promote_tells_its_outcome(view: ViewPage) -> None:
    view.click(".epypes-promote")
    view.until(
        "document.querySelector('.epypes-outcome').textContent.startsWith('3 functions written to services/edges')"
    )
    assert view.sent("promote") == [{"kind": "promote", "to": "services/edges"}]


def test_live_is_switched_off_and_run_asked_for(view: ViewPage) -> None:
    assert view.page.locator(".epypes-run").is_disabled()
    view.click(".epypes-live-switch")
    assert view.attribute(".epypes-live-switch", "aria-checked") == "false"
    view.click(".epypes-run")
    assert view.sent("live") == [{"kind": "live", "on": False}]
    assert len(view.sent("run")) == 1


def test_another_image_is_chosen_on_the_film(view: ViewPage) -> None:
    view.click(".epypes-filmstrip button >> nth=1")
    assert view.sent("image") == [{"kind": "image", "index": 1}]


# -- for everybody ----------------------------------------------------------------------------------------------


def test_everything_that_can_be_used_has_a_name_and_can_be_reached(view: ViewPage) -> None:
    nameless = view.js(
        "[...document.querySelectorAll('.epypes-view button, .epypes-view input, .epypes-view select, .epypes-view [role=slider],"
        " .epypes-number, .noUi-handle')].filter(node => !(node.getAttribute('aria-label') || node.textContent.trim())).map(node => node.outerHTML)"
    )
    assert nameless == []
    view.focus(".epypes-live-switch")
    reached = []
    for _ in range(40):
        reached.append(str(view.js("document.activeElement.className")))
        view.press("Tab")
    for name in (
        "epypes-scale",
        "epypes-compare",
        "epypes-wipe",
        "epypes-chip",
        "epypes-box",
        "epypes-entry",
        "epypes-copy",
        "epypes-promote",
    ):
        assert any(name in each.split() for each in reached), name


def test_focus_can_be_seen(view: ViewPage) -> None:
    for selector in (".epypes-wipe", ".epypes-chip[aria-selected=true]", ".epypes-box", KERNEL, ".epypes-heading"):
        view.focus(selector)
        view.press("Shift")
        assert view.js(f"getComputedStyle(document.querySelector('{selector}')).outlineStyle") == "solid", selector


def test_the_notebooks_shortcuts_are_kept_from_the_views_keys_only(view: ViewPage) -> None:
    view.do(
        "window.heard = []; document.addEventListener('keydown', event =>"
        " heard.push([event.key, event.target.closest('[data-lm-suppress-shortcuts]') !== null]), true)"
    )
    view.focus()
    view.press("ArrowRight", "Control+s")
    assert [each for each in view.js("heard") if each[0] in ("ArrowRight", "s")] == [["ArrowRight", True], ["s", False]]


def test_the_static_picture_is_hidden_while_the_view_lives(view: ViewPage) -> None:
    assert not view.shown(".epypes-kept")
    view.do("kernel.close()")
    assert view.shown(".epypes-kept")
    assert view.sent("closed") == [{"kind": "closed"}]


def test_a_closed_view_leaves_nothing_behind_and_another_can_be_mounted(view: ViewPage) -> None:
    view.do("kernel.close()")
    assert view.page.locator(".epypes-view, .epypes-tail").count() == 0
    assert view.js("kernel.listeners.size") == 0
    view.do("kernel.seq = 0; kernel.mount()")
    view.until("document.querySelector('img.epypes-picture')?.dataset.seq")
    view.until("document.querySelectorAll('.epypes-tail').length === 5")


# -- numbers ----------------------------------------------------------------------------------------------------

TILE = ".epypes-tile[data-token=n_edges]"


def test_a_number_is_written_at_the_moment_its_picture_appears(view: ViewPage) -> None:
    view.do(
        """
        window.wrong = [];
        const [picture, tiles] = ['.epypes-picture', '.epypes-tiles'].map(css => document.querySelector(css));
        const value = tiles.querySelector('.epypes-tile-value');
        new MutationObserver(() => {
            const { seq, values } = picture.dataset;
            if (tiles.dataset.seq !== seq || value.textContent !== String(JSON.parse(values).canny_lo)) wrong.push(seq);
        }).observe(picture, { attributes: true, attributeFilter: ['data-seq'] });
        for (let i = 0; i < 30; i++) { kernel.values.canny_lo = 70 + i; await kernel.run(); await kernel.painted(); }
        """
    )
    view.settle()
    assert view.text(f"{TILE} .epypes-tile-value") == "99"
    assert view.text(f"{TILE} .epypes-tile-change") == "+3"
    assert view.js("wrong") == []


def test_a_number_is_pinned_by_the_menu_or_at_its_token_and_let_go_of_at_its_tile(view: ViewPage) -> None:
    menu, pin = ".epypes-more-tiles", ".epypes-chip-box:has([data-token=n_edges]) > .epypes-pin"
    assert view.js(f"[...document.querySelector('{menu}').options].map(one => one.value)") == ["", "mean"]
    assert view.attribute(pin, "aria-pressed") == "true"
    view.page.select_option(menu, "mean")
    view.until("document.querySelector('.epypes-tile[data-token=mean]')")
    assert not view.shown(menu)
    view.click(f"{TILE} .epypes-unpin")
    view.until(f"!document.querySelector('{TILE}')")
    view.until(f"document.querySelector('{pin}').getAttribute('aria-pressed') === 'false'")
    view.click(pin)
    view.until(f"document.querySelector('{TILE}')")
    assert [(one["token"], one["on"]) for one in view.sent("pin")] == [
        ("mean", True),
        ("n_edges", False),
        ("n_edges", True),
    ]


@pytest.mark.parametrize("colours", ["light", "dark"])
def test_a_tile_says_by_signs_and_colours_what_it_is_and_never_moves(view: ViewPage, colours: str) -> None:
    view.open(theme=colours)
    view.do("kernel.tiles = ['n_edges', 'mean']; await kernel.run()")
    view.settle()
    places = "[...document.querySelectorAll('.epypes-tile, .epypes-status')].map(node => JSON.stringify(node.getBoundingClientRect()))"
    before, seen = view.js(places), set()
    for state, verdict, sign in (
        ("fresh", "", ""),
        ("fresh", "passed", "✓"),
        ("fresh", "failed", "✗"),
        ("stale", "", "~"),
        ("failed", "", "!"),
    ):
        text, change = ("1234567890", "+1234567890") if sign else ("1", "")
        tile = {"token": "n_edges", "state": state, "verdict": verdict, "text": text, "change": change, "title": "told"}
        view.page.evaluate("async tile => kernel.run({ tiles: [tile, { ...tile, token: 'mean' }] })", tile)
        view.settle()
        assert (view.text(f"{TILE} .epypes-verdict-sign"), view.attribute(TILE, "title")) == (sign, "told")
        assert view.js(places) == before
        assert unreadable(view.page, ".epypes-tiles") == []
        seen.add(view.js(f"getComputedStyle(document.querySelector('{TILE} .epypes-tile-value')).color"))
    assert len(seen) == 3
