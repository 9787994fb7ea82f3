"""What to_source writes for the graphs that people have, and what it refuses."""

from __future__ import annotations

import enum
import math

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.errors import HyperparameterError, PlaceholderNeeded, SourceRefused, UnknownName
from tests.bundle.test_slicer import notebook
from tests.conftest import EDGE_HPARAMS, EDGE_IO
from tests.properties.test_straight_line import ruff_says
from tests.seeds import printed

EDGE_CELL = """
# Weighs the channels as people see them.
def grayscale(im):
    return cv2.cvtColor(im, cv2.COLOR_BGR2GRAY)


def blur(img, k):
    return cv2.GaussianBlur(img, (k, k), 0)
"""


class Method(enum.Enum):
    CANNY = 1
    SOBEL = 2


def detect_and_describe(image, mask, nfeatures, scale_factor, score_type):
    orb = cv2.ORB_create(nfeatures, scale_factor, scoreType=score_type)
    return orb.detectAndCompute(image, mask)


def match(descriptors_1, descriptors_2, norm, cross_check):
    found = cv2.BFMatcher(norm, cross_check).match(descriptors_1, descriptors_2)
    return sorted(found, key=lambda pair: pair.distance)


def gather(keypoints_1, keypoints_2, matches):
    return np.array([[*keypoints_1[pair.queryIdx].pt, *keypoints_2[pair.trainIdx].pt] for pair in matches])


def smooth(image, size=5, weights=(0.25, 0.5)):
    return cv2.GaussianBlur(image, (size, size), weights[1])


def bright(smooth, limit=90):
    return smooth > limit


def add_one(number):
    return number + 1


def same(value):
    return value


def fails(number):
    raise AssertionError("a function of another branch was called")


def executed(text: str, name: str = "run_graph"):
    """Check how the text reads, then return its function from an empty namespace."""
    assert ruff_says(text) == ""
    names: dict = {}
    exec(compile(text, "straight", "exec"), names)
    return names[name]


def source_with(value, token="k"):
    return ep.to_source(ep.CompGraph({"f": same}, {"f": (token, "y")}), {token: value})


def test_a_notebooks_graph_becomes_what_a_colleague_would_have_written(photograph, straight_edges):
    names = notebook(EDGE_CELL)
    functions = {"grayscale": names["grayscale"], "blur": names["blur"], "canny": cv2.Canny}
    text = ep.to_source(ep.CompGraph(functions, EDGE_IO), EDGE_HPARAMS, name="edges")
    assert text == (
        "import cv2\n\n" + EDGE_CELL + "\n\ndef edges(image, *, blur_kernel=11, canny_lo=70, canny_hi=200):\n"
        '    """Return edges."""\n'
        "    image_gray = grayscale(image)\n"
        "    image_blurred = blur(image_gray, blur_kernel)\n"
        "    edges = cv2.Canny(image_blurred, canny_lo, canny_hi)\n"
        "    return edges\n"
    )
    assert np.array_equal(executed(text, "edges")(photograph), straight_edges)


def test_a_runner_and_a_pipeline_are_written_with_their_hyperparameters(edge_graph, edge_runner, photograph):
    text = ep.to_source(edge_graph, EDGE_HPARAMS)
    assert ep.to_source(edge_runner) == ep.to_source(ep.Pipeline("edges", edge_graph, EDGE_HPARAMS)) == text
    edge_runner["canny_lo"] = 90
    made = executed(ep.to_source(edge_runner, {"canny_hi": 150}))(photograph)
    assert np.array_equal(made, edge_runner.run(image=photograph)["edges"]) is False
    edge_runner["canny_hi"] = 150
    assert np.array_equal(made, edge_runner.rerun()["edges"])
    edge_runner.unfreeze("canny_hi")
    assert "def run_graph(image, canny_hi, *, blur_kernel=11, canny_lo=90):" in ep.to_source(edge_runner)


