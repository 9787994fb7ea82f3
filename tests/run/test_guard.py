from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.run import execute

RUNS = 6  # enough that the later ones are compiled


def runner_of(function, inputs=("x",), outputs="y", **more):
    return ep.CompGraphRunner(ep.CompGraph({"f": function}, {"f": (inputs, outputs)}), **more)


def results_of_a_reused_buffer(make):
    runner = runner_of(make)
    runs = [runner.run(x=value) for value in range(RUNS)]
    return [run["y"] for run in runs]


def test_a_function_that_uses_its_buffer_again_does_not_change_an_earlier_run():
    buffer = np.zeros(4)

    def fill(x):
        buffer[:] = x
        return buffer

    assert [array.tolist() for array in results_of_a_reused_buffer(fill)] == [[value] * 4 for value in range(RUNS)]


def test_a_view_of_a_buffer_that_is_used_again_does_not_change_an_earlier_run():
    buffer = np.zeros((4, 4))

    def fill(x):
        buffer[:] = x
        return buffer[1:3, ::2]

    for value, array in enumerate(results_of_a_reused_buffer(fill)):
        assert array.tolist() == [[value] * 2] * 2


@pytest.mark.parametrize("outputs", [("y", "z"), "both"])
def test_buffers_in_a_tuple_are_told_from_new_arrays(outputs):
    buffer = np.zeros(2)

    def fill(x):
        buffer[:] = x
        return buffer, np.full(2, x)

    runner = runner_of(fill, outputs=outputs)
    runs = [runner.run(x=value) for value in range(RUNS)]
    for value, run in enumerate(runs):
        arrays = run["both"] if outputs == "both" else (run["y"], run["z"])
        assert [array.tolist() for array in arrays] == [[value] * 2] * 2


def test_opencvs_own_output_buffer_is_such_a_buffer(photograph):
    buffer = np.zeros(photograph.shape[:2], np.uint8)
    gray = lambda image: cv2.cvtColor(image, cv2.COLOR_BGR2GRAY, dst=buffer)  # noqa: E731
    runner = runner_of(gray)
    first = runner.run(x=photograph)
    expected = first["y"].copy()
    for _ in range(RUNS):
        runner.run(x=255 - photograph)
    assert np.array_equal(first["y"], expected)


def test_a_new_array_is_not_copied():
    made = []

    def make(x):
        array = np.full(3, x)
        made.append(array.__array_interface__["data"][0])
        return array

    runner = runner_of(make)
    for value in range(RUNS):
        assert runner.run(x=value)["y"].__array_interface__["data"][0] == made[-1]


def test_a_view_of_a_new_array_is_not_copied():
    made = []

    def make(x):
        array = np.full(6, x)
        made.append(array.__array_interface__["data"][0])
        return array.reshape(2, 3)

    runner = runner_of(make)
    for value in range(RUNS):
        assert runner.run(x=value)["y"].__array_interface__["data"][0] == made[-1]


@pytest.mark.parametrize("count", [3, 100])
@pytest.mark.parametrize("kind", [list, tuple])
def test_long_and_short_lists_of_arrays_are_guarded(kind, count):
    def spoil(points):
        points[-1][0] = 9

    make = lambda: kind(np.zeros(2) for _ in range(count))  # noqa: E731
    cg = ep.CompGraph({"make": make, "spoil": spoil}, {"make": ((), "points"), "spoil": ("points", None)})
    runner = ep.CompGraphRunner(cg)
    for _ in range(RUNS):
        with pytest.raises(ValueError, match="read-only"):
            runner.run()
        assert runner["points"][-1].tolist() == [0, 0]
        with pytest.raises(ValueError, match="read-only"):
            runner["points"][-1][0] = 1


def test_long_tuples_of_other_things_are_passed_on_as_they_are():
    keypoints = tuple(cv2.KeyPoint() for _ in range(500))
    runner = runner_of(lambda points: points)
    for _ in range(RUNS):
        assert runner.run(x=keypoints)["y"] is keypoints


@pytest.mark.parametrize("count", [3, 500])
def test_a_list_that_a_function_changes_is_its_own(count):
    cg = ep.CompGraph(
        {
            "make": lambda x: [*range(count), x],
            "spoil": lambda items, k: (items.reverse(), items.append(k)),
            "read": list,
        },
        {"make": ("x", "l"), "spoil": (("l", "k"), ("a", "b")), "read": ("l", "y")},
    )
    runner = ep.CompGraphRunner(cg, {"k": 0})
    for x in range(RUNS):
        assert runner.run(x=x)["y"] == [*range(count), x]
    for k in range(1, RUNS):
        assert runner.rerun(k=k)["l"] == [*range(count), x]
    given = [1, 2]
    runner.run(x=given)["l"][-1]
    runner["l"].clear()
    assert runner["l"] == [*range(count), given]


