from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import cv2
import numpy as np
import pandas as pd
import pytest

import epypes as ep
from epypes.errors import (
    HyperparameterError,
    NotComputed,
    OutputArityError,
    PayloadError,
    StaleToken,
    UnknownName,
)


class Counting:
    """A function that counts its calls and does what it is told."""

    def __init__(self, compute):
        self.compute, self.calls = compute, 0

    def __call__(self, *args):
        self.calls += 1
        return self.compute(*args)


@pytest.fixture
def chain():
    """double: x -> a; add: (a, n) -> b; square: b -> c."""
    functions = {
        "double": Counting(lambda x: 2 * x),
        "add": Counting(lambda a, n: a + n),
        "square": Counting(lambda b: b * b),
    }
    cg = ep.CompGraph(functions, {"double": ("x", "a"), "add": (("a", "n"), "b"), "square": ("b", "c")})
    return ep.CompGraphRunner(cg, {"n": 1}), functions


def test_the_edge_graph_computes_what_straight_code_computes(edge_runner, photograph, straight_edges):
    run = edge_runner.run(image=photograph)
    assert np.array_equal(run["edges"], straight_edges)
    assert list(run) == list(edge_runner.cg.tokens)


def test_a_runner_reads_like_a_dictionary(chain):
    runner, _ = chain
    runner.run(x=2)
    assert dict(runner) == {"x": 2, "a": 4, "n": 1, "b": 5, "c": 25}
    assert "c" in runner
    assert "nothing" not in runner
    assert len(runner) == 5


def test_none_is_a_value_and_not_computed_is_not():
    cg = ep.CompGraph({"f": lambda x: None, "g": lambda y: y is None}, {"f": ("x", "y"), "g": ("y", "z")})
    runner = ep.CompGraphRunner(cg)
    run = runner.run("y", x=None)
    assert run["y"] is None
    assert run["x"] is None
    with pytest.raises(NotComputed, match=r"Token 'z' has not been computed\. Call rerun\('z'\)"):
        run["z"]
    assert "z" not in run
    assert runner.rerun()["z"] is True


def test_reading_before_any_run_says_what_to_run(edge_runner):
    with pytest.raises(NotComputed, match=r"Call run\(image=\.\.\.\)\."):
        edge_runner["edges"]
    assert "edges" not in edge_runner
    assert edge_runner["canny_lo"] == 70
    with pytest.raises(UnknownName, match="Did you mean 'edges'"):
        edge_runner["edgse"]


def test_missing_payload_is_named_with_the_call_to_make(chain):
    runner, _ = chain
    with pytest.raises(PayloadError, match=r"Missing payload: 'x'\. Call run\(x=\.\.\.\)") as error:
        runner.run()
    assert error.value.tokens == ("x",)
    assert runner.last is None


def test_only_what_the_targets_need_must_be_given():
    cg = ep.CompGraph({"f": lambda x: x, "g": lambda y: y}, {"f": ("x", "a"), "g": ("y", "b")})
    runner = ep.CompGraphRunner(cg)
    assert dict(runner.run("a", x=1)) == {"x": 1, "a": 1}
    with pytest.raises(PayloadError, match="'y'"):
        runner.run("a", "b", x=1)


@pytest.mark.parametrize(
    ("payload", "error", "words"),
    [
        ({"x": 1, "imgae": 2}, UnknownName, "No token 'imgae'"),
        ({"x": 1, "a": 2}, PayloadError, "made by function 'double'"),
        (
            {"x": 1, "n": 2},
            PayloadError,
            r"which run\(\) does not take. Change it with rerun\(n=2\), or with runner\['n'\] = 2",
        ),
        ({"x": 1, "nn": 2}, UnknownName, r"Did you mean the hyperparameter 'n'\? Change it with rerun\(n=2\)"),
    ],
)
def test_payload_that_is_none_is_refused_before_anything_runs(chain, payload, error, words):
    runner, functions = chain
    with pytest.raises(error, match=words):
        runner.run(**payload)
    assert functions["double"].calls == 0