def test_the_orb_graph_computes_the_same(photograph):
    hparams = {"nfeatures": 200, "scale_factor": 1.2, "score_type": cv2.ORB_HARRIS_SCORE, "mask_1": None, "mask_2": None,
               "norm": cv2.NORM_HAMMING, "cross_check": True}  # fmt: skip
    single = ep.CompGraph(
        {"detect": detect_and_describe},
        {"detect": (("image", "mask", "nfeatures", "scale_factor", "score_type"), ("keypoints", "descriptors"))},
    )
    cg = ep.extend(
        ep.union(single, single, suffixes=("_1", "_2"), keep=("nfeatures", "scale_factor", "score_type")),
        {"match": match, "gather": gather},
        {
            "match": (("descriptors_1", "descriptors_2", "norm", "cross_check"), "matches"),
            "gather": (("keypoints_1", "keypoints_2", "matches"), "keypoints_paired"),
        },
    )
    shifted = np.roll(photograph, 7, axis=1)
    run = ep.CompGraphRunner(cg, hparams).run(image_1=photograph, image_2=shifted)
    made = executed(ep.to_source(cg, hparams))(photograph, shifted)
    assert made.shape[0] > 50
    assert np.array_equal(made, run["keypoints_paired"])


def test_defaults_of_functions_are_defaults_of_the_whole(photograph):
    cg = ep.CompGraph.from_functions(smooth, bright)
    text = ep.to_source(cg, {"limit": 120})
    assert "def run_graph(image, *, size=5, weights=(0.25, 0.5), limit=120):" in text
    run = ep.CompGraphRunner(cg, {"limit": 120}).run(image=photograph)
    assert np.array_equal(executed(text)(photograph), run["bright"])


def test_only_what_is_asked_for_is_written_with_only_what_that_needs(edge_graph, photograph):
    text = ep.to_source(edge_graph, EDGE_HPARAMS, returns="image_gray")
    assert "def run_graph(image):" in text
    assert "Canny" not in text
    assert ep.to_source(edge_graph, EDGE_HPARAMS, returns=["image_gray"]) == text
    run = ep.CompGraphRunner(edge_graph, EDGE_HPARAMS).run(image=photograph)
    both = executed(ep.to_source(edge_graph, EDGE_HPARAMS, returns=["edges", "image_gray"]))(photograph)
    assert [np.array_equal(made, run[token]) for made, token in zip(both, ("edges", "image_gray"), strict=True)] == [
        True
    ] * 2
    with pytest.raises(UnknownName, match="Did you mean 'edges'"):
        ep.to_source(edge_graph, returns=["edgs"])


def choosing(keys):
    """Return a switch in a switch: b serves two branches of the inner one, a serves everything."""
    cg = ep.CompGraph(
        {"before": add_one, "plus": add_one, "again": add_one, "fail": fails, "fail_too": fails},
        {"before": ("x", "a"), "plus": ("a", "b"), "again": ("b", "c"), "fail": ("b", "d"), "fail_too": ("a", "e")},
    )
    inner = ep.switch("inner", {"c": "c", "b": "b", "d": "d"}, by="how", output="chosen")
    return cg | inner | ep.switch("outer", dict(zip(keys, ("chosen", "e"), strict=True)), by="method", output="y")


@pytest.mark.slow
@pytest.mark.parametrize("keys", [("p", "q"), (None, True), (1, 2.5), (Method.CANNY, Method.SOBEL), ((1, "a"), b"\n'")])
def test_of_a_switch_only_the_chosen_branch_runs(keys):
    cg = choosing(keys)
    text = ep.to_source(cg, {"method": keys[0], "how": "c"})
    assert executed(text)(1) == ep.CompGraphRunner(cg, {"method": keys[0], "how": "c"}).run(x=1)["y"] == 4
    assert executed(text)(1, how="b") == 3
    for not_chosen in ({"how": "d"}, {"method": keys[1]}):
        with pytest.raises(AssertionError, match="was called"):
            executed(text)(1, **not_chosen)
    for unknown in ({"method": "?"}, {"how": ["c"]}):
        with pytest.raises(ValueError, match="Unknown"):
            executed(text)(1, **unknown)


