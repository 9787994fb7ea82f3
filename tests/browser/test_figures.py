"""Figures can be explored and read, on every kind of page that shows them, in a real browser."""

from __future__ import annotations

import json
import queue
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import cv2
import numpy as np
import pytest
from skimage import data

import epypes as ep
from epypes.display import mimebundle, to_svg, view
from epypes.display.paint.page import paint_figure, paint_graph, paint_page
from epypes.display.paint.svg import paint_svg
from tests.browser.contrast import ENOUGH, readings, unreadable
from tests.browser.jupyter import open_page
from tests.conftest import EDGE_FUNCTIONS, EDGE_HPARAMS, EDGE_IO

pytestmark = pytest.mark.browser

KEPT_NOTE = "a smaller picture was kept: run the cell again"

_THEMES = Path(sys.prefix) / "share" / "jupyter" / "lab" / "themes" / "@jupyterlab"
_CODE = {
    "light": ("#000000", "#ffffff", "#006ab1", "#a1260d", "#bf8803"),
    "dark": ("#d4d4d4", "#1e1e1e", "#3794ff", "#f48771", "#cca700"),
}
_NAMES = (
    "editor-foreground",
    "editor-background",
    "textLink-foreground",
    "errorForeground",
    "editorWarning-foreground",
)


def _lab(theme: str) -> str:
    rules = (_THEMES / f"theme-{theme}-extension" / "index.css").read_text()
    return f"{rules} body{{background:var(--jp-layout-color0);color:var(--jp-content-font-color1)}}"


def _code(theme: str) -> str:
    values = ";".join(f"--vscode-{name}:{value}" for name, value in zip(_NAMES, _CODE[theme], strict=True))
    ground = "background:var(--vscode-editor-background);color:var(--vscode-editor-foreground)"
    return f":root{{{values}}} body{{{ground}}}"


PAGES = {
    "JupyterLab light": _lab("light"),
    "JupyterLab dark": _lab("dark"),
    "VS Code light": _code("light"),
    "VS Code dark": _code("dark"),
    "bare": "",
    "bare and dark": "body{background:#111;color:#ddd}",
}


@dataclass
class Sheet:
    """A page with pictures, as an eye, a mouse and a keyboard have it."""

    page: Any

    def put(self, *htmls: str, style: str = "") -> None:
        body = "".join(f'<div class="output">{html}</div>' for html in htmls)
        self.page.set_content(f"<!doctype html><meta charset=utf-8><style>{style}</style>{body}")

    @property
    def card(self) -> list[str]:
        """The lines of the card that is open; none if there is none."""
        return (
            str(self.page.locator(".epypes-card:popover-open").first.inner_text()).splitlines() if self.has_card else []
        )

    @property
    def has_card(self) -> bool:
        return bool(self.page.locator(".epypes-card:popover-open").count())

    @property
    def about(self) -> str:
        return str(self.page.locator(".epypes-about").first.inner_text())

    def vertices(self, kind: str) -> set[str]:
        """The names of the vertices of a kind."""
        ids = self.page.locator(f"svg .{kind}").evaluate_all("all => all.map(each => each.id)")
        return {identity.partition("-")[2] for identity in ids}

    def focused(self) -> str:
        return str(self.page.evaluate("document.activeElement.id"))


@pytest.fixture
def sheet(browser: Any) -> Iterator[Sheet]:
    """An empty page; whatever script of it fails, and whatever asks, fails the test."""
    page, wrong = open_page(browser, viewport={"width": 1200, "height": 800}), []
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("dialog", lambda dialog: (wrong.append(dialog.message), dialog.dismiss()))
    yield Sheet(page)
    page.context.close()
    assert not wrong


def edge_runner() -> ep.CompGraphRunner:
    return ep.CompGraphRunner(ep.CompGraph(EDGE_FUNCTIONS, EDGE_IO), EDGE_HPARAMS)


@pytest.fixture(scope="module")
def photo() -> np.ndarray:
    return cv2.cvtColor(data.coffee(), cv2.COLOR_RGB2BGR)


@pytest.fixture(scope="module")
def edges(photo: np.ndarray) -> str:
    """The page of a run of the edge graph."""
    return mimebundle(edge_runner().run(image=photo))["text/html"]