def test_an_image_given_by_position_is_told_from_a_target(edge_runner, photograph):
    for call in (edge_runner.run, edge_runner.rerun, edge_runner.plan):
        with pytest.raises(
            PayloadError, match=r"name of a token, not 'ndarray'\. Payload goes by name: run\(image=\.\.\.\)"
        ):
            call(photograph)


def test_the_wrong_object_is_refused_by_name(edge_graph):
    with pytest.raises(TypeError, match=r"runs a CompGraph, not 'dict': CompGraphRunner\(cg, hparams\)"):
        ep.CompGraphRunner({}, edge_graph)


def test_a_function_asked_for_as_a_token_is_told_what_it_makes(edge_runner, photograph):
    edge_runner.run(image=photograph)
    with pytest.raises(UnknownName, match="No token 'canny' in this graph, only a function; it makes edges"):
        edge_runner.rerun("canny")


def test_of_a_misspelt_payload_the_graphs_input_is_offered_or_a_hyperparameter_to_be_set_otherwise(
    edge_runner, photograph
):
    with pytest.raises(UnknownName, match="Did you mean 'image'"):
        edge_runner.run(img=photograph)
    with pytest.raises(
        UnknownName, match=r"the hyperparameter 'canny_lo'\? Change it with rerun\(canny_lo=3\)"
    ) as error:
        edge_runner.run(image=photograph, cany_lo=3)
    assert error.value.known == ("image",)
    with pytest.raises(UnknownName, match="There are: image.$"):
        edge_runner.run(picture=photograph)


def test_the_note_shows_small_values_and_the_shape_of_arrays(edge_runner, photograph):
    with pytest.raises(cv2.error) as error:
        edge_runner.run(image=None)
    (note,) = error.value.__notes__
    assert note.partition("\n")[0] == "In function 'grayscale': (image=None) -> (image_gray)"
    edge_runner["blur_kernel"] = 4
    with pytest.raises(cv2.error) as error:
        edge_runner.run(image=photograph)
    (note,) = error.value.__notes__
    first = "In function 'blur': (image_gray: uint8 400 x 600, blur_kernel=4) -> (image_blurred)"
    assert note.partition("\n")[0] == first
    message = edge_runner.last.failure.message.removeprefix(f"{edge_runner.last.failure.cause} ")
    assert message.startswith("(-215:Assertion failed) ksize")


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (np.zeros((2, 3)), "x: float64 2 x 3"),
        (np.array(3), "x: int64 without axes"),
        (np.float32(2.5), f"x={np.float32(2.5)!r}"),
        ([1, 2, 3], "x: list of 3 int"),
        ((np.zeros(3), np.zeros(3)), "x: tuple of 2 ndarray"),
        ([1, "a"], "x: list of 2"),
        ([cv2.KeyPoint(1, 2, 3)] * 4, "x: list of 4 KeyPoint"),
        ({"a": 1}, "x: dict of 1"),
        (frozenset(), "x: frozenset of 0"),
        (b"abc", "x: bytes of 3"),
        ("y" * 50, "x: str of 50 characters"),
        ("yes", "x='yes'"),
        (pd.DataFrame({"a": [1]}), "x: DataFrame"),
        (2j, "x=2j"),
        (len, "x: builtin_function_or_method"),
    ],
)
def test_the_note_lists_only_arrays_as_arrays(value, text):
    def fail(x):
        raise ValueError

    with pytest.raises(ValueError) as error:  # noqa: PT011 - its note is asked for
        ep.CompGraphRunner(ep.CompGraph({"fail": fail}, {"fail": ("x", "y")})).run(x=value)
    assert error.value.__notes__ == [f"In function 'fail': ({text}) -> (y)"]


def test_an_unknown_target_is_named(chain):
    runner, _ = chain
    with pytest.raises(UnknownName, match="No token 'd'"):
        runner.run("d", x=1)


