"""Values that functions can change, and that are neither arrays nor immutable: each function gets its own."""

from __future__ import annotations

import bisect
import collections
import contextlib
import csv
import heapq
import io
import mmap
import operator
import sys
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pandas as pd
import pytest

import epypes as ep
from epypes.errors import EpypesError, IteratorRefused


def graph_of(**functions):
    """Return a graph of functions by name, each given as (function, inputs, outputs)."""
    return ep.CompGraph(
        {name: function for name, (function, _, _) in functions.items()},
        {name: io for name, (_, *io) in functions.items()},
    )


# -- builtins that change their input ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "make", "read", "expected"),
    [
        (heapq.heappop, lambda n: [n, n + 1, n + 2], sum, 12),
        (lambda: 0, lambda n: [n], list, [3]),
        (bisect.insort, lambda n: [0, 9], list, [0, 9]),
        (operator.setitem, lambda n: {0: 1, 1: n}, dict, {0: 1, 1: 3}),
        (operator.iconcat, lambda n: [n], list, [3]),
        (operator.iadd, lambda n: collections.deque([n]), list, [3]),
        (operator.ior, lambda n: {n}, set, {3}),
        (operator.delitem, lambda n: bytearray([1, n]), bytes, b"\1\3"),
        (operator.setitem, lambda n: np.rec.array([(n, n)] * 2), lambda a: a.tolist(), [(3, 3)] * 2),
    ],
)
def test_a_builtin_that_changes_its_input_changes_it_for_no_other_function(way, change, make, read, expected):
    more = {bisect.insort: (5,), operator.setitem: (1, 7), operator.iconcat: ([4],), operator.iadd: ([4],),
            operator.ior: ({4},), operator.delitem: (0,)}.get(change, ())  # fmt: skip
    names = tuple(f"more{place}" for place in range(len(more)))
    inputs = () if change.__name__ == "<lambda>" else ("xs", *names)
    cg = graph_of(make=(make, "n", "xs"), change=(change, inputs, "changed"), read=(read, "xs", "found"))
    runner = way.runner(cg, dict(zip(names, more, strict=True)))
    for _ in range(way.runs):
        with contextlib.suppress(ValueError):  # of an array, which is read-only
            assert runner.run(n=3)["found"] == expected
        assert read(runner["xs"]) == expected


@pytest.mark.filterwarnings("ignore:Setting the")
@pytest.mark.parametrize("name", ["shape", "dtype"])
def test_setattr_on_an_array_changes_it_for_no_other_function(way, name):
    value = {"shape": (2, 3), "dtype": np.dtype("int32")}[name]
    cg = graph_of(
        make=(np.arange, "n", "a"),
        change=(setattr, ("a", "name", "value"), "none"),
        read=(lambda a: (a.shape, a.strides, a.dtype), "a", "seen"),
    )
    runner = way.runner(cg, {"name": name, "value": value})
    for _ in range(way.runs):
        assert runner.run(n=6)["seen"] == ((6,), (8,), np.dtype("int64"))


def test_a_function_of_opencv_gets_the_array_itself_and_anything_else_as_a_copy(way):
    cg = graph_of(
        make=(lambda n: np.full((4, 4), n, np.uint8), "n", "a"),
        points=(lambda n: [np.float32([0, n]), np.float32([n, 0]), np.float32([n, n])], "n", "corners"),
        blur=(cv2.blur, ("a", "size"), "b"),
        add=(np.add, ("a", "b"), "c"),
        area=(lambda corners: cv2.contourArea(np.float32(corners)), "corners", "area"),
    )
    runner = way.runner(cg, {"size": (3, 3)})
    for n in range(1, way.runs):
        run = runner.run(n=n)
        assert (run["c"] == 2 * n).all()
        assert run["area"] == n * n / 2


# -- containers ----------------------------------------------------------------------------------------------------