# -- pictures of others -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "inside",
    [
        "<rect width='9' height='9' onclick='hit=1' onfocus='hit=1'/>",
        "<image href='data:image/png;base64,AAAA' onerror='hit=1'/>",
        "<image href='no/picture' onload='hit=1' onerror='hit=1'/>",
        "<script>hit=1</script>",
        "<foreignObject><img xmlns='http://www.w3.org/1999/xhtml' src='no' onerror='hit=1'/></foreignObject>",
        "<img xmlns='http://www.w3.org/1999/xhtml' src='no' onerror='hit=1'/>",
        "<animate attributeName='x' dur='1ms' begin='0s' onbegin='hit=1'/>",
        "<a href='javascript:hit=1'><rect width='9' height='9'/></a>",
    ],
)
def test_nothing_in_the_picture_of_an_untrusted_notebook_runs_when_a_trusted_one_explores(
    sheet: Sheet, edges: str, inside: str
) -> None:
    svg = f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 9 9' onload='hit=1'>{inside}<title>t</title></svg>"
    image = f'<img src="data:image/svg+xml,{quote(svg)}">'
    # What JupyterLab lets through from a notebook that it does not trust.
    sheet.put(f'<figure class="epypes-figure"><div>{image}</div></figure>', edges)
    sheet.page.wait_for_selector("#token-edges")
    shown = sheet.page.locator("figure.epypes-figure").first.locator("svg title")
    assert shown.count() == 1, "it is inlined all the same"
    for event in ("click", "focus", "load", "error", "begin"):
        every = "(all, kind) => all.forEach(each => each.dispatchEvent(new Event(kind)))"
        sheet.page.locator("figure.epypes-figure").first.locator("svg, svg *").evaluate_all(every, event)
    assert sheet.page.evaluate("typeof hit") == "undefined"


@pytest.mark.parametrize(("tag", "is_asked"), [("div", False), ("script type=application/json", True)])
def test_a_kernel_is_asked_only_where_a_script_says_how(sheet: Sheet, edges: str, tag: str, is_asked: bool) -> None:
    settings = f'<{tag} id="jupyter-config-data">{{"baseUrl": "http://127.0.0.1:9/"}}</{tag.split()[0]}>'
    asked: list[str] = []
    sheet.page.on("websocket", lambda socket: asked.append(socket.url))
    sheet.put(settings, edges.replace('class="epypes-sheet"', 'class="epypes-sheet" data-run="kernel/run"', 1))
    sheet.page.hover("#token-edges")
    sheet.page.wait_for_function(
        "what => document.querySelector('.epypes-card small')?.textContent === what", arg=KEPT_NOTE
    )
    assert bool(asked) == is_asked


# -- cards ------------------------------------------------------------------------------------------------------------


SHOWN_SHARP = """where => {
    const image = document.querySelector(where + ' img');
    return image?.complete && image.naturalWidth >= image.clientWidth * devicePixelRatio ? image.naturalWidth : 0;
}"""


def test_hovering_a_token_shows_its_kept_picture_with_what_is_known_of_it(sheet: Sheet, edges: str) -> None:
    sheet.put(edges)
    sheet.page.hover("#token-edges")
    assert sheet.card[:3] == ["token edges", "uint8 400 x 600", "0 to 255"]
    assert sheet.card[3].startswith("mean ")
    assert sheet.card[-2:] == ["fresh", KEPT_NOTE]
    assert sheet.page.wait_for_function(SHOWN_SHARP, arg=".epypes-card").json_value() == 600
    sheet.page.hover("#token-image")
    assert sheet.card[0] == "token image"
    assert sheet.page.wait_for_function(SHOWN_SHARP, arg=".epypes-card").json_value() == 512
    pictures = re.findall(r"base64,([A-Za-z0-9+/=]+)", edges)
    assert len(pictures) == len(set(pictures)) == 8, "no picture is carried twice"


def test_a_mask_that_is_enlarged_keeps_its_edges(sheet: Sheet) -> None:
    cg = ep.CompGraph({"f": lambda image: image > 127}, {"f": ("image", "mask")})
    run = ep.CompGraphRunner(cg).run(image=np.tile(np.arange(256, dtype=np.uint8), (200, 1)))
    sheet.put(mimebundle(run)["text/html"], style=".epypes-card img{width:500px}")
    for token, rendering in (("mask", "pixelated"), ("image", "auto")):
        sheet.page.hover(f"#token-{token}")
        is_drawn = "how => getComputedStyle(document.querySelector('.epypes-card img')).imageRendering === how"
        sheet.page.wait_for_function(is_drawn, arg=rendering)


def test_a_token_whose_picture_was_not_kept_shows_its_thumbnail_in_its_own_size(sheet: Sheet, edges: str) -> None:
    sheet.put(re.sub(r'<details class="epypes-album".*?</details>', "", edges))
    sheet.page.hover("#token-image")
    assert sheet.page.wait_for_function(SHOWN_SHARP, arg=".epypes-card").json_value() == 128
    assert sheet.card[-1] == "no larger picture was kept: run the cell again"


def test_the_card_goes_with_the_pointer_and_with_escape(sheet: Sheet, edges: str) -> None:
    sheet.put(edges)
    sheet.page.hover("#token-edges")
    assert sheet.has_card
    sheet.page.mouse.move(1190, 10)
    assert not sheet.has_card
    sheet.page.keyboard.press("Tab")
    assert sheet.card[0] == "token image"
    sheet.page.keyboard.press("Escape")
    assert not sheet.has_card