def test_hyperparameters_are_checked_when_the_runner_is_made(edge_graph):
    with pytest.raises(UnknownName, match="Did you mean 'canny_lo'"):
        ep.CompGraphRunner(edge_graph, {"cany_lo": 1})
    with pytest.raises(HyperparameterError, match="made by function 'blur'"):
        ep.CompGraphRunner(edge_graph, {"image_blurred": 1})


def test_only_a_hyperparameter_can_be_set(chain):
    runner, _ = chain
    with pytest.raises(HyperparameterError, match=r"Pass it to run\(x=\.\.\.\), or make it one: freeze"):
        runner["x"] = 1
    with pytest.raises(HyperparameterError, match="made by function"):
        runner["a"] = 1
    with pytest.raises(UnknownName):
        runner["k"] = 1


def test_a_change_downstream_leaves_upstream_alone(chain):
    runner, functions = chain
    runner.run(x=2)
    run = runner.rerun(n=3)
    assert run["c"] == 49
    assert [function.calls for function in functions.values()] == [1, 2, 2]
    assert run.report.reused == ("double",)
    assert run.report.ran == ("add", "square")


def test_an_equal_value_makes_nothing_stale(chain):
    runner, functions = chain
    runner.run(x=2)
    runner["n"] = 1
    assert runner.stale == ()
    runner.rerun()
    assert functions["add"].calls == 1
    runner["n"] = 1.0
    assert runner.stale == ("add", "square")


def test_an_unchanged_result_stops_the_rerun_early():
    functions = {"sign": Counting(lambda n: n > 0), "tell": Counting(str)}
    runner = ep.CompGraphRunner(ep.CompGraph(functions, {"sign": ("n", "s"), "tell": ("s", "t")}), {"n": 1})
    runner.run()
    run = runner.rerun(n=2)
    assert run["t"] == "True"
    assert run.report.ran == ("sign",)
    assert functions["tell"].calls == 1


def test_a_stale_token_is_not_read(chain):
    runner, _ = chain
    run = runner.run(x=2)
    runner["n"] = 5
    assert runner.stale == ("add", "square")
    with pytest.raises(StaleToken, match=r"'c' is stale.*Call rerun\(\) first"):
        runner["c"]
    assert runner["a"] == 4
    assert tuple(runner.keys()) == ("x", "a", "n")
    assert run["c"] == 25, "a Run does not change"
    assert runner.rerun()["c"] == 81


def test_a_rerun_of_one_target_leaves_the_others_stale(chain):
    runner, functions = chain
    runner.run(x=2)
    run = runner.rerun("b", n=5)
    assert run["b"] == 9
    with pytest.raises(StaleToken):
        run["c"]
    assert functions["square"].calls == 1
    assert runner.stale == ("square",)


def test_the_same_buffer_refilled_counts_as_new():
    cg = ep.CompGraph({"mean": lambda im: float(im.mean())}, {"mean": ("image", "m")})
    runner, buffer = ep.CompGraphRunner(cg), np.zeros((8, 8))
    assert runner.run(image=buffer)["m"] == 0.0
    buffer[:] = 255
    assert runner.run(image=buffer)["m"] == 255.0


def test_a_rerun_before_any_run_is_refused(chain):
    runner, _ = chain
    with pytest.raises(PayloadError, match=r"Nothing has been run yet.*Call run\(x=\.\.\.\) first"):
        runner.rerun(n=2)


def test_a_rerun_with_one_bad_name_sets_nothing(edge_runner, photograph):
    edge_runner.run(image=photograph)
    with pytest.raises(UnknownName):
        edge_runner.rerun(canny_lo=10, cany_hi=20)
    assert edge_runner["canny_lo"] == 70


def test_freezing_and_unfreezing_moves_a_token_between_payload_and_hyperparameters(chain):
    runner, _ = chain
    runner.freeze(x=10)
    assert runner.free_source_tokens == ()
    assert runner.run()["c"] == 441
    runner.unfreeze("x")
    assert runner.free_source_tokens == ("x",)
    with pytest.raises(HyperparameterError):
        runner.unfreeze("x")