CONTAINERS = {
    "list": (lambda: [1], lambda x, k: x.append(k)),
    "dict": (lambda: {0: 1}, lambda x, k: x.update({k: k})),
    "ordered dict": (lambda: collections.OrderedDict({0: 1}), lambda x, k: x.update({k: k})),
    "default dict": (lambda: collections.defaultdict(list), lambda x, k: x[k]),
    "counter": (lambda: collections.Counter([1]), lambda x, k: x.update([k])),
    "set": (lambda: {0}, lambda x, k: x.add(k)),
    "deque": (lambda: collections.deque([1], maxlen=9), lambda x, k: x.append(k)),
    "bytearray": (lambda: bytearray(1), lambda x, k: x.append(k)),
    "list of its own class": (lambda: Pixels([1]), lambda x, k: x.append(k)),
    "frame": (lambda: pd.DataFrame({"a": range(9)}), lambda x, k: x.drop(index=range(k), inplace=True)),
    "frame, written": (lambda: pd.DataFrame({"a": range(9)}), lambda x, k: operator.setitem(x.iloc, (0, 0), k)),
    "frame, column": (lambda: pd.DataFrame({"a": range(9)}), lambda x, k: operator.setitem(x, str(k), k)),
    "series": (lambda: pd.Series(range(9)), lambda x, k: operator.setitem(x.iloc, 0, k)),
}


class Pixels(list):
    pass


def described(value):
    return value.to_csv() if isinstance(value, pd.DataFrame | pd.Series) else repr(value)


@pytest.mark.filterwarnings("ignore:The inplace keyword")
@pytest.mark.parametrize("container", CONTAINERS)
def test_what_a_function_does_to_a_container_stays_with_it(way, container):
    make, spoil = CONTAINERS[container]
    tokens = ("made", "given", "frozen")

    def change(k, *values):
        for value in values:
            spoil(value, k)
        return [described(value) for value in values]

    def changed_by(k):
        value = make()
        spoil(value, k)
        return [described(value)] * 3

    cg = graph_of(
        make=(lambda n: make(), "n", "made"),
        change=(change, ("k", *tokens), "changed"),
        read=(lambda *values: list(map(described, values)), tokens, "seen"),
    )
    payload = {"n": 0, "given": make()}
    runner = way.runner(cg, {"k": 1, "frozen": make()})
    for k in range(1, way.runs):
        runner["k"] = k
        run = runner.run(**payload)
        assert (run["changed"], run["seen"]) == (changed_by(k), [described(make())] * 3)
        for token in tokens:  # a reader spoils nothing either
            spoil(run[token], k)
    for k in range(way.runs, 1, -1):
        run = runner.rerun(k=k)
        assert run["changed"] == changed_by(k)
        assert [described(run[token]) for token in tokens] == run["seen"] == [described(make())] * 3
    assert described(payload["given"]) == described(make())


def test_a_container_keeps_its_class_and_what_belongs_to_it(way):
    made = {
        "a": collections.OrderedDict(b=1),
        "d": collections.defaultdict(int, {1: 2}),
        "q": collections.deque([1], maxlen=2),
        "l": Pixels([1]),
    }
    made["l"].unit = "px"
    runner = way.runner(ep.CompGraph({"f": lambda *x: x}, {"f": (tuple(made), tuple(f"{name}2" for name in made))}))
    for _ in range(way.runs):
        run = runner.run(**made)
    for name, value in made.items():
        assert type(run[f"{name}2"]) is type(value)
        assert run[f"{name}2"] == value
    assert (run["d2"][9], run["q2"].maxlen, run["l2"].unit) == (0, 2, "px")


@pytest.mark.parametrize(("container", "count"), [(dict, 2), (collections.OrderedDict, 100)])
def test_arrays_in_a_dict_are_guarded_as_those_in_a_list(way, container, count):
    addresses = []

    def make(n):
        made = container((place, np.full(3, n)) for place in range(count))
        addresses[:] = [array.__array_interface__["data"][0] for array in made.values()]
        return made

    def spoil(x):
        x[count - 1][0] = 9

    runner = way.runner(graph_of(make=(make, "n", "x"), spoil=(spoil, "x", None)))
    for n in range(way.runs):
        with pytest.raises(ValueError, match="read-only"):
            runner.run(n=n)
        assert [array.__array_interface__["data"][0] for array in runner["x"].values()] == addresses, (
            "nothing is copied"
        )
        assert runner["x"][count - 1].tolist() == [n] * 3


# -- memory that a function uses again ---------------------------------------------------------------------------------


def masked(values):
    return np.ma.masked_array(np.float64(values), mask=[False] * 3)


def of_bytearray():
    array = np.frombuffer(bytearray(24))
    return array, array