def test_the_card_stands_beside_its_vertex_within_the_window_whatever_clips_or_moves_the_output(
    sheet: Sheet, edges: str
) -> None:
    sheet.put(edges, style=".output{overflow:hidden;transform:translate(30px,0);height:500px;width:520px}")
    for token in ("image", "image_blurred", "canny_lo"):
        sheet.page.hover(f"#token-{token}")
        sheet.page.wait_for_function("document.querySelector('.epypes-card').style.top !== ''")
        card, vertex = (sheet.page.locator(each).bounding_box() for each in (".epypes-card", f"#token-{token}"))
        assert card["x"] >= vertex["x"] + vertex["width"] or card["x"] + card["width"] <= vertex["x"]
        assert 0 <= card["x"] <= 1200 - card["width"]
        assert 0 <= card["y"] <= 800 - card["height"]
        top = """card => {
            card.style.pointerEvents = 'auto';
            const box = card.getBoundingClientRect();
            const hit = document.elementFromPoint(box.right - 3, box.top + box.height / 2);
            card.style.pointerEvents = '';
            return card.contains(hit);
        }"""
        assert sheet.page.locator(".epypes-card").evaluate(top), "nothing cuts it"


def test_without_popovers_there_is_a_card_too(sheet: Sheet, edges: str) -> None:
    without = "delete HTMLElement.prototype.togglePopover; delete HTMLElement.prototype.popover"
    sheet.page.add_init_script(without)
    sheet.page.goto("about:blank")
    plain = edges.replace('setAttribute("popover", "manual")', 'setAttribute("data-popover", "manual")')
    sheet.put(plain)
    sheet.page.hover("#token-edges")
    card = sheet.page.locator(".epypes-card")
    assert card.is_visible()
    assert card.bounding_box()["x"] >= 0
    sheet.page.mouse.move(1190, 10)
    assert not card.is_visible()


# -- choosing ---------------------------------------------------------------------------------------------------------


def test_choosing_a_function_tells_its_source_and_marks_what_it_depends_on_and_what_depends_on_it(
    sheet: Sheet, edges: str
) -> None:
    sheet.put(edges)
    sheet.page.click("#function-blur")
    assert re.match(r"function blur\s*\(img, k\)\s+ran; [\d.]+ (µs|ms), \d+%", sheet.about)
    assert "def blur(img, k):\n    return cv2.GaussianBlur(img, (k, k), 0)" in sheet.about
    kin = {"image", "grayscale", "image_gray", "blur_kernel", "blur", "image_blurred", "canny", "edges"}
    assert sheet.vertices("kin") == kin
    ways = [sheet.page.locator(each).get_attribute("d").count("M") for each in (".way", ".head")]
    assert ways == [7, 7], "the edges between them, and no other"
    for gone in (lambda: sheet.page.click("#function-blur"), lambda: sheet.page.keyboard.press("Escape")):
        gone()
        assert (sheet.vertices("kin"), sheet.about) == (set(), "")
        assert sheet.page.locator("svg.lit").count() == 0
        sheet.page.click("#token-image_gray")
        assert sheet.vertices("kin") == kin - {"blur_kernel"}
    sheet.page.locator("figure svg").first.click(position={"x": 5, "y": 5})
    assert sheet.vertices("kin") == set(), "the background"


def test_arrows_around_a_graph_are_not_taken_for_its_edges(sheet: Sheet) -> None:
    pipe = ep.SourcePipeline("edges", edge_runner().cg, queue.Queue(), lambda view: view["edges"])
    sheet.put(mimebundle(pipe)["text/html"])
    assert sheet.page.locator("path.edge.around").count() == 1
    sheet.page.click("#function-grayscale")
    ways = [sheet.page.locator(each).get_attribute("d").count("M") for each in (".way", ".head")]
    assert ways == [6, 6]


def test_what_was_marked_is_marked_by_more_than_colour_and_all_else_stays(sheet: Sheet, edges: str) -> None:
    sheet.put(edges)
    sheet.page.click("#function-grayscale")
    widths = sheet.page.evaluate(
        "['function-grayscale', 'function-canny', 'token-canny_lo']"
        ".map(id => getComputedStyle(document.getElementById(id).querySelector('.shape')).strokeWidth)"
    )
    assert widths == ["3px", "1.3px", "0.6px"], "what was chosen, its kin, and another"
    assert sheet.page.locator("#token-canny_lo text").is_visible()


def test_a_function_whose_source_did_not_fit_says_so(sheet: Sheet) -> None:
    graph = view(edge_runner().cg)
    sheet.put(paint_page(*paint_graph(graph, paint_svg(graph), taken=1_000_000)))
    sheet.page.click("#function-blur")
    assert "source left out to keep the picture small" in sheet.about


LATER = "<div id='later' style='height:5000px'>a later cell</div>"