def test_what_several_branches_need_runs_before_the_switch():
    lines = ep.to_source(choosing(("p", "q")), {"method": "p", "how": "c"}).splitlines()
    depths = {line.split()[0]: len(line) - len(line.lstrip()) for line in lines if " = " in line}
    assert depths == {"a": 4, "b": 8, "c": 12, "d": 12, "chosen": 12, "e": 8, "y": 8}


def test_a_pipeline_in_a_graph_becomes_a_function_of_its_own(edge_graph, photograph):
    inner = ep.Pipeline("my edges", edge_graph, EDGE_HPARAMS)
    outer = ep.Pipeline(
        "outer",
        ep.CompGraph({"edges": inner, "copy": ep.Node("copy", same)}, {"edges": ("im", "e"), "copy": ("e", ("f"))}),
    )
    cg = ep.CompGraph({"one": outer, "two": inner}, {"one": ("left", "a"), "two": ("right", "b")})
    inner["canny_lo"] = 30
    text = ep.to_source(cg, name="both")
    assert "def my_edges(image, *, blur_kernel=11, canny_lo=30, canny_hi=200):" in text
    assert text.count("def my_edges(") == 1
    assert text.index("def my_edges(") < text.index("def both(")
    run = ep.CompGraphRunner(cg).run(left=photograph, right=photograph[:90])
    made = executed(text, "both")(photograph, photograph[:90])
    assert all(np.array_equal(value, run[token]) for value, token in zip(made, "ab", strict=True))


def test_a_node_or_pipeline_that_does_more_is_refused(edge_graph):
    class Doubling(ep.Node):
        def compute(self, *args):
            return 2 * super().compute(*args)

    class Other(ep.Pipeline):
        def compute(self, *args):
            return super().compute(*args)

    cg = ep.CompGraph(
        {"n": Doubling("n", abs), "p": Other("p", edge_graph)}, {"n": ("x", "y"), "p": (tuple("abcd"), "z")}
    )
    with pytest.raises(SourceRefused) as error:
        ep.to_source(cg)
    assert ["'Doubling'" in error.value.reasons[0], "'Other'" in error.value.reasons[1]] == [True, True]


def test_names_that_hide_nothing_and_mean_nothing_to_python_are_kept():
    cg = ep.CompGraph(
        {"root": math.sqrt, "max": max, "y": same},
        {"root": ("math", "max"), "max": (("max", "class"), "l"), "y": ("l", "y z")},
    )
    text = ep.to_source(cg)
    assert "def run_graph(math_, class_):" in text
    assert "        math_: 'math'\n        class_: 'class'\n        y_z: 'y z'\n" in text
    assert "    l_ = max(max_, class_)\n" in text
    assert executed(text)(16.0, 3) == 4.0


def test_a_variable_does_not_hide_what_a_partial_calls():
    names = notebook("def scale(x, by):\n    return x * by\nthrice = functools.partial(scale, by=3)\n")
    text = ep.to_source(ep.CompGraph({"f": names["thrice"]}, {"f": ("scale", "y")}))
    assert executed(text)(2) == 6


def test_a_long_value_is_a_constant_above_the_function():
    text = source_with([*range(60)])
    assert "\n\nK = [\n    0,\n" in text
    assert "\n\n\ndef run_graph(*, k=K):\n" in text


def test_outputs_are_written_as_the_graph_takes_them():
    LOGGED.clear()
    cg = ep.CompGraph(
        {"two": divmod, "one": list_of_one, "none": log},
        {"two": (("x", "y"), ("q", "r")), "one": ("q", ("z",)), "none": (("r", "z"), None)},
    )
    text = ep.to_source(cg)
    assert "    q, r = divmod(x, y)\n    (z,) = " in text
    assert "return" not in text
    assert executed(text)(7, 2) is None
    assert LOGGED == [(1, 3)]


LOGGED: list = []


def list_of_one(value):
    return [value]


def log(*values):
    LOGGED.append(values)


