"""Of the branches of a switch only the chosen one runs, however often the choice changes and however it is run."""

from __future__ import annotations

import pytest

import epypes as ep
from epypes.errors import NotComputed, PayloadError, StaleToken, UnknownName


class Branches:
    """gray: image -> g; then canny(g, lo) or sobel(g, k), chosen by ``method``; then end. Counts calls."""

    def __init__(self):
        self.calls = []
        functions = {
            "gray": lambda image: image + 1,
            "canny": lambda g, lo: g * lo,
            "sobel": lambda g, k: g - k,
            "end": lambda edges: -edges,
        }
        io = {
            "gray": ("image", "g"),
            "canny": (("g", "lo"), "edges_canny"),
            "sobel": (("g", "k"), "edges_sobel"),
            "end": ("edges", "out"),
        }
        counted = {name: self.counted(name, function) for name, function in functions.items()}
        branches = {"canny": "edges_canny", "sobel": "edges_sobel"}
        self.cg = ep.CompGraph(counted, io) | ep.switch("choose", branches, by="method", output="edges")
        self.hparams = {"lo": 2, "k": 3, "method": "canny"}

    def counted(self, name, function):
        def counting(*args):
            self.calls.append(name)
            return function(*args)

        return counting

    def called(self):
        """Return what was called since this was last asked for."""
        calls, self.calls[:] = sorted(self.calls), []
        return calls


def switched_to_sobel(way):
    """Return the branches and a runner that ran canny, then sobel."""
    graph = Branches()
    runner = way.runner(graph.cg, graph.hparams)
    runner.run(image=4)
    runner.rerun(method="sobel")
    graph.called()
    return graph, runner


def test_only_the_chosen_branch_runs_and_the_other_is_not_computed(way):
    graph = Branches()
    runner = way.runner(graph.cg, graph.hparams)
    runs = [runner.run(image=image) for image in range(way.runs)]
    with way.is_taken():
        runs.append(runner.run(image=way.runs))
    assert graph.called() == sorted(["canny", "end", "gray"] * len(runs))
    for image, run in enumerate(runs):
        assert run["out"] == -2 * (image + 1)
        assert run.report.ran == ("gray", "canny", "choose", "end")
        assert run.report.reused == ()
        assert "edges_sobel" not in run
        with pytest.raises(NotComputed, match=r"'edges_sobel' has not been computed\. Call rerun\('edges_sobel'\)"):
            run["edges_sobel"]
    assert runner.stale == ()


def test_switching_back_and_forth_runs_what_has_become_needed_and_nothing_else(way):
    graph = Branches()
    runner = way.runner(graph.cg, graph.hparams)
    runner.run(image=4)
    graph.called()
    run = runner.rerun(method="sobel")
    assert (run["out"], graph.called()) == (-2, ["end", "sobel"])
    for _ in range(way.runs):
        assert (runner.rerun(method="canny")["out"], graph.called()) == (-10, ["end"])
        assert (runner.rerun(method="sobel")["out"], graph.called()) == (-2, ["end"])
    assert runner["edges_canny"] == 10, "what was computed and is up to date stays"


def test_a_change_in_the_branch_that_is_not_chosen_waits_until_it_is(way):
    graph, runner = switched_to_sobel(way)
    for lo in range(10, 10 + way.runs):
        run = runner.rerun(lo=lo)
        assert (graph.called(), run["out"], run.report.ran) == ([], -2, ())
        with pytest.raises(StaleToken):
            runner["edges_canny"]
    assert runner.plan().order == ()
    assert runner.plan("edges_canny").order == ("canny",)
    run = runner.rerun(method="canny")
    assert (run["out"], graph.called()) == (-5 * lo, ["canny", "end"])


def test_a_branch_that_is_asked_for_by_name_disturbs_the_chosen_one_in_nothing(way):
    graph, runner = switched_to_sobel(way)
    for lo in range(10, 10 + way.runs):
        assert runner.rerun(lo=lo).report.ran == ()
        assert (runner.rerun("edges_canny")["edges_canny"], graph.called()) == (5 * lo, ["canny"])
        assert (runner.stale, runner["out"]) == ((), -2)


