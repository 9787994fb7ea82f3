"""A function may find nothing: what takes its token is skipped, however the graph is run, until there is a value again."""

from __future__ import annotations

import copy
import pickle
import threading
from typing import Annotated

import numpy as np
import pytest

import epypes as ep
from epypes.errors import GraphError, InputMutated, OutputArityError, UnknownName

TIMEOUT_S = 60.0


class Search:
    """find: (image, minimum) -> place, which may be Nothing; then mark and measure; blur takes the image alone."""

    def __init__(self):
        self.calls = []
        functions = {
            "find": lambda image, minimum: int(image.argmax()) if image.max() >= minimum else ep.Nothing,
            "mark": lambda image, place: image + place,
            "measure": lambda marked, place: float(marked.sum() + place),
            "blur": lambda image, side: image * side,
        }
        io = {
            "find": (("image", "minimum"), "place"),
            "mark": (("image", "place"), "marked"),
            "measure": (("marked", "place"), "size"),
            "blur": (("image", "side"), "blurred"),
        }
        self.cg = ep.CompGraph({name: self.counted(name, function) for name, function in functions.items()}, io)
        self.hparams = {"minimum": 5, "side": 1}

    def counted(self, name, function):
        def counting(*args):
            self.calls.append(name)
            return function(*args)

        return counting

    def called(self):
        """Return what was called since this was last asked for."""
        calls, self.calls[:] = {*self.calls}, []
        return calls


BRIGHT, DARK = np.array([0, 9, 3]), np.array([1, 2, 3])


def test_nothing_is_one_false_object_that_is_the_same_after_a_copy_and_pickle():
    assert repr(ep.Nothing) == "Nothing"
    assert not ep.Nothing
    assert ep.Nothing is not None
    for other in (copy.copy(ep.Nothing), *copy.deepcopy([ep.Nothing]), pickle.loads(pickle.dumps(ep.Nothing))):
        assert other is ep.Nothing
    assert ep.NothingType() is ep.Nothing


@pytest.mark.parametrize("guard", [True, False])
def test_what_takes_nothing_is_not_called_and_makes_nothing(way, guard):
    graph = Search()
    runner = way.runner(graph.cg, graph.hparams, guard=guard)
    for _ in range(way.runs):
        runner.run(image=BRIGHT)
    for _ in range(way.runs):
        graph.called()
        run = runner.run(image=DARK)
        assert graph.called() == {"find", "blur"}
        assert [token for token in run if run[token] is ep.Nothing] == ["place", "marked", "size"]
        assert (run.failure, runner.stale, runner["size"]) == (None, (), ep.Nothing)
        report = run.report
        assert (report.ran, report.skipped, report.reused) == (("find", "blur"), ("mark", "measure"), ())
        assert set(report.durations_ns) == {"find", "blur"}
    assert repr(runner.reports[-1]) == "<RunReport: 2 functions ran, 0 reused, 2 skipped>"
    assert runner.run(image=BRIGHT).report.skipped == ()


def test_a_value_that_comes_back_has_the_skipped_functions_run(way):
    graph = Search()
    runner = way.runner(graph.cg, graph.hparams)
    runner.run(image=BRIGHT)
    for round_ in range(way.runs):
        graph.called()
        assert runner.rerun(minimum=100 + round_)["size"] is ep.Nothing
        assert graph.called() == {"find"}
        assert runner.rerun(minimum=5 - round_)["size"] == 16.0
        assert graph.called() == {"find", "mark", "measure"}


def test_nothing_after_nothing_is_unchanged(way):
    graph = Search()
    runner = way.runner(graph.cg, graph.hparams)
    runner.run(image=DARK)
    for round_ in range(way.runs):
        graph.called()
        run = runner.rerun(minimum=100 + round_)
        assert graph.called() == {"find"}
        assert (run.report.ran, run.report.skipped) == (("find",), ("mark", "measure"))
        assert run.report.reused == ("blur",)


