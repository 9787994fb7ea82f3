"""Construction is linear and reads what functions take without asking inspect."""

from __future__ import annotations

import functools
import gc
import time

import pytest

import epypes as ep
from epypes.errors import GraphError
from epypes.graph.bipartite import BipartiteDigraph


def chain(count):
    functions = {f"f{index}": lambda x: x for index in range(count)}
    return functions, {f"f{index}": (f"t{index}", f"t{index + 1}") for index in range(count)}


@pytest.mark.slow
def test_ten_times_the_functions_cost_about_ten_times_as_much():
    def cost(count):
        given, best = chain(count), float("inf")
        gc.collect()
        for _ in range(7):
            start = time.thread_time()  # what other processes take does not count
            ep.CompGraph(*given)
            best = min(best, time.thread_time() - start)
        return best / count

    # Where it is quadratic, ten times as much per function.
    assert cost(10_000) < 4 * cost(1_000)


def test_a_graph_without_cycle_is_not_searched_for_one(monkeypatch):
    monkeypatch.setattr(BipartiteDigraph, "shortest_cycle", lambda self: pytest.fail("searched"))
    ep.CompGraph({"g": abs, "f": abs}, {"g": ("y", "z"), "f": ("x", "y")})


def test_a_wide_and_shuffled_graph_keeps_the_order_of_kahn():
    functions = dict.fromkeys(["join", "c", "a", "b"], lambda *xs: xs)
    io = {"join": (("a", "b", "c"), "out"), "c": ("x", "c"), "a": ("x", "a"), "b": ("a", "b")}
    assert list(ep.CompGraph(functions, io).functions) == ["c", "a", "b", "join"]


def plain(a, b, c=3, *rest, d, e=5, **more):
    return a


@functools.wraps(plain)
def wrapped():
    return None


class Callable:
    def method(self, a, b=2):
        return a

    def __call__(self, a, /, *, k):
        return a


@pytest.mark.parametrize("function", [plain, wrapped, ep.Node("n", plain)])
def test_plain_and_wrapped_functions_are_checked_alike(function):
    with pytest.raises(GraphError, match=r"Function 'f' takes 2 to inf inputs .*, but its io names 1: \(a\)"):
        ep.CompGraph({"f": function}, {"f": ("a", "y")})
    with pytest.raises(GraphError, match="Function 'f' needs 'd' by keyword"):
        ep.CompGraph({"f": function}, {"f": (("a", "b", "c", "g"), "y")})


def test_methods_callables_and_c_functions_are_asked_for_their_signature():
    with pytest.raises(GraphError, match="takes 1 to 2 inputs"):
        ep.CompGraph({"f": Callable().method}, {"f": (("a", "b", "c"), "y")})
    with pytest.raises(GraphError, match="needs 'k' by keyword"):
        ep.CompGraph({"f": Callable()}, {"f": ("a", "y")})
    ep.CompGraph({"f": iter}, {"f": (("a", "b", "c", "d"), "y")})


def test_a_signature_is_read_once_per_function_object():
    class Counting:
        asked = 0

        def __call__(self, x):
            return x

        def __getattribute__(self, name):
            if name == "__signature__":
                type(self).asked += 1
            return object.__getattribute__(self, name)

    function = Counting()
    ep.CompGraph(
        {f"f{index}": function for index in range(50)}, {f"f{index}": ("x", f"y{index}") for index in range(50)}
    )
    assert Counting.asked <= 3