@pytest.mark.parametrize(("width", "is_beside"), [(1200, True), (700, False)])
def test_what_is_told_stands_beside_the_graph_or_below_it_and_over_nothing(
    sheet: Sheet, edges: str, width: int, is_beside: bool
) -> None:
    sheet.page.set_viewport_size({"width": width, "height": 800})
    sheet.put(edges + LATER)
    view, about, later = (sheet.page.locator(each) for each in (".epypes-window", ".epypes-about", "#later"))
    for vertex in ("#token-image", "#function-blur", "#token-edges"):
        sheet.page.click(vertex)
        assert not sheet.has_card, "it would lie over the panel"
        graph, told, below = (each.bounding_box() for each in (view, about, later))
        assert told["y"] + told["height"] <= below["y"]
        assert graph["y"] + graph["height"] <= below["y"]
        if is_beside:
            assert told["x"] >= graph["x"] + graph["width"]
        else:
            assert told["y"] >= graph["y"] + graph["height"]
        assert told["y"] + told["height"] <= 800, "it can be seen"
        hit = "box => document.elementFromPoint(box.x + 9, Math.min(box.y + 9, innerHeight - 1))?.id"
        assert sheet.page.evaluate(hit, later.bounding_box()) in ("later", "")
    sheet.page.keyboard.press("Escape")
    about.wait_for(state="hidden")


def test_choosing_an_image_shows_its_picture_in_the_panel(sheet: Sheet, edges: str) -> None:
    sheet.put(edges)
    sheet.page.click("#token-edges")
    assert KEPT_NOTE in sheet.about
    assert sheet.page.wait_for_function(SHOWN_SHARP, arg=".epypes-about").json_value() == 600


def test_what_the_click_moves_under_a_resting_pointer_is_not_looked_at(sheet: Sheet, edges: str) -> None:
    sheet.page.set_viewport_size({"width": 700, "height": 500})
    sheet.put(edges + LATER)
    sheet.page.click("#token-image")
    sheet.page.wait_for_function("scrollY > 0")
    sheet.page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    assert not sheet.has_card


# -- zoom ---------------------------------------------------------------------------------------------------------------


def stereo_like(count: int = 9) -> str:
    """A graph of two branches of so many functions each, with images, and one where they meet."""
    io = {}
    for side in ("left", "right"):
        for index in range(count):
            names = (f"{side}_{index}", f"a_{side}_{index}", f"b_{side}_{index}")
            io[f"smooth_{side}_{index}"] = (names, f"{side}_{index + 1}")
    io["meet"] = ((f"left_{count}", f"right_{count}", "gain", "offset", "power"), "out")
    cg = ep.CompGraph(dict.fromkeys(io, lambda image, *others: image + np.uint8(1)), io)
    values = {name: 1 for name in cg.source_tokens if name not in ("left_0", "right_0")}
    photo = data.camera()
    return mimebundle(ep.CompGraphRunner(cg, values).run(left_0=photo, right_0=photo))["text/html"]


@pytest.fixture(scope="module")
def wide() -> str:
    return stereo_like()


def scale_of(sheet: Sheet) -> float:
    return float(
        sheet.page.locator("figure svg.epypes-graph").first.evaluate(
            "svg => svg.getBoundingClientRect().width / svg.viewBox.baseVal.width"
        )
    )


def overflow(sheet: Sheet) -> list[float]:
    sizes = "view => [view.scrollWidth - view.clientWidth, view.scrollHeight - view.clientHeight]"
    return list(sheet.page.locator(".epypes-window").first.evaluate(sizes))


def test_a_graph_of_19_functions_is_readable_in_the_output_of_a_window_of_1440(sheet: Sheet, wide: str) -> None:
    # That is what JupyterLab leaves to an output beside its file browser.
    sheet.page.set_viewport_size({"width": 1010, "height": 900})
    sheet.put(wide)
    sizes = sheet.page.locator("figure text.name").evaluate_all(
        "all => all.map(each => each.getBoundingClientRect().height)"
    )
    assert len(sizes) > 50
    assert min(sizes) >= 9
    assert overflow(sheet)[0] <= 0, "it is as wide as the output"
    assert sheet.page.locator(".epypes-window").bounding_box()["height"] <= 0.8 * 900


def test_fit_shows_the_whole_graph_and_the_scale_what_can_be_read(sheet: Sheet, wide: str) -> None:
    sheet.put(wide)
    before = scale_of(sheet)
    assert before >= 0.75
    sheet.page.click("text=Fit")
    assert scale_of(sheet) < 0.6
    assert max(overflow(sheet)) <= 0
    sheet.page.set_viewport_size({"width": 500, "height": 800})
    sheet.page.wait_for_function("document.querySelector('figure svg').clientWidth < 500")
    assert max(overflow(sheet)) <= 0, "also in a window of another size"
    sheet.page.set_viewport_size({"width": 1200, "height": 800})
    sheet.page.click(".epypes-zoom button >> nth=1")
    sheet.page.wait_for_function(
        f"document.querySelector('.epypes-zoom button:nth-child(2)').textContent === '{before:.0%}'"
    )