def test_what_was_skipped_stays_skipped_when_something_else_is_run_again(way):
    graph = Search()
    runner = way.runner(graph.cg, graph.hparams)
    runner.run(image=DARK)
    for side in range(2, 2 + way.runs):
        run = runner.rerun(side=side)
        assert (run.report.ran, run.report.reused) == (("blur",), ("find",))
        assert run.report.skipped == ("mark", "measure")


def test_one_output_may_be_nothing_and_nothing_alone_stands_for_all_of_them(way):
    answers = {0: (1, 2), 1: (1, ep.Nothing), 2: ep.Nothing, 3: [ep.Nothing, np.zeros(2)]}
    cg = ep.CompGraph(
        {"two": answers.__getitem__, "left": lambda a: -a, "right": lambda b: -b},
        {"two": ("x", ("a", "b")), "left": ("a", "c"), "right": ("b", "d")},
    )
    runner = way.runner(cg)
    for _ in range(way.runs):
        assert [runner.run(x=0)[token] for token in "abcd"] == [1, 2, -1, -2]
    for _ in range(way.runs):
        run = runner.run(x=1)
        assert ([run[token] for token in "abcd"], run.report.skipped) == ([1, ep.Nothing, -1, ep.Nothing], ("right",))
        run = runner.run(x=2)
        assert ([run[token] for token in "abcd"], run.report.skipped) == ([ep.Nothing] * 4, ("left", "right"))
        run = runner.run(x=3)
        assert (run["c"], run.report.skipped, run["d"].tolist()) == (ep.Nothing, ("left",), [0, 0])


def test_the_number_of_values_is_still_checked():
    cg = ep.CompGraph({"two": lambda x: (ep.Nothing,)}, {"two": ("x", ("a", "b"))})
    with pytest.raises(OutputArityError, match="tuple of 1"):
        ep.CompGraphRunner(cg).run(x=1)


def test_none_is_a_value_that_functions_receive(way):
    runner = way.runner(
        ep.CompGraph({"f": lambda x: None, "g": lambda y: y is None}, {"f": ("x", "y"), "g": ("y", "z")})
    )
    for x in range(way.runs):
        assert (runner.run(x=x)["z"], runner.last.report.skipped) == (True, ())


@pytest.mark.parametrize("guard", [True, False])
def test_a_payload_and_a_hyperparameter_may_be_nothing(way, guard):
    graph = Search()
    runner = way.runner(graph.cg, graph.hparams, guard=guard)
    for _ in range(way.runs):
        runner.run(image=BRIGHT)
    for _ in range(way.runs):
        graph.called()
        run = runner.run(image=ep.Nothing)
        assert (graph.called(), run.report.ran) == (set(), ())
        assert [run[token] for token in graph.cg.sink_tokens] == [ep.Nothing] * 2
    runner.run(image=BRIGHT)
    for side in range(2, 2 + way.runs):
        assert runner.rerun(side=ep.Nothing).report.skipped == ("blur",)
        assert runner["side"] is ep.Nothing
        assert runner.rerun(side=side)["blurred"].tolist() == [0, 9 * side, 3 * side]


def test_a_switch_passes_on_what_its_chosen_branch_found(way):
    cg = ep.CompGraph(
        {
            "near": lambda x: x if x < 5 else ep.Nothing,
            "far": lambda x: 10 * x,
            "end": lambda y: -y,
            "show": lambda a: a,
        },
        {"near": ("x", "a"), "far": ("x", "b"), "end": ("y", "z"), "show": ("a", "shown")},
    ) | ep.switch("choose", {"near": "a", "far": "b"}, by="how", output="y")
    runner = way.runner(cg, {"how": "near"})
    for _ in range(way.runs):
        assert (runner.run(x=3)["z"], runner.last.report.skipped) == (-3, ())
        run = runner.run(x=7)
        assert (run["y"], run["z"], set(run.report.skipped)) == (ep.Nothing, ep.Nothing, {"show", "choose", "end"})
        run = runner.rerun(how="far")
        assert (run["z"], run.report.skipped) == (-70, ("show",))
        runner.rerun(how="near")
    with pytest.raises(UnknownName, match="Nothing"):
        runner.rerun(how=ep.Nothing)


