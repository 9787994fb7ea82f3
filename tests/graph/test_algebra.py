from __future__ import annotations

import functools
from typing import Annotated

import numpy as np
import pytest

import epypes as ep
from epypes.errors import EpypesError, GraphError, PlaceholderNeeded, UnknownName
from epypes.graph import is_placeholder
from tests.seeds import printed


def kinds(error: pytest.ExceptionInfo[GraphError]) -> list[str]:
    return [finding.kind for finding in error.value.findings]


def detect(image, mask, nfeatures=500):
    return f"k{image}{mask}", nfeatures


def match(left, right):
    return left, right


def identity(x):
    return x


@pytest.fixture
def single():
    return ep.CompGraph.from_functions(ep.outputs("keypoints", "descriptors")(detect))


def chain(count, prefix="f"):
    functions = {f"{prefix}{index}": identity for index in range(count)}
    return functions, {f"{prefix}{index}": (f"{prefix}t{index}", f"{prefix}t{index + 1}") for index in range(count)}


def test_the_orb_graph_is_the_union_of_one_graph_with_itself_extended(single):
    two = ep.union(single, single, suffixes=("_1", "_2"), keep=("nfeatures",))
    assert two.source_tokens == ("image_1", "mask_1", "nfeatures", "image_2", "mask_2")
    assert dict(two.defaults) == {"nfeatures": 500}
    cg = ep.extend(two, {"match": match}, {"match": (("descriptors_1", "descriptors_2"), "matches")})
    run = ep.CompGraphRunner(cg, {"nfeatures": 9}).run(image_1=1, mask_1=2, image_2=3, mask_2=4)
    assert (run["keypoints_1"], run["keypoints_2"], run["matches"]) == ("k12", "k34", (9, 9))


def test_union_joins_at_tokens_of_one_name_whatever_the_number_of_graphs():
    graphs = [
        ep.CompGraph({f"f{index}": identity}, {f"f{index}": (f"t{index}", f"t{index + 1}")}) for index in range(4)
    ]
    cg = ep.union(*graphs)
    assert cg.tokens == ("t0", "t1", "t2", "t3", "t4")
    assert dict((graphs[0] | graphs[1] | graphs[2] | graphs[3]).func_io) == dict(cg.func_io)
    assert ep.union().tokens == ()


def test_the_order_of_the_arguments_is_the_order_of_definition():
    a, b = (ep.CompGraph({name: identity}, {name: ("x", name)}) for name in "ab")
    assert list((b | a).functions) == ["b", "a"]
    assert list((a | b).functions) == ["a", "b"]


def test_the_same_function_with_the_same_io_is_one(single):
    assert dict((single | single).func_io) == dict(single.func_io)


@pytest.mark.parametrize(("function", "io"), [(str, ("x", "y")), (identity, ("x", "z")), (identity, ("w", "y"))])
def test_another_function_or_io_under_one_name_is_refused(function, io):
    one = ep.CompGraph({"f": identity}, {"f": ("x", "y")})
    with pytest.raises(GraphError, match="Two graphs have a function 'f'") as error:
        one | ep.CompGraph({"f": function}, {"f": io})
    assert "two functions" in kinds(error)


def test_every_problem_of_a_union_is_reported_at_once():
    def with_other_default(k=2):
        return k

    def defaulted(k=1):
        return k

    one = ep.CompGraph({"f": identity, "g": identity}, {"f": ("x", "y"), "g": ("a", "b")})
    two = ep.CompGraph({"f": str, "h": identity, "i": identity}, {"f": ("x", "z"), "h": ("q", "y"), "i": ("b", "a")})
    with pytest.raises(GraphError) as error:
        ep.union(one, two, ep.CompGraph.from_functions(defaulted), ep.CompGraph.from_functions(with_other_default))
    assert set(kinds(error)) == {"two functions", "two producers", "cycle", "defaults"}


def test_a_union_can_hide_a_default_by_making_the_token():
    graph = ep.CompGraph.from_functions(ep.outputs("a", "b")(detect))
    assert dict((graph | ep.CompGraph({"f": identity}, {"f": ("n", "nfeatures")})).defaults) == {}


def test_the_number_of_suffixes_is_the_number_of_graphs(single):
    for suffixes in (("_1",), ("_1", "_2", "_3"), "ab"):
        with pytest.raises(ValueError, match="one per graph"):
            ep.union(single, single, suffixes=suffixes)