def broadcast():
    array = np.zeros(3)
    return array, np.broadcast_to(array, (4, 3))


def locked_view():
    array = np.zeros(3)
    view = array.view()
    view.flags.writeable = False
    return array, view


def mapped_file():
    array = np.frombuffer(mmap.mmap(-1, 24))
    return array, array


def twice(value):
    return value, value


BUFFERS = {
    "recarray": lambda: twice(np.zeros(3).view(np.recarray)),
    "matrix": lambda: twice(np.matrix([0.0, 0.0, 0.0])),
    "masked": lambda: twice(masked([0, 0, 0])),
    "bytearray": of_bytearray,
    "broadcast": broadcast,
    "locked view": locked_view,
    "mapped file": mapped_file,
    "view of a matrix": lambda: (lambda a: (a, np.asarray(a)))(np.matrix([0.0, 0.0, 0.0])),
    "data frame": lambda: (lambda f: (f.iloc, f))(pd.DataFrame({"a": [0.0, 0.0, 0.0]})),
    "series": lambda: (lambda f: (f.iloc, f))(pd.Series([0.0, 0.0, 0.0])),
    "dict": lambda: (lambda a: (a, {"a": a}))(np.zeros(3)),
    "deque": lambda: (lambda a: (a, collections.deque([a])))(np.zeros(3)),
    "tuple of recarrays": lambda: (lambda a: (a, (a, a)))(np.zeros(3).view(np.recarray)),
}


def numbers(value):
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, collections.deque):
        value = list(value)
    return set(np.asarray(value).ravel().tolist())


@pytest.mark.filterwarnings("ignore:the matrix subclass")
@pytest.mark.parametrize("kind", BUFFERS)
def test_a_buffer_of_any_class_that_a_function_uses_again_changes_no_earlier_run(way, kind):
    buffer, value = BUFFERS[kind]()

    def fill(x):
        buffer[:] = x
        return value

    cg = graph_of(
        f=(fill, "x", "a"),
        g=(lambda a, x: (fill(x), x), ("a", "x"), ("b", "c")),
        read=(lambda a, b: numbers(a) | numbers(b), ("a", "b"), "seen"),
    )
    runner = way.runner(cg)
    runs = [runner.run(x=float(x)) for x in range(way.runs)]
    for x, run in enumerate(runs):
        assert numbers(run["a"]) == numbers(run["b"]) == run["seen"] == {x}


def test_a_memory_mapped_file_that_a_function_writes_again_changes_no_earlier_run(way, tmp_path):
    mapped = np.memmap(tmp_path / "x", np.float64, "w+", shape=(3,))

    def fill(x):
        mapped[:] = x
        return mapped

    runner = way.runner(graph_of(f=(fill, "x", "a")))
    runs = [runner.run(x=float(x)) for x in range(way.runs)]
    assert [numbers(run["a"]) for run in runs] == [{x} for x in range(way.runs)]


def test_what_map_keeps_is_of_its_own_image():
    frame = pd.DataFrame({"a": [0, 0]})

    def fill(x):
        frame["a"] = x
        return frame

    rows = ep.map(ep.CompGraphRunner(graph_of(f=(fill, "x", "a"))), [1, 2, 3], keep=["a"])
    assert [row.kept["a"]["a"].tolist() for row in rows] == [[1, 1], [2, 2], [3, 3]]


def test_a_part_of_a_payload_and_a_file_mapped_read_only_are_not_copied(way, tmp_path):
    (tmp_path / "x").write_bytes(bytes(24))
    mapped = np.memmap(tmp_path / "x", np.uint8, "r", shape=(24,))
    cg = graph_of(
        crop=(lambda image: image[1:], "image", "part"),
        crop_first=(lambda images: images[0][1:], "images", "first"),
        load=(lambda n: mapped, "n", "file"),
    )
    runner, images = way.runner(cg), [np.zeros((8, 8)), np.zeros((8, 8))]
    for _ in range(way.runs):
        run = runner.run(image=images[0], images=images, n=1)
        assert np.shares_memory(run["part"], images[0])
        assert np.shares_memory(run["first"], images[0])
        assert np.shares_memory(run["file"], mapped)


def test_a_broadcast_array_takes_no_more_memory_for_being_kept():
    huge = np.broadcast_to(np.zeros(3), (1_000_000, 1_000_000, 3))
    runner = ep.CompGraphRunner(graph_of(f=(lambda k: huge, "k", "a")), {"k": huge})
    assert runner.run()["a"].shape == huge.shape


