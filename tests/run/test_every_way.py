"""What is promised of a run holds step by step, compiled and side by side."""

from __future__ import annotations

import contextvars
import gc
import logging
import weakref

import numpy as np
import pytest

import epypes as ep
from epypes.errors import NotComputed, OutputArityError, StaleToken


def one(function, inputs="x", outputs="y"):
    return ep.CompGraph({"f": function}, {"f": (inputs, outputs)})


@pytest.mark.parametrize("bad", [(1, 2, 3), [1], "ab", np.zeros(2), None, {1, 2}], ids=repr)
def test_another_number_of_values_than_output_tokens_is_refused_and_nothing_is_split(way, bad):
    runner = way.runner(one(lambda x: bad if x == "bad" else [x, x], outputs=("a", "b")))
    for x in range(way.runs):
        assert runner.run(x=x)["b"] == x
    got = f"(tuple|list) of {len(bad)}" if isinstance(bad, tuple | list) else f"one {type(bad).__name__}"
    words = rf"'f' must return a tuple or list of 2 values \(a, b\), but it returned {got}\."
    with way.is_taken(), pytest.raises(OutputArityError, match=words) as error:
        runner.run(x="bad")
    assert (error.value.function, error.value.outputs) == ("f", ("a", "b"))
    assert set(runner.last) == {"x"}


def raising_graph():
    def check(a, n):
        if n == 3:
            raise ZeroDivisionError("three")
        return a + n

    return ep.CompGraph(
        {"double": lambda x: 2 * x, "check": check, "after": lambda b: b, "side": lambda a: -a},
        {"double": ("x", "a"), "check": (("a", "n"), "b"), "after": ("b", "c"), "side": ("a", "d")},
    )


def test_the_users_exception_keeps_its_type_and_line_and_names_function_and_tokens(way):
    runner = way.runner(raising_graph(), {"n": 1})
    for x in range(way.runs):
        runner.run(x=x)
    runner["n"] = 3
    with way.is_taken(), pytest.raises(ZeroDivisionError) as error:
        runner.run(x=1)
    assert (type(error.value), str(error.value)) == (ZeroDivisionError, "three")
    assert error.traceback[-1].name == "check"
    assert error.value.__notes__ == ["In function 'check': (a=2, n=3) -> (b)"]
    assert error.value.__cause__ is None
    failure = runner.last.failure
    assert (failure.function, failure.tokens, dict(failure.inputs)) == ("check", ("a", "n", "b"), {"a": 2, "n": 3})


def test_after_a_failing_run_nothing_of_the_run_before_is_read_as_its_result(way):
    runner = way.runner(raising_graph(), {"n": 1})
    runs = [runner.run(x=x) for x in range(way.runs)]
    runner["n"] = 3
    with way.is_taken(), pytest.raises(ZeroDivisionError):
        runner.run(x=50)
    assert (runner["x"], runner["a"]) == (50, 100)
    for token in ("b", "c"):
        with pytest.raises(NotComputed, match="since check: ZeroDivisionError: three"):
            runner[token]
        assert token not in runner
    assert "d" not in runner.last or runner.last["d"] == -100
    assert [run["c"] for run in runs] == [2 * x + 1 for x in range(way.runs)], "a Run does not change"


def test_after_a_failing_rerun_what_does_not_depend_on_it_is_kept(way):
    runner = way.runner(raising_graph(), {"n": 1})
    runner.run(x=5)
    for n in range(10, 10 + way.runs):
        runner.rerun(n=n)
    with way.is_taken(), pytest.raises(ZeroDivisionError):
        runner.rerun(n=3)
    assert (runner["a"], runner["d"], runner["n"]) == (10, -10, 3)
    for token in ("b", "c"):
        with pytest.raises(NotComputed, match="since check"):
            runner[token]
    run = runner.rerun(n=4)
    assert (run["c"], run.report.ran) == (14, ("check", "after"))


