from __future__ import annotations

import copy
import pickle

import networkx as nx
import pytest

import epypes as ep
from epypes.errors import GraphError, UnknownName
from tests.seeds import printed


def kinds(error: pytest.ExceptionInfo[GraphError]) -> list[str]:
    return [finding.kind for finding in error.value.findings]


def identity(x):
    return x


def test_figure_2_of_the_paper_builds():
    cg = ep.CompGraph(
        {"f1": lambda a, b, c: (a, b), "f2": identity, "f3": lambda a, b, c: a},
        {"f1": (("t1", "t2", "t3"), ("t4", "t5")), "f2": ("t4", "t6"), "f3": (("t5", "t6", "t7"), "t8")},
    )
    assert cg.tokens == ("t1", "t2", "t3", "t4", "t5", "t6", "t7", "t8")
    assert cg.source_tokens == ("t1", "t2", "t3", "t7")
    assert cg.sink_tokens == ("t8",)
    assert ep.CompGraphRunner(cg, {"t2": 0, "t3": 0, "t7": 0}).free_source_tokens == ("t1",)


def test_functions_come_in_run_order_whatever_the_order_of_definition():
    cg = ep.CompGraph({"last": identity, "first": identity}, {"last": ("b", "c"), "first": ("a", "b")})
    assert list(cg.functions) == ["first", "last"]
    assert list(cg.func_io) == ["first", "last"]
    assert cg.tokens == ("a", "b", "c")


def test_a_function_may_be_called_like_a_token():
    cg = ep.CompGraph({"edges": identity}, {"edges": ("edges_in", "edges")})
    assert ep.CompGraphRunner(cg).run(edges_in=3)["edges"] == 3


def test_a_cycle_is_refused_with_its_shortest_way_round():
    functions = dict.fromkeys(["f", "g", "h", "start"], identity)
    io = {"start": ("x", "y"), "f": (("a",), "b"), "g": ("b", "c"), "h": ("c", "a")}
    with pytest.raises(
        GraphError, match=r"The graph has a cycle: a -> f\(\) -> b -> g\(\) -> c -> h\(\) -> a\. Rename"
    ) as error:
        ep.CompGraph(functions, io)
    assert kinds(error) == ["cycle"]


def test_of_two_cycles_the_shorter_is_named():
    functions = {"f": identity, "g": identity, "h": identity, "long": lambda x, y: x}
    io = {"long": (("c", "z"), "a"), "f": ("a", "b"), "g": ("b", "c"), "h": ("z", "z")}
    with pytest.raises(GraphError, match=r"cycle: z -> h\(\) -> z\."):
        ep.CompGraph(functions, io)


def test_two_producers_of_a_token_are_refused_and_both_are_named():
    with pytest.raises(GraphError, match="Token 'y' is made by 'f' and 'g'") as error:
        ep.CompGraph({"f": identity, "g": identity}, {"f": ("x", "y"), "g": ("x", "y")})
    assert kinds(error) == ["two producers"]


def test_a_token_made_twice_by_one_function_is_refused():
    with pytest.raises(GraphError, match="made by 'f' twice"):
        ep.CompGraph({"f": identity}, {"f": ("x", ("y", "y"))})


def test_function_without_io_and_io_without_function_are_refused():
    with pytest.raises(GraphError) as error:
        ep.CompGraph({"f": identity, "g": identity}, {"f": ("x", "y"), "k": ("y", "z")})
    assert kinds(error) == ["no io", "no function"]


@pytest.mark.parametrize("io", ["x", ("x",), ("x", 3), ("x", ("y", 1)), (None, "y"), ("", "y"), ("x", "y", "z"), 7])
def test_an_io_of_another_shape_is_refused_and_shown(io):
    with pytest.raises(GraphError, match="The io of function 'f' is") as error:
        ep.CompGraph({"f": identity}, {"f": io})
    assert kinds(error) == ["bad io"]


@pytest.mark.parametrize(
    ("function", "inputs", "fits"),
    [
        (lambda x: x, ("a",), True),
        (lambda x: x, ("a", "b"), False),
        (lambda x, y=1: x, ("a",), True),
        (lambda x, y=1: x, ("a", "b"), True),
        (lambda *xs: xs, ("a", "b", "c"), True),
        (lambda: 1, (), True),
        (lambda x, *, key: x, ("a",), False),
        (lambda x, *, key=1: x, ("a",), True),
        (len, ("a", "b"), False),
    ],
)
def test_the_number_of_inputs_is_checked_against_the_signature(function, inputs, fits):
    if fits:
        ep.CompGraph({"f": function}, {"f": (inputs, "y")})
    else:
        with pytest.raises(GraphError, match="Function 'f'") as error:
            ep.CompGraph({"f": function}, {"f": (inputs, "y")})
        assert kinds(error) == ["arity"]


def test_what_cannot_be_called_is_refused():
    with pytest.raises(GraphError, match="Function 'f' is int, which can't be called"):
        ep.CompGraph({"f": 3}, {"f": ("x", "y")})


@pytest.mark.parametrize("name", [3, "", None])
def test_the_name_of_a_function_is_a_text(name):
    with pytest.raises(GraphError, match="A function's name must be a string that is not empty, not"):
        ep.CompGraph({name: identity}, {name: ("x", "y")})


def test_every_problem_is_reported_at_once():
    with pytest.raises(GraphError) as error:
        ep.CompGraph(
            {"f": identity, "g": identity, "h": identity, "two": lambda a, b: a},
            {"f": ("a", "b"), "g": ("b", "a"), "two": ("q", "b"), "k": 5},
        )
    assert set(kinds(error)) == {"cycle", "two producers", "no io", "no function", "bad io", "arity"}