def test_functions_with_other_rules_for_their_inputs_are_skipped_too(way):
    def write(image):
        return image.flags.writeable

    def as_image(image: Annotated[np.ndarray, ep.Image()]) -> Annotated[np.ndarray, ep.Image()]:
        return ep.Nothing if image.max() > 100 else image

    functions = {"find": lambda x: x if x.any() else ep.Nothing, "write": ep.unguarded(write), "as_image": as_image}
    cg = ep.CompGraph(functions, {"find": ("x", "y"), "write": ("y", "a"), "as_image": ("y", "b")})
    runner = way.runner(cg)
    images = [np.full((2, 2, 3), level, np.uint8) for level in (0, 1, 200)]
    for _ in range(way.runs):
        assert runner.run(x=images[0]).report.skipped == ("write", "as_image")
        run = runner.run(x=images[1].copy())
        assert (run["a"], run["b"].max(), run.report.skipped) == (True, 1, ())
        assert (runner.run(x=images[2].copy())["b"], runner.last.report.skipped) == (ep.Nothing, ())


def test_a_checked_function_is_skipped_and_others_are_still_checked():
    def spoil(values):
        values[0].append(1)

    cg = ep.CompGraph({"find": lambda x: x or ep.Nothing, "spoil": spoil}, {"find": ("x", "y"), "spoil": ("y", None)})
    runner = ep.CompGraphRunner(cg, check_mutation=True)
    assert runner.run(x=[]).report.skipped == ("spoil",)
    with pytest.raises(InputMutated):
        runner.run(x=[[]])