def test_what_ran_before_a_function_failed_is_not_run_again(way):
    def check(a, m):
        if m == 3:
            raise ZeroDivisionError("three")
        return a + m

    cg = ep.CompGraph({"first": lambda k: 2 * k, "check": check}, {"first": ("k", "a"), "check": (("a", "m"), "b")})
    runner = way.runner(cg, {"k": 1, "m": 1})
    runner.run()
    for value in range(10, 10 + way.runs):
        runner.rerun(k=value, m=value)
    with way.is_taken(), pytest.raises(ZeroDivisionError):
        runner.rerun(k=50, m=3)
    assert runner.last.report.ran == ("first", "check")
    assert runner.stale == ("check",)
    run = runner.rerun(m=4)
    assert (run["b"], run.report.ran) == (104, ("check",))


def test_an_earlier_run_keeps_its_values_whatever_is_run_after_it(way):
    runner, kept = way.runner(raising_graph(), {"n": 1}), []

    def keep(run):
        kept.append((run, dict(run), dict(run.hyperparameters), run.report.durations_ns, run.report.total_ns))

    for n in range(10, 10 + way.runs):
        keep(runner.run(x=n))
        keep(runner.rerun(n=n))
        keep(runner.rerun(n=-n))
        keep(runner.run("b", x=0))
        keep(runner.rerun("c", n=0))
        with pytest.raises(ZeroDivisionError):
            runner.rerun(n=3)
        keep(runner.last)
        runner["n"] = n
        keep(runner.rerun())
    for run, values, hyperparameters, durations_ns, total_ns in kept:
        assert (dict(run), dict(run.hyperparameters)) == (values, hyperparameters)
        assert (run.report.durations_ns, run.report.total_ns) == (durations_ns, total_ns)
        assert run["a"] == 2 * run["x"]
        assert "c" not in run or run["c"] == run["a"] + run["n"]


def test_a_refilled_buffer_counts_as_new(way):
    runner, buffer = way.runner(one(lambda image: float(image.mean()), "image", "mean")), np.zeros((8, 8))
    for value in range(way.runs):
        buffer[:] = value
        assert runner.run(image=buffer)["mean"] == value
    buffer[:] = 255
    with way.is_taken():
        assert runner.run(image=buffer)["mean"] == 255


def test_a_refilled_buffer_as_hyperparameter_counts_as_new_when_it_is_set_again(way):
    mask = np.zeros((8, 8))
    runner = way.runner(one(lambda x, mask: float(mask.mean()), ("x", "mask"), "mean"), {"mask": mask})
    runner.run(x=1)
    for value in range(1, 1 + way.runs):
        mask[:] = value
        assert runner.rerun(mask=mask)["mean"] == value


@pytest.mark.parametrize("drawn_on", ["image", "frame"])
def test_drawing_into_an_input_raises_at_that_line_and_spoils_nothing(way, drawn_on):
    def draw(image, frame, k):
        if k == 3:
            (image if drawn_on == "image" else frame)[0] = 255
        return image + k

    cg = ep.CompGraph(
        {"make": lambda frame: frame + 1, "draw": draw, "look": lambda image, frame: int(image.sum() + frame.sum())},
        {"make": ("frame", "image"), "draw": (("image", "frame", "k"), "drawn"), "look": (("image", "frame"), "sum")},
    )
    runner = way.runner(cg, {"k": 0})
    frames = [np.full(4, value) for value in range(way.runs)]
    for frame in frames:
        runner.run(frame=frame)
    runner["k"] = 3
    with way.is_taken(), pytest.raises(ValueError, match="read-only") as error:
        runner.run(frame=frames[-1])
    assert error.traceback[-1].name == "draw"
    (note,) = error.value.__notes__
    assert note.startswith("In function 'draw': (image: int64 4, frame: int64 4, k=3) -> (drawn)")
    assert "'draw' can't change 'image', 'frame', 'k'" in note
    assert "Work on a copy" in note
    assert frames[-1].tolist() == [way.runs - 1] * 4
    assert runner["image"].tolist() == [way.runs] * 4
    assert runner.rerun(k=1)["sum"] == 4 * (2 * way.runs - 1)
    frames[-1][0] = 1  # what the caller keeps writable stays so