def test_zoom_by_buttons_and_by_the_wheel_keeps_what_is_under_the_pointer(sheet: Sheet, wide: str) -> None:
    sheet.put(wide)
    before = scale_of(sheet)
    sheet.page.click("text=+")
    assert scale_of(sheet) == pytest.approx(1.25 * before)
    sheet.page.click(".epypes-zoom button >> nth=0")
    assert scale_of(sheet) == pytest.approx(before)
    sheet.page.locator("#token-left_1").hover(position={"x": 5, "y": 5})
    vertex = sheet.page.locator("#token-left_1")
    was = vertex.bounding_box()
    sheet.page.keyboard.down("Control")
    sheet.page.mouse.wheel(0, -200)
    sheet.page.keyboard.up("Control")
    sheet.page.wait_for_function(
        f"document.querySelector('#token-left_1').getBoundingClientRect().width > {1.2 * was['width']}"
    )
    now = vertex.bounding_box()
    assert (now["x"], now["y"]) == pytest.approx((was["x"], was["y"]), abs=12)
    scrolled = sheet.page.evaluate("scrollY")
    sheet.page.mouse.wheel(0, 100)
    sheet.page.wait_for_function("document.querySelector('.epypes-window').scrollTop > 0")
    assert sheet.page.evaluate("scrollY") == scrolled, "the wheel alone scrolls"


def test_a_graph_that_is_cut_is_dragged_and_a_drag_chooses_nothing(sheet: Sheet, wide: str) -> None:
    sheet.put(wide)
    sheet.page.click("text=+")
    sheet.page.click("text=+")
    assert min(overflow(sheet)) > 100
    box = sheet.page.locator(".epypes-window").bounding_box()
    at = box["x"] + 0.6 * box["width"], box["y"] + 0.6 * box["height"]
    scrolled = "view => [view.scrollLeft, view.scrollTop]"
    before = sheet.page.locator(".epypes-window").evaluate(scrolled)
    sheet.page.mouse.move(*at)
    sheet.page.mouse.down()
    sheet.page.mouse.move(at[0] - 60, at[1] - 90, steps=4)
    sheet.page.mouse.up()
    now = sheet.page.locator(".epypes-window").evaluate(scrolled)
    assert [now[0] - before[0], now[1] - before[1]] == pytest.approx([60, 90], abs=2)
    assert sheet.vertices("chosen") == set()
    sheet.page.mouse.move(at[0], at[1], steps=3)
    assert sheet.page.locator(".epypes-window").evaluate(scrolled) == now, "the button is up"
    assert sheet.page.locator("#token-left_3").count()
    sheet.page.locator("#token-left_3").click()
    assert sheet.vertices("chosen") == {"left_3"}


def test_the_scroll_bar_of_a_graph_can_be_seen(sheet: Sheet, wide: str) -> None:
    sheet.put(wide)
    style = "view => getComputedStyle(view, '::-webkit-scrollbar-thumb').backgroundColor"
    thumb = sheet.page.locator(".epypes-window").evaluate(style)
    ground = sheet.page.locator(".epypes-window").evaluate(style.replace("thumb", "track"))
    assert thumb != ground
    assert sheet.page.locator("figure.cut").count() == 1


def test_a_small_graph_stays_as_it_is(sheet: Sheet) -> None:
    sheet.put(mimebundle(edge_runner().cg)["text/html"])
    assert scale_of(sheet) == 1
    assert max(overflow(sheet)) <= 0
    assert not sheet.page.get_by_text("Fit").is_visible()
    sheet.page.hover("#function-blur")
    assert sheet.page.get_by_text("Fit").is_visible()


# -- without a script ---------------------------------------------------------------------------------------------------


def test_a_page_without_scripts_opens_the_kept_pictures(sheet: Sheet, edges: str) -> None:
    sheet.put(re.sub(r"(?s)<(script|style)\b.*?</\1>", "", edges))
    pictures = sheet.page.locator("details.epypes-album img")
    assert not pictures.first.is_visible()
    sheet.page.click("summary")
    assert pictures.count() == 4
    assert pictures.first.is_visible()
    assert sheet.page.locator("details.epypes-album figcaption").all_inner_texts() == [
        "edges", "image", "image_gray", "image_blurred",
    ]  # fmt: skip
    sheet.put(edges)
    assert not sheet.page.locator("summary").is_visible(), "where scripts run they are shown at their tokens"


def test_a_still_picture_says_how_it_comes_alive(sheet: Sheet, edges: str) -> None:
    sheet.put(edges)
    assert "Trust the notebook" not in sheet.page.inner_text("body")
    sheet.put(re.sub(r"(?s)<script\b.*?</script>", "", edges))
    assert "Trust the notebook" in sheet.page.inner_text("body")