def test_a_name_to_keep_must_be_in_one_of_the_graphs(single):
    other = ep.CompGraph({"f": identity}, {"f": ("x", "y")})
    assert "nfeatures" in ep.union(single, other, suffixes=("_1", "_2"), keep=["nfeatures", "f"]).tokens
    with pytest.raises(UnknownName, match="Did you mean 'nfeatures'"):
        ep.union(single, single, suffixes=("_1", "_2"), keep=("nfeature",))
    with pytest.raises(UnknownName, match="Did you mean 'nfeatures'"):
        ep.suffix(single, "_1", keep="nfeature")


def test_a_kept_name_stays_through_nested_suffixes(single):
    inner = ep.union(single, single, suffixes=("_1", "_2"), keep="nfeatures")
    outer = ep.union(inner, inner, suffixes=("_a", "_b"), keep="nfeatures")
    assert sorted(outer.functions) == ["detect_1_a", "detect_1_b", "detect_2_a", "detect_2_b"]
    assert outer.tokens.count("nfeatures") == 1
    three = ep.union(single, single, single, suffixes=("_1", "_2", "_3"), keep="nfeatures")
    assert sorted(three.functions) == ["detect_1", "detect_2", "detect_3"]


@pytest.mark.parametrize("call", [ep.union, ep.rename, ep.subgraph, ep.suffix, ep.extend])
def test_what_is_no_graph_is_refused_with_the_way_out(call, single):
    with pytest.raises(TypeError, match=r"\.cg\."):
        call(ep.CompGraphRunner(single), *([] if call in (ep.union, ep.rename) else [{}]))
    with pytest.raises(TypeError, match="unsupported operand"):
        single | 3


def test_two_names_can_be_exchanged():
    cg = ep.CompGraph({"f": identity, "g": str}, {"f": ("a", "b"), "g": ("b", "c")})
    other = ep.rename(cg, functions={"f": "g", "g": "f"}, tokens={"a": "c", "c": "a"})
    assert dict(other.func_io) == {"g": ("c", "b"), "f": ("b", "a")}
    assert other.functions["f"] is str


def test_names_that_would_be_one_are_refused_all_at_once():
    cg = ep.CompGraph({"f": identity, "g": str}, {"f": ("a", "b"), "g": ("b", "c")})
    with pytest.raises(GraphError, match="would both be called") as error:
        ep.rename(cg, functions={"f": "g"}, tokens={"a": "c"})
    assert [finding.names for finding in error.value.findings] == [("f", "g", "g"), ("a", "c", "c")]
    kept = ep.CompGraph({"f": identity, "f_1": str}, {"f": ("a", "b"), "f_1": ("b", "c")})
    with pytest.raises(GraphError, match="'f' and 'f_1' would both be called 'f_1'"):
        ep.suffix(kept, "_1", keep="f_1")


def test_unknown_and_empty_names_are_refused_by_rename(single):
    with pytest.raises(UnknownName, match="Did you mean 'mask'"):
        ep.rename(single, tokens={"maks": "m"})
    with pytest.raises(UnknownName, match="Did you mean 'detect'"):
        ep.rename(single, functions={"detekt": "m"})
    with pytest.raises(TypeError, match="new name of 'mask'"):
        ep.rename(single, tokens={"mask": ""})
    with pytest.raises(TypeError, match="mapping from old to new"):
        ep.rename(single, ["mask"])


def test_a_function_and_a_token_of_one_name_are_renamed_apart():
    cg = ep.CompGraph.from_functions(identity)
    assert dict(ep.rename(cg, functions={"identity": "same"}).func_io) == {"same": (("x",), "identity")}


def test_a_subgraph_has_what_its_targets_need_and_nothing_else(edge_graph):
    part = ep.subgraph(edge_graph, "image_blurred")
    assert list(part.functions) == ["grayscale", "blur"]
    assert part.source_tokens == ("image", "blur_kernel")
    assert list(ep.subgraph(edge_graph, ["image_gray"]).functions) == ["grayscale"]
    with pytest.raises(UnknownName, match="Did you mean 'edges'"):
        ep.subgraph(edge_graph, ["edge"])
    with pytest.raises(TypeError, match="name or an iterable of names"):
        ep.subgraph(edge_graph, 3)


def test_a_subgraph_keeps_the_defaults_that_still_matter():
    def f(x, a=1):
        return x

    def g(f, b=2):
        return f

    cg = ep.CompGraph.from_functions(f, g)
    assert dict(ep.subgraph(cg, "f").defaults) == {"a": 1}
    assert dict(ep.subgraph(cg, "g").defaults) == {"a": 1, "b": 2}