# A terabyte of one byte: whoever copies, compares or hashes its values fails for want of memory.
HUGE = np.broadcast_to(np.uint8(7), (1_000_000, 1_000_000))


def test_no_decision_looks_at_the_values_of_an_array(way):
    cg = ep.CompGraph(
        {
            "crop": lambda image, mask, k: image[k:],
            "pair": lambda part, n: (part, n),
            "first": lambda both: both[0].shape,
        },
        {"crop": (("image", "mask", "k"), "part"), "pair": (("part", "n"), "both"), "first": ("both", "shape")},
    )
    runner = way.runner(cg, {"mask": HUGE, "k": 0, "n": 0})
    for n in range(way.runs):
        runner.run(image=HUGE)
        runner.rerun(n=n)
        runner.rerun(k=n)
        runner["mask"] = HUGE
        assert runner.stale == ("crop", "pair", "first")
        assert runner.rerun()["shape"] == (1_000_000 - n, 1_000_000)
    assert runner["part"].shape == (1_000_000 - n, 1_000_000)


class Shy:
    """A value that must not be asked whether it is another one."""

    def __init__(self, value):
        self.value = value

    def __eq__(self, other):
        raise AssertionError("was compared")

    def __hash__(self):
        raise AssertionError("was hashed")


def test_objects_are_neither_hashed_nor_compared(way):
    cg = ep.CompGraph(
        {"open": lambda box, k: Shy(box.value + k.value), "read": lambda opened: opened.value},
        {"open": (("box", "k"), "opened"), "read": ("opened", "value")},
    )
    runner, k = way.runner(cg, {"k": Shy(1)}), 1
    for value in range(way.runs):
        assert runner.run(box=Shy(value))["value"] == value + k
        k = 10 * value
        assert runner.rerun(k=Shy(k))["value"] == value + k


def test_the_memory_of_another_librarys_object_may_be_returned_at_every_rerun(way):
    content = bytes(range(16))
    cg = ep.CompGraph(
        {"decode": lambda k: np.frombuffer(content, np.uint8), "total": lambda y: int(y.sum())},
        {"decode": ("k", "y"), "total": ("y", "sum")},
    )
    runner = way.runner(cg, {"k": 0})
    runner.run()
    for k in range(1, 1 + way.runs):
        run = runner.rerun(k=k)
        assert run["sum"] == 120
        assert run.report.ran == ("decode",), "bytes can't change, so the array is the same"


def test_memory_that_others_can_change_counts_as_new(way):
    memory = bytearray(4)
    shared = memoryview(memory).toreadonly()
    cg = ep.CompGraph(
        {"look": lambda k: np.frombuffer(shared, np.uint8), "total": lambda y: int(y.sum())},
        {"look": ("k", "y"), "total": ("y", "sum")},
    )
    runner = way.runner(cg, {"k": 0})
    runner.run()
    for k in range(1, 1 + way.runs):
        memory[0] = k
        assert runner.rerun(k=k)["sum"] == k


def test_none_is_a_value(way):
    runner = way.runner(one(lambda x, k: None if k else x, ("x", "k")), {"k": None})
    for x in range(way.runs):
        assert runner.run(x=x)["y"] == x
    for k in range(1, 1 + way.runs):
        assert runner.rerun(k=k)["y"] is None
    assert runner.rerun(k=None)["y"] == x
    assert "y" in runner


def test_a_function_and_a_token_of_one_name_are_two_things(way):
    cg = ep.CompGraph({"a": lambda b: b + 1, "b": lambda a: a * 10}, {"a": ("b", "a"), "b": ("a", "c")})
    runner = way.runner(cg, {"b": 1})
    runner.run()
    for b in range(way.runs):
        assert (runner.rerun(b=b)["a"], runner["c"]) == (b + 1, 10 * (b + 1))