def test_choosing_a_group_opens_what_is_inside_it(sheet: Sheet) -> None:
    cg = ep.group(ep.group(edge_runner().cg, "before <it>", ["grayscale", "blur"]), "after", ["canny"])
    sheet.put(mimebundle(cg)["text/html"])
    insides = sheet.page.locator("details svg.epypes-graph")
    assert insides.count() == 2
    assert not any(insides.nth(place).is_visible() for place in range(2))
    sheet.page.click(".group >> nth=0")
    opened = sheet.page.locator("details[open]").evaluate_all("all => all.map(each => each.dataset.group)")
    assert opened == ["before <it>"]
    assert not sheet.has_card, "of what came under the pointer"
    inside = sheet.page.locator("details[open] svg.epypes-graph")
    inside.locator("#function-blur").click()
    assert "GaussianBlur" in sheet.page.locator("details[open] .epypes-about").inner_text()


# -- keyboard and screen reader ---------------------------------------------------------------------------------------


def test_the_keyboard_goes_as_the_data_flows_and_does_what_the_mouse_does(sheet: Sheet, edges: str) -> None:
    sheet.put(edges)
    reached = []
    for _ in range(9):
        sheet.page.keyboard.press("Tab")
        reached.append(sheet.focused())
    assert reached == [
        "token-image", "function-grayscale", "token-image_gray", "token-blur_kernel", "function-blur",
        "token-image_blurred", "token-canny_lo", "token-canny_hi", "function-canny",
    ]  # fmt: skip
    sheet.page.keyboard.press("Tab")
    assert "fresh" in sheet.card
    ring = "document.activeElement.matches(':focus-visible') && getComputedStyle(document.activeElement).outlineStyle"
    assert sheet.page.evaluate(ring) == "solid"
    sheet.page.keyboard.press("Shift+Tab")
    before = sheet.page.evaluate("scrollY")
    for key in ("Enter", " "):
        sheet.page.keyboard.press(key)
        assert sheet.about.startswith("function canny")
        assert sheet.page.locator("#function-canny").get_attribute("aria-pressed") == "true"
        sheet.page.keyboard.press("Escape")
        assert sheet.about == ""
    assert sheet.page.evaluate("scrollY") == before


def test_a_screen_reader_is_told_every_vertex_the_panel_and_the_tables(sheet: Sheet, edges: str) -> None:
    sheet.put(edges)
    labels = sheet.page.locator("svg [role=button]").evaluate_all("all => all.map(each => each.ariaLabel)")
    assert any(re.match("token edges: uint8 400 x 600, 0 to 255, .*, fresh$", label) for label in labels)
    assert len(labels) == 10
    assert sheet.page.locator("svg title").count() == 0, "a title would show a second card"
    assert sheet.page.locator(".epypes-about").get_attribute("aria-live") == "polite"
    assert sheet.page.get_by_role("table").count() == 2
    assert sheet.page.evaluate("document.documentElement.scrollWidth <= innerWidth"), "tables for the ear take no room"


# -- pages ------------------------------------------------------------------------------------------------------------


def test_one_output_shown_twice_is_two_pictures_of_their_own(sheet: Sheet, edges: str) -> None:
    sheet.put(edges, edges, edges.replace("grayscale", "greyscale"))
    assert sheet.page.locator("figure svg.epypes-graph").count() == 3
    sheet.page.locator("#function-blur").nth(1).click()
    assert sheet.page.locator(".epypes-about").evaluate_all("all => all.map(each => each.innerText !== '')") == [
        False, True, False,
    ]  # fmt: skip
    sheet.page.locator("#token-edges").nth(2).hover()
    assert sheet.page.locator(".epypes-card:popover-open").count() == 1


# As VS Code runs the scripts of an output: at its end, one by one, each taken out again.
_AS_VS_CODE = """html => {
    const output = document.querySelector('.output');
    output.innerHTML = html;
    for (const script of Array.from(output.getElementsByTagName('script'))) {
        const again = document.createElement('script');
        again.text = script.innerText;
        if (script.type) again.type = script.type;
        output.appendChild(again).parentNode.removeChild(again);
    }
}"""
# As JupyterLab does: each script in its own place.
_AS_LAB = """html => {
    const output = document.querySelector('.output');
    output.innerHTML = html;
    for (const script of output.querySelectorAll('script')) {
        const again = document.createElement('script');
        for (const { name, value } of script.attributes) again.setAttribute(name, value);
        again.textContent = script.textContent;
        script.parentNode.replaceChild(again, script);
    }
}"""


def test_a_picture_that_is_taken_away_and_put_back_shows_its_card_again(sheet: Sheet, edges: str) -> None:
    sheet.put(edges)
    sheet.page.hover("#token-edges")
    sheet.page.evaluate("window.kept = document.querySelector('.epypes-sheet'); window.kept.remove()")
    sheet.page.wait_for_function("!window.kept.querySelector('.epypes-card.open')")
    sheet.page.evaluate("document.querySelector('.output').append(window.kept)")
    sheet.page.hover("#token-edges")
    assert sheet.card[0] == "token edges"