# -- iterators -----------------------------------------------------------------------------------------------------


ITERATORS = {
    "zip": lambda: zip([1], [2], strict=True),
    "generator": lambda: (x for x in [1]),
    "map": lambda: map(abs, [1]),
    "list iterator": lambda: iter([1]),
    "flat": lambda: np.zeros(3).flat,
    "nditer": lambda: np.nditer(np.zeros(3)),
    "file": lambda: io.StringIO("1"),
    "csv": lambda: csv.reader(["1"]),
}


def test_an_iterator_that_a_function_returns_is_refused_with_the_function_and_the_token(way):
    cg = graph_of(pairs=(lambda kind, k: ITERATORS[kind](), ("kind", "k"), "p"), use=(list, "p", "y"))
    runner = way.runner(cg, {"k": 10})
    for kind in ITERATORS:
        with pytest.raises(IteratorRefused, match="Make it a list") as error:
            runner.run(kind=kind)
        assert (error.value.token, error.value.function) == ("p", "pairs")
        assert "'p'" in str(error.value)
        assert "'pairs'" in str(error.value)
        assert runner.last.failure.function == "pairs"
        with pytest.raises(IteratorRefused):
            runner.rerun(k=20)


def test_the_one_of_several_outputs_that_is_an_iterator_is_named(way):
    cg = graph_of(f=(lambda x: (x, iter([x])), "x", ("a", "b")), use=(list, "b", "y"))
    runner = way.runner(cg)
    for x in range(way.runs):
        with pytest.raises(IteratorRefused) as error:
            runner.run(x=x)
        assert (error.value.token, error.value.function) == ("b", "f")


@pytest.mark.parametrize("kind", ITERATORS)
def test_an_iterator_is_no_payload_and_no_hyperparameter(way, kind):
    cg = graph_of(f=(lambda x, k: x, ("x", "k"), "y"))
    runner = way.runner(cg, {"k": 1})
    for x in range(way.runs):
        runner.run(x=x)
    last = runner.last
    for run in (
        lambda value: runner.run(x=value),
        lambda value: runner.run("y", x=value),
        lambda value: runner.trial({}, payload={"x": value}),
        lambda value: runner.rerun(k=value),
        lambda value: runner.set(k=value),
        lambda value: runner.freeze(x=value),
        lambda value: ep.CompGraphRunner(cg, {"k": value}),
    ):
        with pytest.raises(IteratorRefused, match="Make it a list") as error:
            run(ITERATORS[kind]())
        assert error.value.token in ("x", "k")
        assert error.value.function is None
        assert isinstance(error.value, EpypesError)
    assert runner.last is last
    assert runner["k"] == 1


def test_what_can_be_read_again_is_no_iterator(way):
    class Images:
        def __iter__(self):
            return iter([1, 2])

    cg = graph_of(f=(lambda *x: [sum(1 for _ in each) for each in x], ("a", "b", "c", "d"), "y"))
    runner = way.runner(cg)
    for _ in range(way.runs):
        run = runner.run(a=range(2), b={1: 2}.keys(), c=Images(), d="ab")
        assert run["y"] == [2, 1, 2, 2]
        camera = cv2.VideoCapture()
        assert way.runner(graph_of(f=(lambda x: x, "x", "y"))).run(x=camera)["y"] is camera