def failing_graph():
    def fail_at_3(b):
        if b == 3:
            raise ZeroDivisionError("three")
        return b

    functions = {"double": lambda x: 2 * x, "check": fail_at_3, "after": lambda c: c, "side": lambda a: -a}
    io = {"double": ("x", "a"), "check": ("n", "c"), "after": ("c", "d"), "side": ("a", "e")}
    return ep.CompGraph(functions, io)


def test_the_users_exception_stays_the_users_with_a_note():
    runner = ep.CompGraphRunner(failing_graph(), {"n": 3})
    with pytest.raises(ZeroDivisionError, match="three") as error:
        runner.run(x=1)
    assert error.value.__notes__ == ["In function 'check': (n=3) -> (c)"]
    assert error.traceback[-1].name == "fail_at_3"
    assert runner.last.failure.function == "check"
    assert runner.last.failure.inputs == {"n": 3}
    assert runner.last.failure.exception is error.value


def test_after_a_failure_what_depends_on_it_is_not_computed_and_the_rest_is_kept():
    runner = ep.CompGraphRunner(failing_graph(), {"n": 1})
    runner.run(x=1)
    with pytest.raises(ZeroDivisionError):
        runner.rerun(n=3)
    for token in ("c", "d"):
        with pytest.raises(NotComputed, match="since check: ZeroDivisionError: three"):
            runner[token]
    assert runner["a"] == 2
    assert runner["e"] == -2
    run = runner.rerun(n=4)
    assert run["d"] == 4
    assert run.report.reused == ("double", "side")


def test_an_interrupt_passes_through_and_leaves_a_failure():
    def interrupted(x):
        raise KeyboardInterrupt

    runner = ep.CompGraphRunner(ep.CompGraph({"f": interrupted}, {"f": ("x", "y")}))
    with pytest.raises(KeyboardInterrupt):
        runner.run(x=1)
    assert runner.last.failure.function == "f"


@pytest.mark.parametrize("value", [(1,), (1, 2, 3), "ab", np.zeros(2), 5, None, {1, 2}])
def test_a_function_with_two_output_tokens_must_return_two_values(value):
    runner = ep.CompGraphRunner(ep.CompGraph({"f": lambda: value}, {"f": ((), ("a", "b"))}))
    with pytest.raises(OutputArityError, match=r"Function 'f' must return a tuple or list of 2 values \(a, b\)"):
        runner.run()


def test_one_token_takes_the_value_as_it_is_and_a_tuple_of_one_takes_a_sequence_of_one():
    def pair():
        return [1, 2]

    assert ep.CompGraphRunner(ep.CompGraph({"f": pair}, {"f": ((), "y")})).run()["y"] == [1, 2]
    assert ep.CompGraphRunner(ep.CompGraph({"f": lambda: [7]}, {"f": ((), ("y",))})).run()["y"] == 7
    with pytest.raises(OutputArityError, match="list of 2"):
        ep.CompGraphRunner(ep.CompGraph({"f": pair}, {"f": ((), ("y",))})).run()


def test_runs_in_many_threads_do_not_mix():
    barrier = threading.Barrier(4)

    def slow(x):
        barrier.wait(60)
        return x

    cg = ep.CompGraph({"f": slow, "g": lambda y: y * 1000}, {"f": ("x", "y"), "g": ("y", "z")})
    runner = ep.CompGraphRunner(cg)
    with ThreadPoolExecutor(4) as pool:
        runs = list(pool.map(lambda x: (x, runner.run(x=x)), range(200)))
    assert all(run["x"] == x and run["y"] == x and run["z"] == 1000 * x for x, run in runs)
    assert len(runner.reports) == 200


def test_arrays_are_read_only_where_a_function_or_a_user_gets_them():
    def draws(image):
        image[0, 0] = 255
        return image

    cg = ep.CompGraph({"copy": lambda x: x.copy(), "draw": draws}, {"copy": ("x", "image"), "draw": ("image", "y")})
    runner = ep.CompGraphRunner(cg)
    with pytest.raises(ValueError, match="read-only") as error:
        runner.run(x=np.zeros((2, 2)))
    assert "'draw'" in error.value.__notes__[0]
    assert "copy" in error.value.__notes__[0]
    assert error.traceback[-1].name == "draws"
    assert runner["image"].sum() == 0
    with pytest.raises(ValueError, match="read-only"):
        runner["image"][0, 0] = 1