def test_the_card_follows_its_vertex_when_the_page_scrolls(sheet: Sheet, edges: str) -> None:
    sheet.put(edges + LATER)
    sheet.page.keyboard.press("Tab")
    sheet.page.keyboard.press("Tab")
    beside = """() => {
        const [card, vertex] = ['.epypes-card', '#function-grayscale']
            .map(each => document.querySelector(each).getBoundingClientRect());
        return Math.abs(card.top + card.height / 2 - vertex.top - vertex.height / 2) < 2;
    }"""
    sheet.page.wait_for_function(beside)
    sheet.page.evaluate("scrollBy(0, 90)")
    sheet.page.wait_for_function(beside)
    assert sheet.page.evaluate("scrollY") > 50


@pytest.mark.parametrize("run_scripts", [_AS_VS_CODE, _AS_LAB], ids=["VS Code", "JupyterLab"])
def test_a_notebook_that_runs_scripts_later_or_elsewhere_has_live_pictures(
    sheet: Sheet, edges: str, run_scripts: str
) -> None:
    sheet.put("")
    for _ in range(2):
        sheet.page.evaluate(run_scripts, edges)
        sheet.page.hover("#token-edges")
        assert sheet.card[0] == "token edges"
        sheet.page.click("#function-blur")
        assert "def blur" in sheet.about


def test_a_picture_of_something_else_takes_the_pages_colours_too(sheet: Sheet) -> None:
    svg = to_svg(edge_runner())
    sheet.put(paint_page(paint_figure(svg, "a bar picture", "below it")), style=PAGES["JupyterLab dark"])
    assert sheet.page.locator("figure svg.epypes-graph").count() == 1
    assert sheet.page.locator("svg [role=button]").count() == 0, "nothing is told of it"
    assert unreadable(sheet.page) == []


def test_nothing_is_left_of_a_picture_that_was_taken_away(sheet: Sheet, edges: str) -> None:
    heard = """window.heard = 0;
        for (const target of [window, document]) {
            const add = target.addEventListener;
            target.addEventListener = function (...all) { window.heard++; return add.apply(this, all); };
        }"""
    sheet.page.add_init_script(heard)
    sheet.page.goto("about:blank")
    sheet.put("")
    before = sheet.page.evaluate("window.heard")
    sheet.page.evaluate(_AS_LAB, edges)
    sheet.page.hover("#token-edges")
    assert sheet.has_card
    sheet.page.evaluate("document.querySelector('.output').replaceChildren()")
    assert sheet.page.evaluate("window.heard") == before
    assert not sheet.has_card
    sheet.page.keyboard.press("Escape")


EVIL = "</script><script>window.hit=1;alert(1)</script><img src=x onerror='window.hit=1;alert(1)'>"


def test_no_script_in_a_name_a_value_a_source_or_a_message_ever_runs(sheet: Sheet, tmp_path: Path) -> None:
    path = tmp_path / "evil.py"
    path.write_text(f'def f(x, y="{EVIL}"):\n    """{EVIL}"""\n    raise ValueError("""{EVIL}""")\n')
    names: dict[str, Any] = {}
    exec(compile(path.read_text(), path, "exec"), names)
    cg = ep.CompGraph({EVIL: names["f"]}, {EVIL: ((EVIL, "y"), f"{EVIL} z")})
    runner = ep.CompGraphRunner(cg, {"y": EVIL})
    with pytest.raises(ValueError, match="alert"):
        runner.run(**{EVIL: EVIL})
    sheet.put(mimebundle(runner)["text/html"])
    for vertex in sheet.page.locator("svg [role=button]").all():
        vertex.hover()
        vertex.click()
        assert EVIL[:9] in sheet.about or "hyperparameter token y" in sheet.about
    sheet.page.locator("svg .function").click()
    assert f'"""{EVIL}"""'[:100] in sheet.about, "the source, as text"
    assert sheet.page.evaluate("window.hit") is None
    assert sheet.page.locator("img").count() == 0


# -- readable ---------------------------------------------------------------------------------------------------------


def gray(image: np.ndarray) -> np.ndarray:
    return image.mean(axis=2).astype(np.uint8)


