from __future__ import annotations

import functools
import importlib.util
import json
import linecache
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from urllib.parse import unquote

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.display import mimebundle, to_svg, view
from epypes.display.paint.page import paint_graph, paint_page
from epypes.display.paint.svg import paint_svg
from epypes.display.text import KEPT_CHARACTERS
from epypes.display.views.graphview import GraphView
from epypes.display.views.structure import LINE_CHARACTERS, SIGNATURE_CHARACTERS, SOURCE_LINES, signature_and_source
from tests.pictures import assert_same_picture

SVG = "{http://www.w3.org/2000/svg}"


class Seen(HTMLParser):
    """The elements of a page, as a browser would read them: attributes and texts by tag."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[tuple[str, str]] = []
        self._open = ""
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        self._open = tag

    def handle_data(self, data):
        self.texts.append((self._open, data))

    @property
    def data(self) -> dict:
        """What the script is told."""
        return next(json.loads(text) for tag, text in self.texts if tag == "script" and text.startswith("{"))

    @property
    def cells(self) -> list[str]:
        return [text for tag, text in self.texts if tag == "td"]


def html_of(shown) -> str:
    return mimebundle(shown)["text/html"]


def source_shown(html: str, place: int) -> str | None:
    data = Seen(html).data
    which = data["about"][place]
    return None if which is None else data["texts"][which][1]


# -- signature and source ---------------------------------------------------------------------------------------------


def plain(image, low=3, *, high: int = 7):
    # It says what it does.
    return (
        image + low,
        high,
    )


def test_a_function_tells_its_parameters_and_its_whole_source():
    signature, source = signature_and_source(plain)
    assert signature == "(image, low=3, *, high: 'int' = 7)"
    assert source.splitlines() == [
        "def plain(image, low=3, *, high: int = 7):",
        "    # It says what it does.",
        "    return (",
        "        image + low,",
        "        high,",
        "    )",
    ]


@functools.wraps(plain)
def wrapped(*args, **kwargs):
    return plain(*args, **kwargs)


@pytest.mark.parametrize(
    ("function", "signature"),
    [
        (wrapped, "(image, low=3, *, high: 'int' = 7)"),
        (functools.partial(plain, low=4), "(image, *, low=4, high: 'int' = 7)"),
        (ep.Node("plain", plain), "(image, low=3, *, high: 'int' = 7)"),
    ],
    ids=["decorated", "partial", "node"],
)
def test_the_users_own_function_is_told_whatever_it_is_wrapped_in(function, signature):
    assert signature_and_source(function)[0] == signature
    assert signature_and_source(function)[1].startswith("def plain(image")


def test_what_is_indented_is_told_at_the_margin():
    def inner(x):
        def deeper(y):
            return y

        return deeper(x)

    source = signature_and_source(inner)[1]
    assert source.startswith("def inner(x):\n    def deeper")
    assert source.endswith("    return deeper(x)")


def test_a_function_written_in_c_tells_the_beginning_of_its_documentation():
    signature, source = signature_and_source(cv2.Canny)
    first, second, *rest = source.splitlines()
    assert (signature, first) == ("", "# no source in Python; its documentation begins:")
    assert second.startswith("Canny(")
    assert len(rest) <= SOURCE_LINES


class Callable:
    def __call__(self, x):
        return x


class HasNoHash(Callable):
    __hash__ = None

    def __eq__(self, other):
        raise RuntimeError("not comparable")


class Hostile:
    def __repr__(self):
        raise RuntimeError("no repr")

    @property
    def __doc__(self):
        raise RuntimeError("no doc")


def hostile_default(x, y=Hostile(), z=[0] * 10**6):  # noqa: B008
    return x


def test_objects_that_are_called_tell_what_is_called():
    assert signature_and_source(Callable()) == ("(x)", "def __call__(self, x):\n    return x")
    assert signature_and_source(HasNoHash())[1] == "def __call__(self, x):\n    return x"


def test_defaults_that_raise_or_are_long_are_told_in_short():
    told = signature_and_source(hostile_default)[0]
    assert re.fullmatch(r"\(x, y=<Hostile: no repr: RuntimeErr…, z=list of 1000000\)", told)


@pytest.mark.parametrize("function", [Hostile(), Hostile, int, np.add, 3, None, "".join])
def test_whatever_is_asked_about_two_texts_come_back(function):
    assert all(isinstance(text, str) for text in signature_and_source(function))


def defined(source: str, name: str = "f"):
    """Return a function as a cell defines it."""
    file = f"<cell {hash(source)}>"
    linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)
    names: dict = {}
    exec(compile(source, file, "exec"), names)
    return names[name]


def test_long_sources_and_signatures_are_cut_and_say_so():
    many = "".join(f"    x = x + {index}\n" for index in range(100))
    signature, source = signature_and_source(
        defined(f"def f(x, {', '.join(f'parameter_{i}=1' for i in range(40))}):\n{many}    return {'x + ' * 100}x\n")
    )
    lines = source.splitlines()
    assert len(lines) == SOURCE_LINES
    assert lines[-1] == "…"
    assert max(map(len, lines)) == LINE_CHARACTERS
    assert len(signature) == SIGNATURE_CHARACTERS
    assert signature.endswith("…")


def test_a_file_that_was_changed_since_it_was_imported_is_not_told(tmp_path):
    path = tmp_path / "changing.py"
    path.write_text("def f(x):\n    return x\n")
    spec = importlib.util.spec_from_file_location("changing", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    path.write_text("# nothing is left of it\n\n\n")
    assert signature_and_source(module.f) == ("(x)", "")


def test_a_source_is_looked_for_once():
    function = defined("def f(x):\n    return x\n")
    cg = ep.CompGraph({"f": function}, {"f": ("x", "y")})
    before = html_of(cg)
    del linecache.cache[function.__code__.co_filename]
    assert html_of(cg) == before
    assert source_shown(before, 0) == "def f(x):\n    return x"


def test_a_pipeline_tells_the_functions_of_its_graph():
    inner = ep.Pipeline("inner", ep.CompGraph({"f": abs, "g": abs}, {"f": ("x", "y"), "g": ("y", None)}))
    function, *_ = view(ep.CompGraph({"both": inner}, {"both": ("a", None)})).functions
    assert function.source == "f(x) -> y\ng(y) -> nothing"


# -- size -------------------------------------------------------------------------------------------------------------


def chain(count, name="function_{}", hyperparameters=1, function=None):
    io, values = {}, {}
    for index in range(count):
        thresholds = tuple(f"threshold_{index}_{place}" for place in range(hyperparameters))
        io[name.format(index)] = ((f"t{index}", *thresholds), f"t{index + 1}")
        values |= dict.fromkeys(thresholds, 70)
    functions = {
        each: function or defined(f"def f(x, *more):\n    # {each}\n{'    x = x' * 1}\n    return x\n") for each in io
    }
    return ep.CompGraphRunner(ep.CompGraph(functions, io), values)


def dense(count, inputs):
    tokens, io = [f"s{index}" for index in range(inputs)], {}
    for index in range(count):
        io[f"f{index}"] = (tuple(tokens[(7 * index + 5 * place) % len(tokens)] for place in range(inputs)), f"t{index}")
        tokens.append(f"t{index}")
    return ep.CompGraphRunner(ep.CompGraph(dict.fromkeys(io, lambda *xs: xs[0]), io))


def long_source(number=0):
    return defined(
        f"def f(x, *more):\n    # {number}\n"
        + "".join(f"    x = x  # {'&<>' * 30} {line}\n" for line in range(40))
        + "    return x\n"
    )


NOISE = np.random.default_rng(0).integers(0, 255, (128, 128, 3)).astype(np.uint8)
GRAPHS = {
    **{f"{count} functions": (lambda count=count: chain(count), 1.5) for count in (3, 10, 60, 200)},
    "long names": (lambda: chain(60, "function_with_a_long_name_{}" + "x" * 150), 1.5),
    "names of other scripts": (lambda: chain(60, "数え上げる関数の名前{}", 0), "数え上げる" * 9),
    "names of signs": (lambda: chain(60, '"&<>%\'#{}', 0), "\"'&<>" * 9),
    "dense, few": (lambda: dense(30, 16), 1),
    "dense": (lambda: dense(200, 4), 1),
    "thumbnails": (lambda: chain(30, hyperparameters=0, function=lambda x: x.copy()), NOISE),
    "few thumbnails": (lambda: chain(2, hyperparameters=0, function=lambda x: x.copy()), NOISE),
    "long sources": (lambda: chain(20, function=long_source()), 1.5),
    "many long sources": (lambda: with_sources(20), 1.5),
}  # fmt: skip


def with_sources(count):
    functions = {f"f{index}": long_source(index) for index in range(count)}
    return ep.CompGraphRunner(ep.CompGraph(functions, {f"f{i}": (f"t{i}", f"t{i + 1}") for i in range(count)}))


def limit_of(bundle: dict[str, str], graph: GraphView) -> int:
    thumbnails = sum(map(len, re.findall(r'href="data:[^"]*"', bundle["image/svg+xml"])))
    return 30_000 + 600 * (len(graph.functions) + len(graph.tokens)) + min(thumbnails, 80_000)


@pytest.mark.slow
@pytest.mark.parametrize("kind", GRAPHS)
def test_a_picture_and_its_page_keep_their_limits(kind):
    make, value = GRAPHS[kind]
    runner = make()
    run = runner.run(**dict.fromkeys(runner.free_source_tokens, value))
    for shown in (runner.cg, run, runner, runner.plan()):
        bundle = mimebundle(ep.show(shown, collapse=False))
        limit = limit_of(bundle, view(shown, collapse=False))
        kept = sum(map(len, re.findall(r'<img src="data:image/[jp][^"]*"', bundle["text/html"])))
        assert kept <= KEPT_CHARACTERS
        assert len(bundle["image/svg+xml"]) <= limit
        assert len(bundle["text/html"]) <= limit + kept
        assert Seen(bundle["text/html"]).data["io"], "what the script needs is never left out"
        assert ET.fromstring(bundle["image/svg+xml"]).tag == f"{SVG}svg"


def test_sources_that_do_not_fit_are_left_out_the_least_relevant_first():
    count = 12
    runner = with_sources(count)
    graph = view(runner.run(t0=1))
    shares = (0.0, 0.1, 0.5, 0.2, *(0.01,) * (count - 4))
    functions = [each._replace(share=share) for each, share in zip(graph.functions, shares, strict=True)]
    functions[-1] = functions[-1]._replace(state="failed", share=0.0)
    graph = replace(graph, functions=tuple(functions))
    svg = paint_svg(graph)
    html = paint_page(*paint_graph(graph, svg))
    kept = [place for place in range(count) if source_shown(html, place)]
    assert 1 <= len(kept) < count
    by_relevance = [count - 1, 2, 3, 1, *range(4, count - 1), 0]
    assert set(kept) == set(by_relevance[: len(kept)])
    assert "source left out to keep the picture small" in html, "the script says it of the others"


def test_functions_that_are_one_callable_share_its_source():
    data = Seen(html_of(chain(20, function=long_source()).cg)).data
    assert len(data["texts"]) == 1
    assert set(data["about"]) == {0}


# -- the page ---------------------------------------------------------------------------------------------------------


def test_the_twin_lists_functions_and_tokens_with_values_and_states(edge_runner, photograph):
    run = edge_runner.run(image=photograph)
    cells = Seen(html_of(run)).cells
    at = cells.index("canny")
    assert cells[at + 1 : at + 3] == ["image_blurred, canny_lo, canny_hi", "edges"]
    assert re.fullmatch(r"ran; [\d.]+ (µs|ms)", cells[at + 3])
    for name, value, state in (
        ("canny_lo", "int 70", "hyperparameter, fresh"),
        ("image", "uint8 400 x 600 x 3 bgr, 0 to 255", "payload, fresh"),
    ):
        row = [cells[place : place + 3] for place, cell in enumerate(cells) if cell == name]
        assert [name, value, state] in [[each[0], each[1][: len(value)], each[2]] for each in row]


def test_the_twin_says_how_many_rows_do_not_fit():
    graph = view(chain(60).cg, collapse=False)
    svg, counts = paint_svg(graph), set()
    for taken in range(50_000, 70_000, 2_000):
        (figure,) = paint_graph(graph, svg, taken)
        cells = Seen(figure).cells
        more = [int(cell.split()[1]) for cell in cells if cell.startswith("and ")]
        rows = sum(cell.startswith("function_") for cell in cells)
        if 0 < rows < 60:
            assert more == [60 - rows]
            counts.add(rows)
    assert len(counts) > 1


EVIL = "</script><script>alert(1)</script><img src=x onerror=alert(1)>"


def test_no_name_value_source_documentation_or_message_becomes_markup():
    source = f'def f(x, *more):\n    """{EVIL}"""\n    raise ValueError({EVIL!r})\n'
    cg = ep.CompGraph({EVIL: defined(source)}, {EVIL: ((EVIL, "y"), "z")})
    runner = ep.CompGraphRunner(cg, {EVIL: EVIL})
    for shown in (cg, runner, runner.plan()):
        assert_is_ours_alone(mimebundle(shown))
    with pytest.raises(ValueError, match="alert"):
        runner.run(y=EVIL)
    bundle = mimebundle(runner)
    assert_is_ours_alone(bundle)
    assert source_shown(bundle["text/html"], 0) == source.rstrip()


def assert_is_ours_alone(bundle: dict[str, str]) -> None:
    found = Seen(bundle["text/html"])
    assert [tag for tag, _ in found.elements].count("script") == 2
    assert [tag for tag, _ in found.elements].count("img") == 1, "the graph"
    assert not any(name.startswith("on") for _, attributes in found.elements for name in attributes)
    tags = {each.tag.removeprefix(SVG) for each in ET.fromstring(bundle["image/svg+xml"]).iter()}
    assert tags <= {"svg", "style", "g", "title", "text", "rect", "path", "ellipse", "polygon"}


@pytest.mark.parametrize("name", ["50 % #1 & \"two\" 'three' <four>", "数え %41", "a\nb\tc"])
def test_the_image_is_the_picture_whatever_the_names(name):
    cg = ep.CompGraph({name: abs}, {name: ("x", f"{name}?")})
    source = next(attributes["src"] for tag, attributes in Seen(html_of(cg)).elements if tag == "img")
    assert_same_picture(unquote(source.partition(",")[2]), to_svg(cg))
    assert not re.search(r"[\n\t#]", source), "a browser would drop it, or end the address there"


def test_each_edge_that_a_run_uses_is_one_piece_of_the_paths():
    shared = tuple(f"h{index}" for index in range(9))
    cg = ep.CompGraph(dict.fromkeys("fg", lambda *xs: 1), {"f": (("x", *shared), "y"), "g": (("y", *shared), "z")})
    paths = {path.get("class"): path.get("d") for path in ET.fromstring(to_svg(cg)).iter(f"{SVG}path")}
    assert paths["edge"].count("M") == paths["tip"].count("M") == 22, "the script marks them one by one"


def test_the_script_is_told_the_edges_and_which_no_run_uses():
    cg = ep.CompGraph({"a": abs, "b": abs}, {"a": ("x", "u"), "b": ("x", "v")})
    cg = ep.union(cg, ep.switch("s", {"a": "u", "b": "v"}, by="which", output="y"))
    runner = ep.CompGraphRunner(cg, {"which": "a"})
    data = Seen(html_of(runner)).data
    number = {name: place for place, name in enumerate(cg.tokens)}
    assert data["io"][list(cg.functions).index("s")] == [
        [number["which"], number["u"], ~number["v"]], [number["y"]],
    ]  # fmt: skip


def test_a_page_that_runs_no_script_still_shows_picture_caption_and_twin(edge_runner, photograph):
    html = html_of(edge_runner.run(image=photograph))
    stripped = re.sub(r"<(script|style).*?</\1>", "", html, flags=re.DOTALL)
    found = Seen(stripped)
    image = next(attributes for tag, attributes in found.elements if tag == "img")
    assert image["src"].startswith("data:image/svg+xml,<svg")
    assert image["alt"].startswith("Computational graph of 3 functions: grayscale, blur, canny.")
    assert any(tag == "figcaption" and "in all, graph overhead" in text for tag, text in found.texts)
    assert "canny" in found.cells
    assert unescape(stripped).count("<table") == 2