def test_none_as_output_means_no_output():
    seen = []
    cg = ep.CompGraph({"show": seen.append}, {"show": ("x", None)})
    assert cg.func_outputs("show") == ()
    ep.CompGraphRunner(cg).run(x=3)
    assert seen == [3]


def test_lists_count_as_tuples():
    cg = ep.CompGraph({"f": lambda a, b: (a, b)}, {"f": [["a", "b"], ["c", "d"]]})
    assert cg.func_io["f"] == (("a", "b"), ("c", "d"))


def test_an_unknown_name_is_named_with_the_nearest_one(edge_graph):
    with pytest.raises(UnknownName, match=r"^No token 'canny_low' in this graph\. Did you mean 'canny_lo'\?$"):
        edge_graph.require_token("canny_low")
    with pytest.raises(UnknownName, match="Did you mean 'canny'"):
        edge_graph.func_inputs("cany")


def test_the_graph_does_not_follow_changes_of_the_dicts_it_was_made_from():
    functions, io = {"f": identity}, {"f": ("x", "y")}
    cg = ep.CompGraph(functions, io)
    functions["g"], io["g"] = identity, ("y", "z")
    assert list(cg.functions) == ["f"]
    with pytest.raises(TypeError):
        cg.functions["g"] = identity


@pytest.mark.parametrize("shuffle", [1, 7])
def test_a_chain_of_10000_functions_builds_and_runs(shuffle):
    count = 10_000
    order = [(index * shuffle) % count for index in range(count)]
    cg = ep.CompGraph(
        {f"f{index}": identity for index in order},
        {f"f{index}": (f"t{index}", f"t{index + 1}") for index in order},
    )
    assert cg.source_tokens == ("t0",)
    assert ep.CompGraphRunner(cg).run(t0=5)[f"t{count}"] == 5


def test_a_cycle_of_5000_functions_is_found():
    count = 5_000
    io = {f"f{index}": (f"t{index}", f"t{(index + 1) % count}") for index in range(count)}
    with pytest.raises(GraphError) as error:
        ep.CompGraph(dict.fromkeys(io, identity), io)
    assert len(error.value.findings[0].names) == 2 * count + 1


@pytest.mark.slow
def test_order_and_picture_are_the_same_under_any_hash_seed():
    code = (
        "import epypes as ep; from epypes.display import to_svg\n"
        "cg = ep.CompGraph({n: (lambda x: x) for n in 'gfkhba'}, {'g': ('x','y'), 'f': ('x','z'), 'k': ('z','w'),"
        " 'h': ('y','v'), 'b': ('v','u'), 'a': ('w','s')})\n"
        "print(list(cg.functions), cg.tokens, cg.source_tokens, cg.sink_tokens); print(to_svg(cg))"
    )
    texts = printed(code)
    assert len(texts) == 1


def test_networkx_agrees_on_the_structure(edge_graph):
    graph = edge_graph.to_networkx()
    assert nx.is_bipartite(graph)
    assert nx.is_directed_acyclic_graph(graph)
    assert nx.ancestors(graph, ("token", "image_blurred")) == {
        ("token", "image"), ("token", "image_gray"), ("token", "blur_kernel"), ("function", "grayscale"),
        ("function", "blur"),
    }  # fmt: skip


def test_the_repr_is_one_short_line(edge_graph):
    assert repr(edge_graph) == "<CompGraph: 3 functions, 7 tokens; image, blur_ker... -> edges>"
    names = [f"token_with_a_long_name_{index}" for index in range(50)]
    wide = ep.CompGraph({"f": lambda *xs: xs}, {"f": (names[:25], names[25:])})
    assert len(repr(wide)) < 100


@pytest.mark.parametrize(("functions", "io"), [([len], {}), ({}, None), (None, None), ({}, [("x", "y")])])
def test_what_is_no_mapping_is_refused_by_name(functions, io):
    with pytest.raises(TypeError, match="must be a mapping by function name"):
        ep.CompGraph(functions, io)


def test_an_object_whose_signature_raises_is_taken_for_one_without():
    class Hostile:
        __signature__ = property(lambda self: 1 / 0)

        def __call__(self, x):
            return x

    assert ep.CompGraphRunner(ep.CompGraph({"f": Hostile()}, {"f": ("x", "y")})).run(x=1)["y"] == 1


def test_functions_whose_value_is_used_up_when_it_is_read_are_refused():
    def numbers(x):
        yield from range(x)

    async def later(x):
        return x

    for function in (numbers, later):
        with pytest.raises(GraphError, match="'f' is a generator or a coroutine.* Return a list, or await") as error:
            ep.CompGraph({"f": function}, {"f": ("x", "y")})
        assert error.value.findings[0].names == ("f", "y")


def test_a_graph_can_be_copied_and_pickled():
    cg = ep.CompGraph.from_functions(add_default)
    assert copy.deepcopy(cg) is cg
    for same in (copy.copy(cg), pickle.loads(pickle.dumps(cg))):
        assert dict(same.functions) == dict(cg.functions)
        assert (dict(same.func_io), dict(same.defaults)) == (dict(cg.func_io), {"k": 3})


def add_default(x, k=3):
    return x + k


def test_a_graph_as_a_function_is_told_to_be_a_pipeline():
    inner = ep.CompGraph({"f": abs}, {"f": ("x", "y")})
    with pytest.raises(GraphError, match=r"can't be called. Give a function, or the graph as one: ep.Pipeline\('g', "):
        ep.CompGraph({"g": inner}, {"g": ("x", "y")})