@pytest.mark.parametrize("shape", [lambda b: b, lambda b: b.T, lambda b: b[1:], lambda b: b.reshape(-1)])
@pytest.mark.parametrize("wrapped", [lambda b: b, lambda b: (b, b), lambda b: [b, b]])
def test_a_buffer_that_a_function_holds_is_neither_locked_nor_changed_later(shape, wrapped):
    buffer = shape(np.zeros((4, 4)))
    held = wrapped(buffer)

    def fill(x):
        buffer[...] = x
        return held

    several = held is not buffer
    io = ("x", ("a", "b")) if several else ("x", "a")
    for runner in (ep.CompGraphRunner(ep.CompGraph({"f": fill}, {"f": io})), runner_of(fill)):
        token = "a" if "a" in runner.cg.tokens else "y"
        runs = [runner.run(x=x) for x in range(RUNS)]
        for x, run in enumerate(runs):
            kept = run[token][0] if several and token == "y" else run[token]
            assert (np.asarray(kept) == x).all()


@pytest.mark.slow
def test_threads_that_share_an_array_with_an_unguarded_function_get_it_writable():
    failed = []

    @ep.unguarded
    def use(array, k):
        if not array.flags.writeable:
            failed.append(k)
        return k

    cg = ep.CompGraph({"make": lambda x: np.zeros(9), "use": use}, {"make": ("x", "a"), "use": (("a", "k"), "y")})
    runner = ep.CompGraphRunner(cg, {"k": 0})
    runner.run(x=1)
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(3) as pool:
            list(pool.map(lambda k: runner.rerun(k=k), range(3_000)))
    finally:
        sys.setswitchinterval(interval)
    assert not failed


@pytest.mark.parametrize("way", ["the loop", "compiled"])
def test_writing_in_place_fails_at_the_line_however_the_function_is_called(way, monkeypatch):
    monkeypatch.setattr(execute, "RUNS_BEFORE", 0 if way == "compiled" else 10_000)

    def draw(image):
        image[0] = 1

    runner = runner_of(draw, outputs=None)
    with pytest.raises(ValueError, match="read-only") as error:
        runner.run(x=np.zeros(3))
    assert error.traceback[-1].name == "draw"
    assert "Work on a copy" in error.value.__notes__[0]


def test_an_unguarded_function_gets_a_writable_view_without_a_copy():
    seen = []

    @ep.unguarded
    def look(image):
        seen.append((image.flags.writeable, image.__array_interface__["data"][0]))
        return image.sum()

    cg = ep.CompGraph({"make": np.ones, "look": look}, {"make": ("n", "image"), "look": ("image", "sum")})
    runner = ep.CompGraphRunner(cg, {"n": 4})
    for _ in range(RUNS):
        runner.run()
        assert seen[-1] == (True, runner["image"].__array_interface__["data"][0])
        assert not runner["image"].flags.writeable


def test_without_the_guard_arrays_are_what_the_functions_returned():
    array = np.zeros(3)
    runner = runner_of(lambda x: array, guard=False)
    for _ in range(RUNS):
        assert runner.run(x=1)["y"] is array


def test_numpy_that_is_imported_after_the_runs_were_compiled_is_guarded():
    code = """
import epypes as ep
late = []
def make(n):
    if n < 6:
        return n
    import numpy
    late.append(numpy.zeros(2))
    return late[-1]
def spoil(y):
    if not isinstance(y, int):
        y[0] = 1
runner = ep.CompGraphRunner(ep.CompGraph({"make": make, "spoil": spoil}, {"make": ("n", "y"), "spoil": ("y", None)}))
for n in range(6):
    runner.run(n=n)
try:
    runner.run(n=6)
except ValueError as error:
    print(error, late[0])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "assignment destination is read-only [0. 0.]\n"


def test_what_can_be_read_only_once_is_not_explained_as_a_write_to_a_read_only_input():
    cg = ep.CompGraph({"pairs": lambda a, b: zip(a, b, strict=True)}, {"pairs": (("a", "b"), "c")})
    with pytest.raises(ep.errors.IteratorRefused) as error:
        ep.CompGraphRunner(cg).run(a=[1], b=[2])
    assert not any("read-only" in note for note in error.value.__notes__)