def test_defaults_switches_and_placeholders_survive_every_operation(single):
    sketch = ep.CompGraph({"todo": ep.Placeholder()}, {"todo": ("keypoints", "points")})
    choose = ep.switch("choose", {"raw": "keypoints", "own": "points"}, by="method", output="chosen")
    cg = single | sketch | choose
    assert (cg.placeholders, cg.switches, dict(cg.defaults)) == (("todo",), ("choose",), {"nfeatures": 500})
    other = ep.extend(cg, {"f": identity}, {"f": ("chosen", "end")})
    for same in (ep.rename(cg), ep.subgraph(cg, "chosen"), cg | cg, ep.suffix(cg, ""), other):
        assert (same.placeholders, same.switches, dict(same.defaults)) == (("todo",), ("choose",), {"nfeatures": 500})
    renamed = ep.suffix(cg, "_1")
    assert (renamed.placeholders, renamed.switches, dict(renamed.defaults)) == (
        ("todo_1",), ("choose_1",), {"nfeatures_1": 500},
    )  # fmt: skip


def test_extend_fills_placeholders_and_keeps_their_io_unless_another_is_given():
    sketch = ep.CompGraph({"f": ep.Placeholder(), "g": identity}, {"f": (("x", "w"), "y"), "g": ("y", "z")})
    assert sketch.placeholders == ("f",)
    filled = ep.extend(sketch, {"f": match})
    assert (filled.placeholders, filled.functions["f"]) == ((), match)
    other = ep.extend(sketch, {"f": identity}, {"f": ("x", "y")})
    assert dict(other.func_io) == {"f": ("x", "y"), "g": ("y", "z")}
    assert sketch.placeholders == ("f",)
    with pytest.raises(GraphError, match="takes 1 input"):
        ep.extend(sketch, {"f": identity})


def test_extend_replaces_no_function_and_says_all_that_is_wrong():
    cg = ep.CompGraph({"f": identity}, {"f": ("x", "y")})
    with pytest.raises(GraphError, match="'f' of the graph is not a placeholder") as error:
        ep.extend(cg, {"f": str, "g": identity, "h": identity}, {"g": ("q", "y"), "k": ("x", "z")})
    assert kinds(error) == ["not a placeholder", "no io", "no function", "two producers"]
    with pytest.raises(TypeError, match="func_dict must be a mapping"):
        ep.extend(cg, [identity])


def test_extend_does_not_follow_changes_of_the_dicts():
    functions, io = {"g": identity}, {"g": ("y", "z")}
    cg = ep.extend(ep.CompGraph({"f": identity}, {"f": ("x", "y")}), functions, io)
    functions["h"] = io["h"] = None
    assert list(cg.functions) == ["f", "g"]


def test_a_placeholder_fits_any_io_and_cannot_be_called():
    assert repr(ep.Placeholder()) == "<Placeholder>"
    assert is_placeholder(ep.Placeholder())
    assert is_placeholder(ep.Node("n", ep.Placeholder()))
    assert not is_placeholder(identity)
    ep.CompGraph({"f": ep.Placeholder()}, {"f": (("a", "b", "c"), ("d", "e"))})
    with pytest.raises(EpypesError, match=r"ep\.extend"):
        ep.Placeholder()(1)


def test_the_error_of_placeholders_names_all_of_them_and_the_way_out():
    error = PlaceholderNeeded(["blur", "match"])
    assert str(error) == "Functions 'blur', 'match' are placeholders. Give them: ep.extend(cg, {'blur': ...})."
    assert error.functions == ("blur", "match")
    assert isinstance(error, NotImplementedError)
    assert str(PlaceholderNeeded(["f"])) == "Function 'f' is a placeholder. Give it: ep.extend(cg, {'f': ...})."


def test_a_graph_of_10000_functions_goes_through_every_operation():
    cg = ep.CompGraph(*chain(10_000))
    two = ep.union(cg, cg, suffixes=("_1", "_2"), keep="ft0")
    assert len(two.functions) == 20_000
    assert len(ep.subgraph(two, "ft9000_2").functions) == 9_000
    assert ep.rename(cg, tokens={"ft0": "start"}).source_tokens == ("start",)


def test_one_bound_method_read_twice_is_one_function():
    class Camera:
        def shot(self, exposure):
            return exposure

    camera = Camera()
    one, two = (ep.CompGraph({"f": camera.shot}, {"f": ("x", "y")}) for _ in range(2))
    assert len((one | two).functions) == 1
    with pytest.raises(GraphError):
        one | ep.CompGraph({"f": Camera().shot}, {"f": ("x", "y")})
    with pytest.raises(GraphError):
        one | ep.CompGraph({"f": functools.partial(camera.shot)}, {"f": ("x", "y")})