def test_nothing_is_printed_and_nothing_logged_whatever_happens(way, capfd, caplog):
    caplog.set_level(logging.DEBUG)
    runner = way.runner(raising_graph(), {"n": 1})
    for x in range(way.runs):
        runner.run(x=x)
    with pytest.raises(ZeroDivisionError):
        runner.rerun(n=3)
    for shown in (runner, runner.cg, runner.last, runner.last.report, runner.reports, runner.plan()):
        repr(shown)
        if hasattr(shown, "_repr_mimebundle_"):
            shown._repr_mimebundle_()
    logged = [record for record in caplog.records if record.name.startswith("epypes")]
    assert (*capfd.readouterr(), logged) == ("", "", [])


def test_a_runner_follows_no_change_of_the_dictionaries_that_it_was_given():
    functions = {"f": lambda *xs: sum(xs)}
    io, hparams = {"f": (["x", "n"], "y")}, {"n": 1}
    cg = ep.CompGraph(functions, io)
    runner = ep.CompGraphRunner(cg, hparams)
    functions["f"], hparams["n"] = None, 100
    hparams["x"] = 5
    io["f"][0].append("z")
    assert runner.free_source_tokens == ("x",)
    assert dict(runner.hyperparameters) == {"n": 1}
    run = runner.run(x=2)
    assert run["y"] == 3
    snapshot = runner.hyperparameters
    runner["n"] = 7
    assert (snapshot["n"], run.hyperparameters["n"], runner.hyperparameters["n"]) == (1, 1, 7)
    with pytest.raises(TypeError):
        snapshot["n"] = 3


SETTING = contextvars.ContextVar("setting", default="none")


def test_functions_see_the_callers_context(way):
    runner = way.runner(one(lambda x: SETTING.get()))
    for x in range(way.runs):
        SETTING.set(f"mine {x}")
        assert runner.run(x=x)["y"] == f"mine {x}"


def test_a_read_only_array_over_memory_that_others_change_counts_as_new(way):
    memory = bytearray(4)
    array = np.frombuffer(memoryview(memory).toreadonly(), np.uint8)

    def grab(k):
        memory[0] = k
        return array

    cg = ep.CompGraph({"grab": grab, "sum": lambda a: int(a.sum())}, {"grab": ("k", "a"), "sum": ("a", "total")})
    runner = way.runner(cg, {"k": 0})
    runner.run()
    for k in range(1, way.runs):
        assert runner.rerun(k=k)["total"] == k


def test_a_hyperparameter_that_becomes_an_array_is_guarded(way):
    def write(x, k):
        k[0] = 9
        return x

    runner = way.runner(one(write, inputs=("x", "k")), {"k": 1})
    for x in range(way.runs):
        with pytest.raises(TypeError):
            runner.run(x=x)
    array = np.zeros(3)
    runner["k"] = array
    for x in range(way.runs):
        with pytest.raises(ValueError, match="read-only"):
            runner.run(x=x)
    runner["k"] = 1
    with pytest.raises(TypeError):
        runner.rerun()
    with pytest.raises(ValueError, match="read-only"):
        runner.rerun(k=array + 1)
    assert not array.any()


def test_a_hyperparameter_that_becomes_free_is_guarded(way):
    def write(k):
        k[0] = 9

    runner = way.runner(one(write, inputs="k"), {"k": 1})
    for _ in range(way.runs):
        with pytest.raises(TypeError):
            runner.run()
    runner.unfreeze("k")
    array = np.zeros(3)
    for _ in range(way.runs):
        with pytest.raises(ValueError, match="read-only"):
            runner.run(k=array)
    assert not array.any()


@pytest.mark.parametrize("io", [{"pick": (("x", "k"), "t")}, {"pick": (("x", "k"), ("t", "u"))}])
def test_a_refilled_array_that_is_passed_through_counts_as_new(way, io):
    array = np.ones(3)
    pick = (lambda x, k: k) if io["pick"][1] == "t" else (lambda x, k: (k, x))
    cg = ep.CompGraph({"pick": pick, "total": lambda t: float(t.sum())}, io | {"total": ("t", "s")})
    runner = way.runner(cg, {"k": array})
    runner.run(x=0)
    for value in range(2, 2 + way.runs):
        array[:] = value
        assert runner.rerun(k=array)["s"] == 3 * value