def test_arrays_in_a_tuple_are_guarded_too_and_the_callers_own_array_stays_writable():
    runner = ep.CompGraphRunner(ep.CompGraph({"f": lambda p: p[0].__setitem__(0, 1)}, {"f": ("pair", "y")}))
    mine = np.zeros(3)
    with pytest.raises(ValueError, match="read-only"):
        runner.run(pair=(mine, 2))
    mine[0] = 1


def test_unguarded_functions_get_writable_arrays_and_guard_can_be_switched_off():
    flags = []

    @ep.unguarded
    def look(x):
        flags.append(x.flags.writeable)
        return x

    cg = ep.CompGraph({"look": look}, {"look": ("x", "y")})
    ep.CompGraphRunner(cg).run(x=np.zeros(2))
    frozen = np.zeros(2)
    frozen.flags.writeable = False
    ep.CompGraphRunner(cg).run(x=frozen)
    ep.CompGraphRunner(
        ep.CompGraph({"f": lambda x: flags.append(x.flags.writeable)}, {"f": ("x", None)}), guard=False
    ).run(x=np.zeros(2))
    assert flags == [True, True, True]


def test_the_report_adds_up(edge_runner, photograph):
    report = edge_runner.run(image=photograph).report
    assert report.ran == ("grayscale", "blur", "canny")
    assert report.overhead_ns == report.total_ns - sum(report.durations_ns.values())
    assert 0 < report.overhead_ns < report.total_ns
    frame = report.to_frame()
    assert list(frame["function"]) == ["grayscale", "blur", "canny"]
    assert frame["share"].sum() < 1


def test_a_plan_says_what_would_run_and_what_is_missing(chain):
    runner, functions = chain
    plan = runner.plan()
    assert (plan.order, plan.reused, plan.missing) == (("double", "add", "square"), (), ("x",))
    runner.run(x=1)
    runner["n"] = 2
    assert runner.plan("b").order == ("add",)
    assert runner.plan("b").reused == ("double",)
    assert functions["add"].calls == 1


@pytest.mark.slow
def test_a_chain_of_10000_functions_is_planned_run_and_run_again():
    count = 10_000
    io = {f"f{place}": (f"t{place}", f"t{place + 1}") for place in range(count)} | {"side": ("k", "z")}
    runner = ep.CompGraphRunner(ep.CompGraph(dict.fromkeys(io, lambda x: x), io), {"t0": 1, "k": 1})
    runner.run()
    assert runner.rerun(k=2).report.ran == ("side",)
    runner["t0"] = 2
    assert len(runner.stale) == count
    assert runner.plan(f"t{count}").order == runner.stale
    assert runner.rerun()[f"t{count}"] == 2


def test_a_run_does_not_change(chain):
    runner, _ = chain
    run = runner.run(x=1)
    with pytest.raises(AttributeError):
        run.report = None


@pytest.mark.parametrize("state", ["new", "run", "stale", "failed"])
def test_reprs_are_short_and_without_times(state):
    runner = ep.CompGraphRunner(failing_graph(), {"n": 1})
    if state != "new":
        runner.run(x=1)
    if state == "stale":
        runner["n"] = 2
    if state == "failed":
        with pytest.raises(ZeroDivisionError):
            runner.rerun(n=3)
    shown = [runner, runner.cg] + ([runner.last, runner.last.report] if runner.last else [])
    for thing in shown:
        assert len(repr(thing)) < 100
        assert " ms" not in repr(thing)