def test_unions_have_one_order_under_any_hash_seed():
    code = (
        "import epypes as ep\n"
        "f = lambda *xs: (1, 2)\n"
        "one = ep.CompGraph(dict.fromkeys('dcba', f), {'d': (('p', 'q'), 'r'), 'c': ('x', ('p', 'q')), 'b': ('x', ('u', 'v')),"
        " 'a': (('u', 'v', 'r'), None)})\n"
        "cg = ep.subgraph(ep.union(one, one, suffixes=('_1', '_2'), keep='x'), ('v_2', 'r_1'))\n"
        "print(list(cg.functions), cg.tokens, cg.source_tokens, cg.sink_tokens)"
    )
    texts = printed(code)
    assert len(texts) == 1
    assert "['c_1', 'd_1', 'b_2']" in texts.pop()


CELL = """
def shared(x):
    return x + {number}
"""


def defined(number, names):
    exec(CELL.format(number=number), names)
    return names["shared"]


def test_a_function_whose_cell_was_run_again_is_the_same_one():
    names = {"__name__": "__main__"}
    one, again, other = defined(1, names), defined(1, names), defined(2, names)
    assert one is not again
    left = ep.CompGraph({"f": one}, {"f": ("x", "y")})
    assert (left | ep.CompGraph({"f": again}, {"f": ("x", "y")})).functions["f"] is one
    with pytest.raises(GraphError, match="It was defined again in between: build both graphs anew"):
        left | ep.CompGraph({"f": other}, {"f": ("x", "y")})
    with pytest.raises(GraphError, match="with another callable or io. Rename one of them"):
        left | ep.CompGraph({"f": one}, {"f": ("x", "z")})
    with pytest.raises(GraphError, match="with another callable or io. Rename one of them"):
        left | ep.CompGraph({"f": abs}, {"f": ("x", "y")})


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("k=2", "k=2.0"),
        ("k=0.0", "k=-0.0"),
        ("k=1", "k=True"),
        ("*, k=2", "*, k=2.0"),
        ("k=(1, [2])", "k=(1, [2.0])"),
        ("k={'a': 1}", "k={'a': True}"),
        ("k=np.zeros(3)", "k=np.ones(3)"),
        ("k=np.zeros(3)", "k=np.zeros(3, int)"),
        ("k=np.zeros(3)", "k=-np.zeros(3)"),
        ("k=(np.zeros(3),)", "k=(np.ones(3),)"),
        ("k: int = 3", "k: float = 3"),
        ("k: Annotated[int, ep.Param(1, 9)] = 3", "k: Annotated[int, ep.Param(1, 8)] = 3"),
        ("k: Annotated[int, ep.Param(1, 9)] = 3", "k: Annotated[int, ep.Param(1.0, 9)] = 3"),
    ],
)
def test_functions_that_differ_in_a_default_or_an_annotation_alone_are_two(left, right):
    names = {"__name__": "__main__", "np": np, "ep": ep, "Annotated": Annotated}

    def defined_with(parameter):
        exec(f"def f(x, {parameter}):\n    return x", names)
        return ep.CompGraph({"f": names["f"]}, {"f": ("x", "y")})

    one, again, other = defined_with(left), defined_with(left), defined_with(right)
    assert (one | again).functions["f"] is one.functions["f"]
    assert ep.extend(one, {}, {}).functions["f"] is one.functions["f"]
    for graphs in ((one, other), (other, one)):
        with pytest.raises(GraphError, match="Two graphs have a function 'f', with another callable"):
            ep.union(*graphs)


def test_a_default_that_is_an_array_is_one_with_its_equal():
    names = {"__name__": "__main__", "np": np}
    graphs = []
    for array in ("zeros", "zeros", "ones"):
        exec(f"def f(x, k=np.{array}((9, 9))):\n    return k.sum() + x", names)
        graphs.append(ep.CompGraph.from_functions(names["f"]))
    one, again, other = graphs
    assert ep.CompGraphRunner(one | again).run(x=1)["f"] == 1
    with pytest.raises(GraphError, match="'k' has the default"):
        one | other


def test_a_suffix_is_a_text(single):
    with pytest.raises(TypeError, match='A suffix must be a string, such as "_1", not 1'):
        ep.suffix(single, 1)


def test_suffixes_have_an_order():
    cg = ep.CompGraph({"f": abs}, {"f": ("x", "y")})
    with pytest.raises(ValueError, match="needs a sequence of 2 suffixes"):
        ep.union(cg, cg, suffixes={"_1", "_2"})