def test_the_selector_may_come_with_the_payload(way):
    graph = Branches()
    runner = way.runner(graph.cg, {"lo": 2, "k": 3})
    assert runner.free_source_tokens == ("image", "method")
    for _ in range(way.runs):
        assert (runner.run(image=4, method="canny")["out"], graph.called()) == (-10, ["canny", "end", "gray"])
        assert (runner.run(image=4, method="sobel")["out"], graph.called()) == (-2, ["end", "gray", "sobel"])
    with pytest.raises(UnknownName, match="No branch 'cany' of switch 'choose'. Did you mean 'canny'"):
        runner.run(image=4, method="cany")
    with pytest.raises(PayloadError, match="Missing payload: 'method'"):
        runner.run(image=4)
    assert graph.called() == []
    assert runner["out"] == -2, "a run that was refused leaves the last one"


@pytest.mark.parametrize("bad", ["cany", None, 3, ["canny"]])
def test_a_bad_selector_is_refused_where_it_is_set_and_nothing_changes(way, bad):
    graph = Branches()
    words = "^No branch .* of switch 'choose'"
    with pytest.raises(UnknownName, match=words):
        way.runner(graph.cg, {**graph.hparams, "method": bad})
    runner = way.runner(graph.cg, graph.hparams)
    for _ in range(way.runs):
        runner.run(image=4)
    last, revision = runner.last, runner.revision
    graph.called()
    for attempt in (
        lambda: runner.__setitem__("method", bad),
        lambda: runner.rerun(lo=99, method=bad),
        lambda: runner.freeze(lo=99, method=bad),
    ):
        with pytest.raises(UnknownName, match=words) as error:
            attempt()
        assert error.value.known == ("canny", "sobel")
    assert (runner.last, runner.revision, graph.called()) == (last, revision, [])
    assert dict(runner.hyperparameters) == graph.hparams
    assert runner.stale == ()


def test_a_plan_tells_the_branch_and_what_is_left_out():
    graph = Branches()
    runner = ep.CompGraphRunner(graph.cg, graph.hparams)
    plan = runner.plan()
    assert (plan.order, plan.left_out) == (("gray", "canny", "choose", "end"), ("sobel",))
    assert dict(plan.branches) == {"choose": "canny"}
    runner.run(image=1)
    runner["method"] = "sobel"
    plan = runner.plan()
    assert (plan.order, plan.reused, plan.left_out) == (("sobel", "choose", "end"), ("gray",), ("canny",))
    assert dict(plan.branches) == {"choose": "sobel"}
    assert plan.why["choose"] == "'method' changed"
    assert runner.plan("g").left_out == ("canny", "sobel", "choose", "end")
    assert dict(ep.CompGraphRunner(graph.cg, {"lo": 2, "k": 3}).plan().branches) == {}
    assert graph.called() == ["canny", "end", "gray"], "planning calls nothing"


def test_what_only_a_branch_not_chosen_needs_is_left_out_however_far_up(way):
    graph = Branches()
    deep = ep.CompGraph(
        {"load": graph.counted("load", abs), "clean": graph.counted("clean", abs)},
        {"load": ("path", "loaded"), "clean": ("loaded", "cleaned")},
    )
    cg = deep | graph.cg | ep.switch("mask", {True: "cleaned", False: "out"}, by="is_masked", output="end")
    runner = way.runner(cg, {**graph.hparams, "is_masked": False})
    assert runner.plan().left_out == ("load", "clean", "sobel")
    for image in range(way.runs):
        for targets in ([], ["end"]):
            assert runner.run(*targets, image=image)["end"] == -2 * (image + 1), "path need not be given"
            assert graph.called() == ["canny", "end", "gray"]
    with pytest.raises(PayloadError, match="'path'"):
        runner.rerun(is_masked=True)
    assert runner.run(path=-7, image=0)["end"] == 7
    assert graph.called() == ["clean", "load"]


def test_a_failure_in_the_chosen_branch_leaves_the_way_over_the_other(way):
    graph = Branches()
    runner = way.runner(graph.cg, graph.hparams)
    for _ in range(way.runs):
        runner.run(image=4)
    with pytest.raises(TypeError, match="NoneType") as error:
        runner.rerun(lo=None)
    assert error.value.__notes__ == ["In function 'canny': (g=5, lo=None) -> (edges_canny)"]
    assert "out" not in runner
    run = runner.rerun(method="sobel")
    assert (run["out"], run.failure) == (-2, None)
    with pytest.raises(NotComputed):
        runner["edges_canny"]