def many_states(photo: np.ndarray) -> str:
    """Pictures in which every state of functions and tokens is to be seen."""
    cg = ep.CompGraph(
        {"gray": gray, "canny": cv2.Canny, "half": lambda g: g // 2, "count": np.count_nonzero, "tell": ep.Placeholder()},
        {
            "gray": ("image", "image_gray"), "canny": (("image_gray", "lo", "hi"), "by_canny"),
            "half": ("image_gray", "by_half"), "count": ("edges", "n"), "tell": ("n", "page"),
        },
    )  # fmt: skip
    cg = ep.union(cg, ep.switch("choose", {"canny": "by_canny", "half": "by_half"}, by="method", output="edges"))
    runner = ep.CompGraphRunner(cg, {"lo": 70, "hi": 200, "method": "canny"})
    bundles = [mimebundle(cg), mimebundle(runner), mimebundle(runner.plan())]
    run = runner.run("n", image=photo)
    runner["lo"] = 80
    bundles += [mimebundle(run), mimebundle(runner), mimebundle(runner.plan("n"))]
    with pytest.raises(cv2.error):
        runner.rerun("n", lo="seventy")
    bundles.append(mimebundle(runner))
    bundles.append({"text/html": paint_page(_redefined(run))})
    return "".join(bundle["text/html"] for bundle in bundles)


def _redefined(run: ep.Run) -> str:
    graph = view(run)
    graph = replace(graph, functions=tuple(each._replace(is_redefined=True) for each in graph.functions))
    svg = paint_svg(graph)
    return "".join(paint_graph(graph, svg))


@pytest.fixture(scope="module")
def states(photo: np.ndarray) -> str:
    return many_states(photo)


@pytest.mark.parametrize("kind", PAGES)
def test_every_text_is_readable_on_every_page(sheet: Sheet, states: str, kind: str) -> None:
    sheet.put(states, style=PAGES[kind])
    assert len(readings(sheet.page, ".output")) > 200
    assert unreadable(sheet.page, ".output") == []
    for figure in sheet.page.locator(".epypes-figure").all():
        figure.locator(".function").first.click()
    assert sheet.page.locator(".epypes-about pre").count() >= 8, "with panels open and all else dimmed"
    sheet.page.locator(".token").first.hover()
    assert sheet.has_card
    assert unreadable(sheet.page, ".output") == []


@pytest.mark.parametrize("ground", ["#fff", "#111"])
def test_the_svg_file_is_readable_on_white_and_on_black_paper(sheet: Sheet, photo: np.ndarray, ground: str) -> None:
    runner = edge_runner()
    runner.run(image=photo)
    sheet.put(to_svg(runner), style=f"body{{background:{ground}}}")
    assert unreadable(sheet.page, ".output") == []


@pytest.mark.parametrize(
    "bad",
    [
        ".epypes-graph .small{fill:#999}",
        ".epypes-graph text{opacity:.5}",
        ".epypes-graph .function .shape{fill:#1769c2}",
        ".epypes-graph .shape{fill-opacity:0} body{background:#333}",
        "figcaption{color:#aaa}",
        ".epypes-about div{color:#0007}",
    ],
)
def test_a_text_that_can_not_be_read_would_be_found(sheet: Sheet, edges: str, bad: str) -> None:
    sheet.put(edges + f"<style>{bad}</style>")
    sheet.page.click("#function-blur")
    found = unreadable(sheet.page, ".output")
    assert found
    assert all(reading.ratio < ENOUGH for reading in found)


def test_states_are_told_apart_without_colour(sheet: Sheet, states: str) -> None:
    sheet.put(states)
    drawn = sheet.page.locator("svg .function:not(.placeholder)").evaluate_all(
        """all => all.map(each => { const style = getComputedStyle(each.querySelector('.shape'));
            return [[...each.classList].at(-1), style.strokeDasharray, style.strokeWidth,
                    [...each.querySelectorAll('text')].slice(1).map(text => text.textContent).join()]; })"""
    )
    looks: dict[str, set[str]] = {}
    for state, dashes, width, text in drawn:
        looks.setdefault(state, set()).add(json.dumps([dashes, width, re.sub(r"[\d.]+ .s, \d+%", "time", text)]))
    assert {"static", "not-run", "ran", "stale", "failed", "planned", "reused", "left-out"} <= set(looks)
    for state, own in looks.items():
        for other, others in looks.items():
            assert state == other or not own & others, f"{state} and {other} look alike"


# -- where notebooks are read -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("colours", ["light", "dark"])
def test_a_notebook_that_was_converted_to_html_can_be_explored_and_read(
    sheet: Sheet, photo: np.ndarray, tmp_path: Path, colours: str
) -> None:
    import nbformat  # takes seconds
    from nbconvert import HTMLExporter

    bundle = mimebundle(edge_runner().run(image=photo))
    output = nbformat.v4.new_output("display_data", dict(bundle))
    cell = nbformat.v4.new_code_cell("run", outputs=[output], execution_count=1)
    html, _ = HTMLExporter(theme=colours).from_notebook_node(nbformat.v4.new_notebook(cells=[cell]))
    path = tmp_path / "notebook.html"
    path.write_text(html)
    sheet.page.route(re.compile("^https?://"), lambda route: route.abort())
    sheet.page.goto(path.as_uri(), wait_until="domcontentloaded")
    assert sheet.page.locator("figure svg.epypes-graph").count() == 1
    sheet.page.hover("#token-edges")
    assert sheet.card[0] == "token edges"
    sheet.page.click("#function-blur")
    assert "def blur" in sheet.about
    assert unreadable(sheet.page) == []