def test_a_frame_that_is_refilled_upstream_counts_as_new_behind_what_passes_it_on(way):
    frame = np.frombuffer(bytearray(4), np.uint8)

    def grab(k):
        frame[:] = k
        return frame

    cg = ep.CompGraph(
        {"grab": grab, "crop": lambda f, n: f, "mean": lambda c: float(c.mean())},
        {"grab": ("k", "f"), "crop": (("f", "n"), "c"), "mean": ("c", "m")},
    )
    runner = way.runner(cg, {"k": 0, "n": 0})
    runner.run()
    for k in range(1, way.runs):
        assert runner.rerun(k=k)["m"] == k
    assert runner.rerun(n=1).report.ran == ("crop",), "what passes on what is not new makes nothing new"


def test_what_was_skipped_by_a_rerun_of_one_target_is_not_taken_for_unchanged(way):
    array = np.ones(3)
    cg = ep.CompGraph(
        {"pick": lambda x, k: k, "total": lambda t: float(t.sum()), "other": lambda k: k.sum()},
        {"pick": (("x", "k"), "t"), "total": ("t", "s"), "other": ("k", "o")},
    )
    runner = way.runner(cg, {"k": array})
    runner.run(x=0)
    for value in range(2, 2 + way.runs):
        array[:] = value
        runner.rerun("o", k=array)
        assert runner.rerun()["s"] == 3 * value


def test_what_a_failing_rerun_has_changed_is_stale_also_if_it_is_the_same_object(way):
    class Detector:
        most = 0

    detector = Detector()

    def configure(k):
        detector.most = k
        return detector

    def check(k):
        if k == 99:
            raise RuntimeError("too many")

    cg = ep.CompGraph(
        {"configure": configure, "check": check, "use": lambda d: d.most},
        {"configure": ("k", "d"), "check": ("k", None), "use": ("d", "n")},
    )
    runner = way.runner(cg, {"k": 0})
    runner.run()
    for k in range(1, way.runs):
        assert runner.rerun(k=k)["n"] == k
    with pytest.raises(RuntimeError, match="too many"):
        runner.rerun(k=99)
    if way.name != "side by side":
        with pytest.raises(StaleToken):
            runner["n"]
    assert runner.rerun("n")["n"] == 99


def test_the_context_of_the_users_exception_is_the_users(way):
    def f(x):
        try:
            int("q" if x < 0 else "1")
        except ValueError:
            raise RuntimeError("mine")  # noqa: B904 - its context is what is looked at

    runner = way.runner(one(f))
    for x in range(way.runs):
        runner.run(x=x)
    with pytest.raises(RuntimeError, match="mine") as error:
        runner.run(x=-1)
    assert type(error.value.__context__) is ValueError
    runner.freeze(x=1)
    runner.run()
    for x in range(way.runs):
        runner.rerun(x=x)
    with pytest.raises(RuntimeError, match="mine") as error:
        runner.rerun(x=-2)
    assert type(error.value.__context__) is ValueError


class Unviewable(np.ndarray):
    def view(self, *args):
        raise OSError("no view")


@pytest.mark.parametrize("value", [10**5000, np.zeros(3).view(Unviewable)], ids=["huge", "unviewable"])
def test_an_input_that_cannot_be_told_does_not_hide_the_users_exception(way, value):
    def f(x):
        raise RuntimeError("mine")

    runner = way.runner(one(f), guard=False)
    for _ in range(way.runs):
        with pytest.raises(RuntimeError, match="mine"):
            runner.run(x=value)
        assert runner.last.failure.function == "f"


@pytest.mark.slow
def test_runs_that_fail_one_after_another_do_not_keep_each_other(way):
    class Value:
        pass

    made = []

    def make(k):
        value = Value()
        made.append(weakref.ref(value))
        return value

    def fail(value):
        raise RuntimeError

    cg = ep.CompGraph({"make": make, "fail": fail}, {"make": ("k", "v"), "fail": ("v", "y")})
    runner = way.runner(cg, {"k": 0})
    for k in range(30):
        with pytest.raises(RuntimeError):
            runner.rerun(k=k) if k else runner.run()
    gc.collect()
    assert sum(value() is not None for value in made) <= 2