def test_a_function_that_fails_beside_skipped_ones_leaves_the_run_as_any_failure_does(way):
    cg = ep.CompGraph(
        {"find": lambda x: ep.Nothing, "skip": abs, "fail": lambda x: 1 // x, "after": abs},
        {"find": ("x", "y"), "skip": ("y", "z"), "fail": ("x", "w"), "after": ("w", "v")},
    )
    runner = way.runner(cg)
    for x in range(1, 1 + way.runs):
        runner.run(x=x)
    for _ in range(way.runs):
        with pytest.raises(ZeroDivisionError) as error:
            runner.run(x=0)
        assert (error.value.__context__, error.value.__cause__) == (None, None)
        assert (runner.last.failure.function, runner["z"], set(runner.last)) == ("fail", ep.Nothing, {"x", "y", "z"})
        assert runner.last.report.skipped == ("skip",)
        assert runner.run(x=1)["v"] == 1


def test_what_was_skipped_behind_a_function_that_fails_leaves_no_trace(way):
    """Side by side it is skipped before the other fails."""
    passed = threading.Event()

    def fail(x):
        assert way.name != "side by side" or passed.wait(TIMEOUT_S)
        return 1 // x

    cg = ep.CompGraph(
        {"find": lambda x: ep.Nothing, "fail": fail, "skip": abs, "tell": lambda x: passed.set()},
        {"find": ("x", "y"), "fail": ("x", "w"), "skip": ("y", "z"), "tell": ("x", None)},
    )
    runner = way.runner(cg)
    for _ in range(way.runs):
        runner.run(x=1)
        passed.clear()
        with pytest.raises(ZeroDivisionError):
            runner.run(x=0)
        assert (set(runner.last), runner.last.report.ran) == ({"x", "y"}, ("find", "fail"))
        assert (runner.last.report.skipped, runner.stale) == ((), ("fail", "skip", "tell"))


def test_an_array_that_is_passed_through_counts_as_new_after_a_compiled_run_has_met_nothing(way):
    """The functions behind the one that was skipped know what is new to them as if none had been skipped."""
    cg = ep.CompGraph(
        {
            "crop": lambda image, k: image[k:],
            "find": lambda k: ep.Nothing if k % 2 else k,
            "skip": abs,
            "same": lambda crop, k: crop,
            "total": lambda crop: float(crop.sum()),
        },
        {
            "crop": (("image", "k"), "cropped"), "find": ("k", "found"), "skip": ("found", "end"),
            "same": (("cropped", "k"), "passed"), "total": ("passed", "sum"),
        },
    )  # fmt: skip
    runner = way.runner(cg, {"k": 0})
    image = np.arange(50)
    runner.run(image=image)
    for k in range(1, 1 + 2 * way.runs):
        run = runner.rerun(k=k)
        assert (run["sum"], run["end"]) == (image[k:].sum(), ep.Nothing if k % 2 else k)


def test_a_pipeline_in_a_graph_passes_on_what_it_has_not_found(way):
    inner = ep.CompGraph(
        {"find": lambda x: x if x > 3 else ep.Nothing, "double": lambda y: 2 * y, "count": lambda x: x + 1},
        {"find": ("x", "y"), "double": ("y", "z"), "count": ("x", "n")},
    )
    cg = ep.CompGraph(
        {"inner": ep.Pipeline("inner", inner), "after": lambda z: -z, "next": lambda n: n},
        {"inner": ("x", ("z", "n")), "after": ("z", "end"), "next": ("n", "m")},
    )
    runner = way.runner(cg)
    for _ in range(way.runs):
        assert [runner.run(x=5)[token] for token in ("z", "n", "end", "m")] == [10, 6, -10, 6]
        assert [runner.run(x=1)[token] for token in ("z", "n", "end", "m")] == [ep.Nothing, 2, ep.Nothing, 2]
        assert runner.run(x=ep.Nothing).report.skipped == ("inner", "after", "next")


def test_state_between_runs_stays_where_nothing_was_found(way):
    """So a track that was lost goes on from the last place where it was seen."""
    cg = ep.CompGraph(
        {"find": lambda x: x if x else ep.Nothing, "smooth": lambda place, before: (place + before) / 2},
        {"find": ("x", "place"), "smooth": (("place", "before"), "smoothed")},
    )
    inner = ep.delay(cg, "smoothed", "before", initial=0)
    outer = ep.CompGraph({"track": ep.Pipeline("track", inner), "end": abs}, {"track": ("x", "y"), "end": ("y", "z")})
    for graph, token, key in ((inner, "smoothed", "before"), (outer, "z", "track.before")):
        runner = way.runner(graph)
        for _ in range(way.runs):
            runner.reset()
            assert [runner.run(x=x)[token] for x in (8, 0, 0, 6)] == [4, ep.Nothing, ep.Nothing, 5]
            assert runner.run(x=0).state == runner.state == {key: 5}
        assert runner.run(x=ep.Nothing)[token] is ep.Nothing
        assert runner.state == {key: 5}


def test_a_trial_is_skipped_as_a_rerun_is():
    graph = Search()
    runner = ep.CompGraphRunner(graph.cg, graph.hparams)
    runner.run(image=BRIGHT)
    trial = runner.trial({"minimum": 100}, "size")
    assert (trial["size"], trial.report.skipped, runner["size"]) == (ep.Nothing, ("mark", "measure"), 16.0)
    assert runner.adopt(trial)
    assert runner["size"] is ep.Nothing
    assert runner.reports[-1].skipped == ("mark", "measure")


def test_only_what_targets_need_is_skipped():
    graph = Search()
    runner = ep.CompGraphRunner(graph.cg, graph.hparams)
    run = runner.run("marked", image=DARK)
    assert (set(run), run.report.skipped) == ({"image", "minimum", "side", "place", "marked"}, ("mark",))
    assert runner.rerun("size").report.skipped == ("mark", "measure")


def test_an_annotation_that_allows_nothing_fits_a_function_that_takes_the_value():
    def find(x: int) -> float | ep.NothingType:
        return ep.Nothing

    def scale(y: float) -> float:
        return y

    def spell(y: str) -> str:
        return y

    ep.CompGraph({"find": find, "take": scale}, {"find": ("x", "y"), "take": ("y", "z")})
    with pytest.raises(GraphError, match="no value is both"):
        ep.CompGraph({"find": find, "take": spell}, {"find": ("x", "y"), "take": ("y", "z")})