@pytest.mark.slow
def test_what_is_read_beside_a_rerun_in_another_thread_is_never_an_old_value():
    cg = ep.CompGraph({"a": lambda x, h: (x, h), "b": lambda a: a}, {"a": (("x", "h"), "A"), "b": ("A", "B")})
    runner, done = ep.CompGraphRunner(cg, {"h": 0}), threading.Event()
    runner.run(x=0)

    def rerun_until_done():
        while not done.is_set():
            runner.rerun()

    rerunning = threading.Thread(target=rerun_until_done)
    rerunning.start()
    try:
        for value in range(1, 3000):
            runner["h"] = value
            with contextlib.suppress(StaleToken):
                assert runner["B"][1] == value
            assert {"x", "h"} <= set(runner)
    finally:
        done.set()
        rerunning.join()


def test_a_mutable_object_that_is_passed_through_counts_as_new():
    points = [1, 2]
    cg = ep.CompGraph({"keep": lambda p: p, "total": sum}, {"keep": ("points", "p"), "total": ("p", "s")})
    runner = ep.CompGraphRunner(cg, {"points": points})
    assert runner.run()["s"] == 3
    points.append(10)
    runner["points"] = points
    assert runner.rerun()["s"] == 13


def test_an_array_that_is_passed_through_keeps_what_depends_on_it_fresh():
    later = Counting(lambda image: image.sum())
    cg = ep.CompGraph({"choose": lambda a, k: a, "later": later}, {"choose": (("a", "k"), "b"), "later": ("b", "c")})
    runner = ep.CompGraphRunner(cg, {"k": 0})
    runner.run(a=np.ones(5))
    runner.rerun(k=1)
    assert later.calls == 1


class Unsayable(Exception):
    def __str__(self):
        raise RuntimeError("no text")


class Unnotable(Exception):
    __notes__ = None


class Liar(list):
    def __iter__(self):
        return iter((1, 2, 3))


def raising(error):
    def fail(x):
        if x == 2:
            raise error
        return x, x

    return fail


@pytest.mark.parametrize(
    ("function", "error"),
    [
        (raising(Unsayable()), Unsayable),
        (raising(Unnotable()), Unnotable),
        (lambda x: Liar((x, x)) if x == 2 else (x, x), OutputArityError),
    ],
)
def test_however_a_function_fails_the_failure_is_kept_and_old_values_are_not(function, error):
    runner = ep.CompGraphRunner(ep.CompGraph({"f": function}, {"f": ("x", ("y", "z"))}))
    runner.run(x=1)
    with pytest.raises(error):
        runner.run(x=2)
    assert runner.last.failure.function == "f"
    assert isinstance(str(runner.last.failure), str)
    for token in ("y", "z"):
        with pytest.raises(NotComputed):
            runner[token]


class Pair(NamedTuple):
    image: np.ndarray
    name: str


@pytest.mark.parametrize(
    "spoil",
    [
        lambda pair, masked, plain: pair.image.__setitem__(0, 9),
        lambda pair, masked, plain: masked.__setitem__(0, 9),
        lambda pair, masked, plain: masked.__setitem__(0, np.ma.masked),
        lambda pair, masked, plain: setattr(masked, "mask", [True, True, True]),
        lambda pair, masked, plain: setattr(plain, "strides", (0,)),
    ],
)
def test_whatever_a_function_does_to_its_input_the_next_function_does_not_see_it(spoil):
    seen = []

    def spoiling(*args):
        with contextlib.suppress(Exception), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            spoil(*args)

    def look(pair, masked, plain):
        seen.extend([pair.image.tolist(), masked.filled(-1).tolist(), plain.tolist()])

    inputs = ("pair", "masked", "plain")
    cg = ep.CompGraph({"spoiling": spoiling, "look": look}, {"spoiling": (inputs, None), "look": (inputs, None)})
    masked = np.ma.array([1, 2, 3])
    ep.CompGraphRunner(cg).run(pair=Pair(np.arange(3), "n"), masked=masked, plain=np.arange(3))
    assert seen == [[0, 1, 2], [1, 2, 3], [0, 1, 2]]
    assert masked.filled(-1).tolist() == [1, 2, 3]