def test_without_the_guard_values_are_passed_as_they_are(way):
    seen = []

    def use(p, q):
        seen.append(q)
        return [1 // each for each in p]

    cg = graph_of(make=(lambda x: iter([x]), "x", "p"), use=(use, ("p", "q"), "y"))
    runner, given = way.runner(cg, guard=False), {1: 2}
    for x in range(1, way.runs):
        assert runner.run(x=x, q=given)["y"] == [1 // x]
        assert seen[-1] is given
    with pytest.raises(ZeroDivisionError):
        runner.run(x=0, q=given)
    with pytest.raises(IteratorRefused):
        way.runner(cg).run(x=1, q=given)


# -- hyperparameters ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["made", "set", "rerun", "frozen", "read-only view", "in a list", "in a dict"])
def test_a_hyperparameter_array_that_is_changed_in_place_changes_nothing(how):
    array = np.zeros(3)
    given = {"in a list": [array], "in a dict": {"a": array}, "read-only view": array[:]}.get(how, array)
    if how == "read-only view":
        given.flags.writeable = False
    runner = ep.CompGraphRunner(
        graph_of(f=(lambda x, k: x + sum(numbers(k)), ("x", "k"), "y")), {"k": given if how == "made" else np.ones(3)}
    )
    runner.run(x=1)
    if how == "rerun":
        runner.rerun(k=given)
    elif how == "frozen":
        runner.unfreeze("k")
        runner.freeze(k=given)
    elif how != "made":
        runner.set(k=given)
    runner.run(x=1)
    array[:] = 5
    assert numbers(runner["k"]) == {0}
    assert numbers(runner.hyperparameters["k"]) == {0}
    assert runner.rerun()["y"] == runner.run(x=1)["y"] == 1


@pytest.mark.slow
def test_values_are_never_seen_half_written_by_a_run_in_another_thread():
    names = tuple(f"h{place}" for place in range(2_000))
    cg = graph_of(f=(lambda x, first, *values: len(set(values)), ("x", *names), "y"))
    runner = ep.CompGraphRunner(cg, dict.fromkeys(names, 0))
    interval, is_over = sys.getswitchinterval(), []
    sys.setswitchinterval(1e-5)

    def run(_):
        found = set()
        while not is_over:
            found.add(runner.run(x=1)["y"])
        return found

    try:
        with ThreadPoolExecutor(4) as pool:
            found = [pool.submit(run, place) for place in range(4)]
            try:
                for count in range(300):
                    runner.set(h0=count)
                    runner.run(x=1)
            finally:
                is_over.append(True)
            assert [each.result() for each in found] == [{1}] * 4
    finally:
        sys.setswitchinterval(interval)


# -- a run that is compiled for the types of values that the runs before had ----------------------------------------

KEPT_ARRAY, KEPT_LIST = np.zeros(80), [0] * 40
OF_EVERY_TYPE = {
    "array": lambda: np.zeros(40),
    "view of a new array": lambda: np.zeros((5, 8)).reshape(40),
    "view of a kept array": lambda: KEPT_ARRAY[:40],
    "list": lambda: [0] * 40,
    "list of arrays": lambda: [np.zeros(40) for _ in range(40)],
    "kept list": lambda: KEPT_LIST,
    "tuple": lambda: (0,) * 40,
    "tuple of arrays": lambda: tuple(np.zeros(40) for _ in range(40)),
    "number": lambda: 0,
}


def first_array(value):
    return value if isinstance(value, np.ndarray) else value[0] if isinstance(value, list | tuple) else None


def spoil(value):
    """Write into a value, and into the first array in it."""
    with contextlib.suppress(ValueError, TypeError):
        value[0] = 7
    with contextlib.suppress(ValueError, TypeError):
        first_array(value)[0] = 7
    return True


def content(value):
    parts = value if isinstance(value, list | tuple) else [value]
    return type(value), [np.asarray(part).tolist() for part in parts]


@pytest.mark.parametrize("before", OF_EVERY_TYPE)
@pytest.mark.parametrize("outputs", ["made", ("made", "also")])
def test_values_of_other_types_than_in_the_runs_before_are_guarded_as_well(way, before, outputs):
    def make(kind):
        made = OF_EVERY_TYPE[kind]()
        return made if outputs == "made" else (made, OF_EVERY_TYPE[kind]())

    runner = way.runner(
        graph_of(
            make=(make, "kind", outputs),
            spoil=(spoil, "given", "one"),
            spoil_made=(lambda made, k: spoil(made), ("made", "k"), "two"),
            see=(lambda given, made, k: (content(given), content(made)), ("given", "made", "k"), "seen"),
        ),
        {"k": 0},
    )
    runs = []
    for kind in [before] * way.runs + [*OF_EVERY_TYPE]:
        given = OF_EVERY_TYPE[kind]()
        run = runner.run(kind=kind, given=given)
        expected = content(OF_EVERY_TYPE[kind]())
        assert run["seen"][1] == expected
        assert runner.rerun(k=len(runs) + 1)["seen"][1] == expected
        runs.append((run, expected))
    for run, expected in runs:
        assert content(run["made"]) == expected