VALUES = [
    np.array([[0.1, -0.0], [1e300, 7]]), np.eye(9, dtype=np.uint8), np.float32(0.1), np.bool_(True), float("inf"), float("-inf"),
    {"a": (np.uint8(3), [Method.CANNY])}, frozenset({"b", "a"}), frozenset(), {3, 1, 2}, set(), np.uint8, math.hypot, max,
    1e+16, "\\\"'\n", "'", '"', b"\x00'\xff", (1,), 2 - 3j, -0.0, list(range(60)), "x" * 200, {"key": list(range(40))},
    np.arange(60, dtype=">i4").reshape(2, 30), ("画" * 30, 1), ep.Param(1, 31, odd=True), True, None, [[]], {"a": {}},
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("value", VALUES, ids=lambda value: f"{type(value).__name__}")
def test_a_hyperparameters_value_is_made_again_to_the_last_bit(value):
    made = executed(source_with(value))()
    assert type(made) is type(value)
    if isinstance(value, np.ndarray):
        assert (made.dtype, made.shape, made.tobytes()) == (value.dtype, value.shape, value.tobytes())
    elif isinstance(value, set | frozenset):
        assert made == value
    else:
        assert repr(made) == repr(value)


@pytest.mark.parametrize("value", [object(), np.zeros(999), [object()], np.array([np.nan])])
def test_a_value_without_an_expression_is_refused_by_name_with_the_way_out(value):
    with pytest.raises(SourceRefused, match="Hyperparameter 'k' is of type .* Leave it free"):
        source_with(value)


def test_every_reason_is_given_at_once_with_its_place():
    cell = (
        "class C:\n    def m(self, x):\n        return x\n    def __call__(self, *xs):\n        return xs\na = C().m\n"
    )
    names = notebook(cell + "b = functools.partial(C(), 2)\ndef c(x):\n    return p + q\n")
    inner = ep.Pipeline("inner", ep.CompGraph({"d": names["a"]}, {"d": (("x",), "y")}))
    functions = {name: names[name] for name in "abc"} | {"i": inner}
    cg = ep.CompGraph(functions, {name: (("x", "k")[:1], f"y{name}") for name in functions})
    with pytest.raises(SourceRefused) as error:
        ep.to_source(cg, {"x": object()}, name="class")
    reasons = error.value.reasons
    assert len(reasons) == 7
    for words in (
        "name='class'",
        "'a' is a method of",
        "'d' of pipeline 'inner' is a method of",
        "The function of function 'b' is an object of class 'C'",
        "'p'",
        "'q'",
    ):
        assert sum(words in reason for reason in reasons) == 1
    assert str(error.value).startswith("Not written:\n- ")


def test_placeholders_that_are_needed_are_named_and_others_are_not_asked_for():
    cg = ep.CompGraph({"f": abs, "g": ep.Placeholder()}, {"f": ("x", "y"), "g": ("y", "z")})
    with pytest.raises(PlaceholderNeeded) as error:
        ep.to_source(cg)
    assert error.value.functions == ("g",)
    assert executed(ep.to_source(cg, returns=["y"]))(-3) == 3


def test_what_can_not_be_a_hyperparameter_or_a_function_is_refused_as_everywhere(edge_graph):
    with pytest.raises(HyperparameterError):
        ep.to_source(edge_graph, {"edges": 1})
    with pytest.raises(UnknownName):
        ep.to_source(edge_graph, {"egdes": 1})
    with pytest.raises(TypeError, match="'dict'"):
        ep.to_source({})
    with pytest.raises(SourceRefused, match="name='max' can't be"):
        ep.to_source(edge_graph, name="max")


def holding_itself(kind):
    held = kind()
    held[:1] = [held]
    return held


@pytest.mark.parametrize(
    "value",
    [10**5000, (10**5000, "a"), [-(10**5000)], {"a": 10**5000}, holding_itself(list), [holding_itself(list)] * 2],
    ids=["int", "tuple", "list", "dict", "list in itself", "twice"],
)
def test_a_value_that_python_can_not_write_is_refused_as_every_other(value):
    with pytest.raises(SourceRefused, match="Hyperparameter 'k' is of type .* Leave it free"):
        source_with(value)


def test_a_switch_by_what_python_can_not_write_is_refused():
    with pytest.raises(SourceRefused, match="Switch 's' chooses 'a' by a key of type int, which no expression makes"):
        ep.to_source(ep.switch("s", {10**5000: "a"}, by="k", output="y"))


class Loud(str):
    """A str of another class, which has the same repr."""


def test_a_kind_of_string_inside_a_tuple_is_not_written_as_a_plain_one():
    with pytest.raises(SourceRefused, match="Hyperparameter 'k' is of type tuple"):
        source_with((Loud("a"),))


def test_a_switch_with_several_outputs_is_unpacked_as_the_runner_unpacks_it():
    function = ep.switch("s", {"a": "t", "b": "u"}, by="m", output="o").functions["s"]
    for outputs, given in ((("o", "p"), (1, 2)), (("o",), (1,)), (None, 1)):
        cg = ep.CompGraph({"s": function}, {"s": (("m", "t", "u"), outputs)})
        text = ep.to_source(cg, {"m": "a"})
        run = ep.CompGraphRunner(cg, {"m": "a"}).run(t=given, u=None)
        expected = tuple(run[token] for token in cg.sink_tokens)
        assert executed(text)(given, None) == {0: None, 1: expected[:1] and expected[0]}.get(len(expected), expected)


def test_a_function_called_like_the_whole_gets_the_name_that_it_has_in_the_graph():
    names = notebook("def f(x):\n    return x + 1\n")
    text = ep.to_source(ep.CompGraph({"g": names["f"]}, {"g": ("x", "y")}), name="f")
    assert text.startswith("def g(x):\n    return x + 1\n")
    assert executed(text, "f")(3) == 4


def test_of_our_marks_the_one_that_changes_what_is_computed_stays():
    names = notebook('@ep.unguarded\n@ep.outputs("a", "b")\ndef f(x):\n    return x, 2 * x\n')
    text = ep.to_source(ep.CompGraph.from_functions(names["f"]))
    assert text.startswith("import epypes as ep\n\n\n@ep.unguarded\ndef f(x):"), "the io is that of the graph"
    assert executed(text)(4) == (4, 8)


def test_a_switch_in_a_switch_in_a_switch_is_an_if_in_an_if():
    cg = ep.CompGraph({"f": abs}, {"f": ("x", "y0")})
    for depth in range(25):
        cg = cg | ep.switch(f"s{depth}", {1: f"y{depth}", 2: f"n{depth}"}, by="k", output=f"y{depth + 1}")
    assert executed(ep.to_source(cg, {"k": 1}))(-2, *range(25)) == 2


@pytest.mark.slow
def test_the_text_is_the_same_under_any_hash_seed():
    code = (
        "import epypes as ep, math\n"
        "a = ep.CompGraph({'f': max, 'g': math.hypot}, {'f': (('x', 's'), 'y z'), 'g': (('x', 'y z'), 'y_z')})\n"
        "b = a | ep.switch('c', {'a': 'y_z', 'b': 'x'}, by='k', output='o')\n"
        "print(ep.to_source(b, {'s': {'a', 'b', 'c', 'd'}, 'k': 'a'}))"
    )
    texts = printed(code, "0123")
    assert len(texts) == 1


@pytest.mark.slow
def test_a_chain_of_ten_thousand_functions_is_written():
    names = notebook("".join(f"def f{number}(x):\n    return x + 1\n\n\n" for number in range(100)))
    functions = {f"f{number}": names[f"f{number % 100}"] if number % 2 else math.floor for number in range(10_000)}
    cg = ep.CompGraph(functions, {f"f{number}": (f"t{number}", f"t{number + 1}") for number in range(10_000)})
    assert executed(ep.to_source(cg))(0) == 5000


def test_long_constants_of_the_notebook_stand_as_they_were():
    names = notebook(
        "RGB = Annotated[np.ndarray, ep.Image('uint8', ('height', 'width', 3), (0, 255), 'rgb')]\n"
        "NAMES = ('alpha', 'beta', 'gamma', 'delta', 'epsilon', 'zeta', 'eta', 'theta', 'iota', 'kappa')\n"
        f"TEXT = {'y' * 75!r}\nTABLE = {{'a': {list(range(30))}, 'b': {{1: 2}}}}\nK = np.eye(7)\nC = (1e16, 1 + 2j)\n"
        "def f(x: RGB):\n    return NAMES, TEXT, TABLE, K.shape, C\n"
    )
    text = ep.to_source(ep.CompGraph({"f": names["f"]}, {"f": ("x", "y")}))
    assert executed(text)(0) == names["f"](0)


NOTHING_CELL = """
from epypes import Nothing


def clipped(x):
    return x if x < 5 else Nothing


def find(x):
    return clipped(x)


def split(x):
    return ep.Nothing if x == 3 else (x, ep.Nothing if x == 2 else -x)


def add(a, b):
    return a + b


def double(y):
    return 2 * y


def show(y):
    print(y)
"""


def test_what_takes_nothing_is_skipped_as_in_the_graph():
    names = notebook(NOTHING_CELL)
    inner = ep.CompGraph({"find": names["find"], "double": names["double"]}, {"find": ("x", "y"), "double": ("y", "z")})
    functions = {name: names[name] for name in ("find", "split", "add", "double")}
    io = {"find": ("x", "y"), "split": ("x", ("a", "b")), "add": (("y", "b"), "sum"), "double": ("a", "twice")}
    cg = ep.CompGraph(
        {**functions, "inner": ep.Pipeline("inner", inner), "other": names["double"], "always": names["double"]},
        {**io, "inner": ("x", "i"), "other": ("i", "j"), "always": ("x", "k")},
    )
    runner = ep.CompGraphRunner(
        cg | ep.switch("choose", {"s": "sum", "t": "twice"}, by="how", output="end"), {"how": "s"}
    )
    text = ep.to_source(runner)
    assert "if y is ep.Nothing or b is ep.Nothing:" in text
    assert "k = double(x)" in text.replace("    ", "")
    run_graph = executed(text)
    for how in "st":
        runner.set(how=how)
        for x in (1, 2, 3, 4, 5, 9):
            run = runner.run(x=x)
            assert run_graph(x, how=how) == tuple(run[token] for token in runner.cg.sink_tokens)


def test_a_function_without_outputs_is_called_only_where_something_was_found(capsys):
    names = notebook(NOTHING_CELL)
    cg = ep.CompGraph({"find": names["find"], "show": names["show"]}, {"find": ("x", "y"), "show": ("y", None)})
    run_graph = executed(ep.to_source(cg))
    for x in (1, 9, 2):
        run_graph(x)
    assert capsys.readouterr().out == "1\n2\n"


def test_a_hyperparameter_may_be_nothing():
    assert executed(source_with(ep.Nothing))() is ep.Nothing
    assert executed(source_with(ep.Nothing))(k=3) == 3


# -- state between calls ----------------------------------------------------------------------------------------------

STATE_CELL = """
def mix(x, before, k):
    return x if before is None else k * x + (1 - k) * before


def double(value):
    return 2 * value


def negative(value):
    return -value


def step(x, before):
    return x - before
"""


def flat(state):
    """Return the values of a state, also those of pipelines in the graph."""
    parts = [flat(value) if isinstance(value, dict) else [value] for value in state.values()]
    return [value for part in parts for value in part]


def with_state():
    """Return graphs with state by what is special about them, with payloads of a series."""
    names = notebook(STATE_CELL)
    mix, double, negative, step = (names[name] for name in ("mix", "double", "negative", "step"))
    io = {"mix": (("x", "before", "k"), "mixed"), "double": ("mixed", "y")}
    plain = ep.delay(ep.CompGraph({"mix": mix, "double": double}, io), "mixed", "before")
    inner = ep.Pipeline("inner", plain, {"k": 0.5})
    middle = ep.CompGraph({"inner": inner, "n": negative}, {"inner": ("x", "y"), "n": ("x", "m")})
    two = ep.CompGraph({"a": step, "b": negative}, {"a": (("x", "ago"), "y"), "b": ("last", "z")})
    nested = ep.CompGraph(
        {"middle": ep.Pipeline("middle", middle), "again": inner, "step": step},
        {"middle": ("x", ("y", "m")), "again": ("m", "v"), "step": (("v", "v before"), "w")},
    )
    chosen = ep.switch("choose", {"on": "y", "off": "other"}, by="mode", output="chosen")
    both = ep.switch("choose", {"on": "u", "off": "v"}, by="mode", output="chosen")
    other = ep.CompGraph({"other": negative}, {"other": ("x", "other")})
    branches = ep.CompGraph({"u": double, "v": negative}, {"u": ("y", "u"), "v": ("y", "v")})
    in_branch = ep.CompGraph({"inner": inner, "other": negative}, {"inner": ("x", "y"), "other": ("x", "other")})
    series = [{"x": x} for x in (4.0, 2.0, 8.0)]
    modes = [{"x": x, "mode": mode} for x, mode in ((4.0, "on"), (100.0, "off"), (2.0, "on"), (8.0, "off"))]
    return {
        "a token": (plain, series),
        "a payload, and a delay of a delay": (ep.delay(ep.delay(two, "x", "last", 0), "last", "ago", 1), series),
        "pipelines in pipelines": (ep.delay(nested, "v", "v before", 0), series),
        "a branch": (plain | other | chosen, modes),
        "both branches": (plain | branches | both, modes),
        "a pipeline in a branch": (in_branch | chosen, modes),
    }


@pytest.mark.parametrize("what", [*with_state()])
def test_a_graph_with_state_takes_and_returns_it(what):
    cg, payloads = with_state()[what]
    values = {"k": 0.5} if "k" in cg.tokens else {}
    runner = ep.CompGraphRunner(cg, values)
    text = ep.to_source(cg, values)
    assert not ruff_says(text)
    names, state = {}, {}
    exec(text, names)
    function = names["run_graph"]
    for payload in payloads:
        run = runner.run(**payload)
        value, state = function(*(payload[token] for token in runner.free_source_tokens), **state)
        expected = tuple(run[token] for token in cg.sink_tokens)
        assert (value if len(expected) > 1 else (value,)) == expected
        assert flat(state) == [*run.state.values()]


def test_state_reads_as_a_colleague_would_have_written_it():
    cg, _ = with_state()["a token"]
    assert ep.to_source(cg, {"k": 0.5}, name="track").endswith('''
def track(x, *, before=None, k=0.5):
    """Return y, and the state for the next call."""
    mixed = mix(x, before, k)
    y = double(mixed)
    return y, {"before": mixed}
''')
    text = ep.to_source(cg, {"k": 0.5}, returns=["mixed", "y"])
    assert 'return (mixed, y), {"before": mixed}' in text
    cg, _ = with_state()["a pipeline in a branch"]
    text = ep.to_source(cg, {"mode": "on"})
    assert 'def run_graph(x, *, mode="on", inner_state={}):' in text
    assert "        y, inner_state = inner(x, **inner_state)\n" in text
    assert 'return chosen, {"inner_state": inner_state}\n' in text
    cg, _ = with_state()["a branch"]
    text = ep.to_source(cg, {"k": 0.5})
    assert "    next_before = before\n    if mode == " in text
    assert "        next_before = mixed\n" in text
    sink = ep.CompGraph({"show": print}, {"show": (("x", "last"), None)})
    assert 'return None, {"last": x}' in ep.to_source(ep.delay(sink, "x", "last"))
    unrelated = ep.to_source(cg, {"k": 0.5}, returns="other")
    assert "before" not in unrelated
    assert "state" not in unrelated


def test_state_of_what_some_branches_need_is_refused_and_so_is_an_initial_value_without_an_expression():
    names = notebook(STATE_CELL)
    cg, _ = with_state()["a token"]
    branches = ep.CompGraph(
        {"u": names["double"], "v": names["negative"], "w": names["double"]},
        {"u": ("y", "u"), "v": ("y", "v"), "w": ("x", "w")},
    )
    cg |= branches | ep.switch("choose", {1: "u", 2: "v", 3: "w"}, by="mode", output="chosen")
    with pytest.raises(SourceRefused, match="Function 'mix' makes what the next run begins with, and only some"):
        ep.to_source(cg, {"k": 0.5})
    cg = ep.CompGraph({"step": names["step"]}, {"step": (("x", "before"), "y")})
    with pytest.raises(SourceRefused, match="The initial value of 'before' is of type object.*begin with None"):
        ep.to_source(ep.delay(cg, "y", "before", object()))


def test_state_stays_as_it_was_where_nothing_was_found():
    names = notebook("def find(x):\n    return x if x > 0 else ep.Nothing\n\n\ndef add(m, t):\n    return m + t\n")
    functions = {name: names[name] for name in ("find", "add")}
    cg = ep.delay(ep.CompGraph(functions, {"find": ("x", "m"), "add": (("m", "t"), "s")}), "s", "t", 0)
    run_graph, runner, state = executed(ep.to_source(cg)), ep.CompGraphRunner(cg), {}
    for x in (1, 2, -1, 3, -2, 4):
        found, state = run_graph(x, **state)
        assert found == runner.run(x=x)["s"]
        assert state == dict(runner.state)


@pytest.mark.parametrize("where", ["always", "in a branch"])
def test_a_pipeline_with_state_may_take_and_make_nothing(where):
    names = notebook(
        "def find(x):\n    return ep.Nothing if x < 0 else x\n\n\ndef add(m, before):\n    return m + before\n\n\n"
        "def odd(s):\n    return s if s % 2 else ep.Nothing\n"
    )
    inner = ep.CompGraph({"add": names["add"], "odd": names["odd"]}, {"add": (("m", "before"), "s"), "odd": ("s", "o")})
    pipeline = ep.Pipeline("total", ep.delay(inner, "s", "before", 0))
    cg = ep.CompGraph({"find": names["find"], "total": pipeline}, {"find": ("x", "m"), "total": ("m", "y")})
    cg |= ep.CompGraph({"both": names["add"]}, {"both": (("m", "y before"), "b")})
    cg = ep.delay(cg, "y", "y before", 7)
    values = {}
    if where == "in a branch":
        cg |= ep.switch("choose", {1: "y", 2: "b"}, by="how", output="z")
        values = {"how": 1}
    run_graph, runner, state = executed(ep.to_source(cg, values)), ep.CompGraphRunner(cg, values), {}
    for number, x in enumerate((1, 2, -1, 3, 5, -2, 4, 8)):
        how = {"how": 1 + (number == 4)} if values else {}
        runner.set(**how)
        run = runner.run(x=x)
        found, state = run_graph(x, **how, **state)
        assert (found if len(cg.sink_tokens) > 1 else (found,)) == tuple(run[token] for token in cg.sink_tokens)
        assert flat(state) == [*run.state.values()]


def test_state_stays_as_it_was_where_what_it_takes_is_nothing_by_now():
    names = notebook("def add(x, before):\n    return x + before\n")
    cg = ep.CompGraph(
        {"add": names["add"], "more": names["add"]}, {"add": (("x", "second"), "y"), "more": (("x", "first"), "z")}
    )
    cg = ep.delay(ep.delay(cg, "first", "second", 3), "x", "first", ep.Nothing)
    run_graph, runner, state = executed(ep.to_source(cg)), ep.CompGraphRunner(cg), {}
    for x in (1, 2, 4):
        run = runner.run(x=x)
        found, state = run_graph(x, **state)
        assert (*found, *state.values()) == (run["y"], run["z"], *run.state.values())