def test_a_masked_array_that_a_function_changes_and_returns_is_kept_as_returned():
    def mask_first(x):
        x[0] = np.ma.masked
        return x

    runner = ep.CompGraphRunner(ep.CompGraph({"f": mask_first}, {"f": ("x", "y")}), guard=True)
    with contextlib.suppress(ValueError):
        run = runner.run(x=np.ma.array([0.0, 1.0, 2.0], mask=[False] * 3))
        assert run["y"].mask.tolist() == [True, False, False]
        assert run["x"].mask.tolist() == [False, False, False]


def test_what_a_reader_does_to_an_array_changes_no_later_run():
    cg = ep.CompGraph({"f": lambda x: x + 1, "g": lambda y, k: y.shape}, {"f": ("x", "y"), "g": (("y", "k"), "z")})
    runner = ep.CompGraphRunner(cg, {"k": np.zeros(4)})
    run = runner.run(x=np.zeros(4))
    for array in (run["y"], runner["y"], runner["k"]):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            array.shape = (2, 2)
    assert runner.rerun(k=np.ones(4))["z"] == (4,)
    assert run["y"].shape == (4,)


def test_missing_payload_is_told_with_what_was_given_and_with_what_may_be_meant():
    cg = ep.CompGraph(
        {"smooth": lambda image: image, "threshold": lambda flat, t: flat > t},
        {"smooth": ("image", "flat"), "threshold": (("flatt", "t"), "mask")},
    )
    runner = ep.CompGraphRunner(cg)
    with pytest.raises(PayloadError) as error:
        runner.run(image=3)
    assert str(error.value) == (
        "Missing payload: 'flatt', 't'. Call run(image=..., flatt=..., t=...), or make what is constant a "
        "hyperparameter: CompGraphRunner(cg, {'flatt': ..., 't': ...}). "
        "No function makes 'flatt'; 'smooth' makes 'flat': is that what was meant?"
    )
    assert error.value.tokens == ("flatt", "t")


def test_a_selector_that_is_missing_is_told_with_its_branches():
    cg = ep.CompGraph({"f": abs, "g": abs}, {"f": ("x", "a"), "g": ("x", "b")})
    cg |= ep.switch("s", {"first": "a", "second": "b"}, by="which", output="y")
    with pytest.raises(PayloadError, match="'which' selects a branch of switch 's': 'first', 'second'"):
        ep.CompGraphRunner(cg).run(x=1)


@pytest.mark.parametrize("hparams", [[("x", 1)], np.ones(2), "x", 3])
def test_hyperparameters_that_are_no_mapping_are_refused(hparams):
    with pytest.raises(TypeError, match="hparams must be a mapping of tokens to values"):
        ep.CompGraphRunner(ep.CompGraph({"f": abs}, {"f": ("x", "y")}), hparams)


@pytest.mark.slow
def test_an_interrupt_never_leaves_a_runner_locked():
    code = """
import contextlib, signal
import epypes as ep
def stop(*_):
    raise KeyboardInterrupt
signal.signal(signal.SIGVTALRM, stop)
runner = ep.CompGraphRunner(ep.CompGraph({"f": abs}, {"f": ("k", "y")}), {"k": 0})
runner.run()
for _ in range(150):
    with contextlib.suppress(KeyboardInterrupt):
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0003)
        for k in range(20_000):
            runner.rerun(k=k)
    assert not runner._lock.locked()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr


def test_an_exception_that_is_raised_again_and_again_has_one_note_of_each_function():
    error = ValueError("always the same")
    inner = ep.Pipeline("inner", ep.CompGraph({"f": raising(error)}, {"f": ("x", ("y", "z"))}))

    def outer(n):
        error.__traceback__ = None
        inner.run(x=2)

    runner = ep.CompGraphRunner(ep.CompGraph({"g": outer}, {"g": ("n", "m")}))
    for n in range(50):
        with pytest.raises(ValueError, match="always"):
            runner.run(n=n)
    assert error.__notes__ == ["In function 'f': (x=2) -> (y, z)", "In function 'g': (n=49) -> (m)"]
