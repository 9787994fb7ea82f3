"""State between runs: what a unit delay gives each run, and what runs, reruns, trials and failures leave."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import epypes as ep
from epypes.display import to_svg
from epypes.errors import GraphError, HyperparameterError, PayloadError, UnknownName


def smooth(x, before, k):
    return x if before is None else k * x + (1 - k) * before


def smoothing(initial=None):
    cg = ep.CompGraph(
        {"smooth": smooth, "scale": lambda value, by: value * by},
        {"smooth": (("x", "before", "k"), "smoothed"), "scale": (("smoothed", "by"), "y")},
    )
    return ep.delay(cg, "smoothed", "before", initial)


@pytest.fixture
def runner():
    return ep.CompGraphRunner(smoothing(), {"k": 0.5, "by": 10})


def test_each_run_begins_with_what_the_run_before_has_left(runner):
    assert runner.free_source_tokens == ("x",)
    assert [runner.run(x=x)["smoothed"] for x in (4, 2, 0)] == [4, 3, 1.5]
    assert runner["before"] == 3
    assert dict(runner.state) == {"before": 1.5}


def test_a_rerun_repeats_the_last_run_with_the_same_previous_value(runner):
    runner.run(x=4)
    runner.run(x=2)
    for _ in range(8):  # compiled from some run on
        assert runner.rerun(k=1.0)["smoothed"] == 2
        assert runner.rerun(k=0.5)["smoothed"] == 3
    assert runner.rerun(by=1)["y"] == 3
    assert runner.run(x=1)["smoothed"] == 2


def test_the_next_run_begins_with_what_the_last_rerun_has_left(runner):
    runner.run(x=4)
    runner.run(x=2)
    runner.rerun(k=1.0)
    assert dict(runner.state) == {"before": 2}
    runner.rerun(k=0.5)
    assert dict(runner.state) == {"before": 3}


def test_a_trial_leaves_the_state_as_it_was_and_an_adopted_one_does_not(runner):
    runner.run(x=4)
    runner.run(x=2)
    tried = runner.trial({"k": 1.0})
    assert (tried["smoothed"], dict(tried.state), dict(runner.state)) == (2, {"before": 2}, {"before": 3})
    assert runner.adopt(tried)
    assert dict(runner.state) == {"before": 2}


def test_trials_go_through_a_sequence_without_the_runner(runner):
    first = runner.trial({}, payload={"x": 4})
    second = runner.trial({}, payload={"x": 2}, state=first.state)
    assert (second["smoothed"], dict(runner.state), runner.last) == (3, {"before": None}, None)
    with pytest.raises(PayloadError, match="needs a payload"):
        runner.trial({}, state=first.state)


def test_a_run_knows_what_it_began_with(runner, nested):
    runner.run(x=4)
    for run in (runner.run(x=2), runner.rerun(k=1.0), runner.trial({"k": 0.25})):
        assert dict(run.state_before) == {"before": 4}
    assert runner.trial({}, payload={"x": 1}, state={"before": 7}).state_before["before"] == 7
    _, outer = nested
    outer.run(x=4)
    assert dict(outer.run(x=2).state_before) == {"inner.before": 4}


def test_a_run_that_fails_leaves_the_state_as_it_was():
    def half(x, before):
        if x < 0:
            raise ValueError(x)
        return (x + before) / 2

    cg = ep.CompGraph({"half": half, "keep": lambda h: h}, {"half": (("x", "before"), "h"), "keep": ("h", "kept")})
    runner = ep.CompGraphRunner(ep.delay(cg, "kept", "before", 0.0))
    for _ in range(2):
        runner.reset()
        runner.run(x=4.0)
        for _ in range(5):
            with pytest.raises(ValueError, match="-1"):
                runner.run(x=-1.0)
            assert dict(runner.last.state) == dict(runner.state) == {"before": 2.0}
        assert runner.run(x=2.0)["kept"] == 2.0


def test_a_run_that_does_not_need_the_token_leaves_the_state_as_it_was():
    cg = ep.CompGraph(
        {"double": lambda x: 2 * x, "add": lambda d, t: d + t},
        {"double": ("x", "doubled"), "add": (("doubled", "before"), "total")},
    )
    runner = ep.CompGraphRunner(ep.delay(cg, "total", "before", 0))
    runner.run(x=1)
    assert runner.run("doubled", x=5)["doubled"] == 10
    assert runner.run(x=1)["total"] == 4


def test_a_rerun_for_other_tokens_keeps_what_the_frame_has_left(runner):
    runner.run(x=4)
    runner.run(x=2)
    cg = ep.extend(runner.cg, {"negate": lambda x: -x}, {"negate": ("x", "negative")})
    other = ep.CompGraphRunner(cg, runner.hyperparameters)
    for x in (4, 2):
        other.run(x=x)
    other.rerun("negative", k=1.0)
    assert "smoothed" not in other
    assert dict(other.state) == {"before": 3}


def test_reset_begins_anew_and_a_rerun_still_repeats_the_last_run(runner):
    runner.run(x=4)
    runner.run(x=2)
    runner.reset()
    assert dict(runner.state) == {"before": None}
    assert runner.rerun(by=2)["y"] == 6
    runner.reset()
    assert runner.run(x=7)["smoothed"] == 7


def test_a_state_that_is_set_is_where_the_next_run_goes_on():
    runner = ep.CompGraphRunner(smoothing(), {"k": 0.5, "by": 1})
    runner.state = {"before": 8}
    assert runner.run(x=4)["smoothed"] == 6
    with pytest.raises(UnknownName, match="'befor'.*'before'"):
        runner.state = {"befor": 1}
    with pytest.raises(TypeError, match="mapping"):
        runner.state = 3
    assert dict(runner.state) == {"before": 6}


def test_arrays_of_the_state_are_read_only_and_nobody_elses():
    cg = ep.CompGraph({"add": lambda x, s: x + s}, {"add": (("x", "sum_before"), "sum")})
    start = np.zeros(3)
    runner = ep.CompGraphRunner(ep.delay(cg, "sum", "sum_before", start))
    start[:] = 9
    assert runner.run(x=np.ones(3))["sum"].tolist() == [1, 1, 1]
    with pytest.raises(ValueError, match="read-only"):
        runner.state["sum_before"][0] = 5
    mine = np.full(3, 4.0)
    runner.state = {"sum_before": mine}
    mine[:] = 0
    assert runner.run(x=np.ones(3))["sum"].tolist() == [5, 5, 5]


def test_a_delayed_token_is_neither_payload_nor_hyperparameter(runner):
    with pytest.raises(PayloadError, match=r"previous value of 'smoothed'.*runner\.state"):
        runner.run(x=1, before=2)
    with pytest.raises(PayloadError, match="Missing payload: 'x'"):
        runner.run()
    for set_it in (lambda: runner.freeze(before=1), lambda: ep.CompGraphRunner(smoothing(), {"before": 1})):
        with pytest.raises(HyperparameterError, match=r"previous value of 'smoothed'.*runner\.state"):
            set_it()


def test_a_delay_of_a_source_token_gives_the_payload_before():
    cg = ep.CompGraph({"difference": lambda x, last: x - last}, {"difference": (("x", "last_x"), "d")})
    runner = ep.CompGraphRunner(ep.delay(cg, "x", "last_x", 0))
    assert [runner.run(x=x)["d"] for x in (1, 4, 9, 16, 25)] == [1, 3, 5, 7, 9]


def test_two_delays_in_a_row_reach_two_runs_back():
    cg = ep.CompGraph({"f": lambda x, b: (x, b)}, {"f": (("x", "two_before"), "y")})
    cg = ep.union(cg, ep.CompGraph({"see": lambda b: b}, {"see": ("one_before", "seen")}))
    cg = ep.delay(ep.delay(cg, "x", "one_before"), "one_before", "two_before")
    runner = ep.CompGraphRunner(cg)
    assert [runner.run(x=x)["y"] for x in (1, 2, 3, 4)] == [(1, None), (2, None), (3, 1), (4, 2)]


def test_a_switch_that_leaves_the_token_out_keeps_the_state():
    cg = smoothing() | ep.CompGraph({"raw": lambda x: -x}, {"raw": ("x", "negative")})
    cg |= ep.switch("choose", {"on": "y", "off": "negative"}, by="mode", output="chosen")
    runner = ep.CompGraphRunner(cg, {"k": 0.5, "by": 1, "mode": "on"})
    runner.run(x=4)
    runner["mode"] = "off"
    assert runner.run(x=100)["chosen"] == -100
    runner["mode"] = "on"
    assert runner.run(x=2)["chosen"] == 3


def test_runs_of_several_threads_are_one_series():
    cg = ep.CompGraph({"add": lambda x, t: x + t}, {"add": (("x", "before"), "total")})
    runner = ep.CompGraphRunner(ep.delay(cg, "total", "before", 0))
    threads = [threading.Thread(target=lambda: [runner.run(x=1) for _ in range(200)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert dict(runner.state) == {"before": 800}


# -- nested pipelines -------------------------------------------------------------------------------------------------


@pytest.fixture
def nested():
    pipeline = ep.Pipeline("inner", smoothing(), {"k": 0.5, "by": 10})
    cg = ep.CompGraph({"inner": pipeline, "add": lambda y, g: y + g}, {"inner": ("x", "y"), "add": (("y", "g"), "z")})
    return pipeline, ep.CompGraphRunner(cg, {"g": 1})


def test_the_state_of_a_nested_pipeline_belongs_to_the_run_of_the_outer_graph(nested):
    pipeline, runner = nested
    assert [runner.run(x=x)["z"] for x in (4, 2)] == [41, 31]
    assert dict(runner.state) == {"inner.before": 3}
    assert runner.rerun(g=2)["z"] == 32
    pipeline["k"] = 1.0
    for _ in range(6):
        assert runner.rerun()["z"] == 22
    pipeline["k"] = 0.5
    assert runner.rerun()["z"] == 32
    assert runner.run(x=1)["z"] == 22
    runner.reset()
    assert runner.run(x=1)["z"] == 12


def test_a_switch_that_leaves_a_nested_pipeline_out_keeps_its_state():
    cg = ep.CompGraph(
        {"inner": ep.Pipeline("inner", smoothing(), {"k": 0.5, "by": 1}), "raw": lambda x: -x},
        {"inner": ("x", "y"), "raw": ("x", "negative")},
    )
    cg |= ep.switch("choose", {"on": "y", "off": "negative"}, by="mode", output="chosen")
    runner = ep.CompGraphRunner(cg)
    assert [runner.run(x=x, mode=mode)["chosen"] for x, mode in ((4, "on"), (100, "off"), (2, "on"))] == [4, -100, 3]
    assert dict(runner.run(x=100, mode="off").state) == {"inner.before": 3}


def test_a_nested_pipeline_with_several_outputs_and_one_inside_it():
    def split(x, before):
        return x + before, x - before

    pair = ep.delay(ep.CompGraph({"split": split}, {"split": (("x", "before"), ("up", "down"))}), "up", "before", 0)
    middle = ep.CompGraph({"pair": ep.Pipeline("pair", pair)}, {"pair": ("x", ("u", "d"))})
    outer = ep.CompGraph({"middle": ep.Pipeline("middle", middle)}, {"middle": ("x", ("a", "b"))})
    runner = ep.CompGraphRunner(outer)
    assert [(run["a"], run["b"]) for run in (runner.run(x=1), runner.run(x=2), runner.run(x=3))] == [
        (1, 1),
        (3, 1),
        (6, 0),
    ]
    assert dict(runner.state) == {"middle.pair.before": 6}


def test_a_function_that_hides_a_pipeline_with_state_is_refused(nested):
    pipeline, _ = nested
    with pytest.raises(GraphError, match="calls the pipeline 'inner', which has state"):
        ep.CompGraphRunner(ep.CompGraph({"f": lambda x: pipeline(x)}, {"f": ("x", "y")}))


def test_a_pipeline_answers_events_in_one_series(nested):
    import queue

    q_in, q_out = queue.Queue(), queue.Queue()
    pipeline = ep.FullPipeline(
        "series", smoothing(), q_in, q_out, lambda x: {"x": x}, lambda view: view["y"], {"k": 0.5, "by": 1}
    )
    with pipeline:
        for x in (4, 2, 0):
            q_in.put(x)
        assert [q_out.get(timeout=60) for _ in range(3)] == [4, 3, 1.5]
    pipeline.reset()
    assert dict(pipeline.state) == {"before": None}


# -- graphs -----------------------------------------------------------------------------------------------------------


def test_delays_go_along_with_every_operation_of_graphs():
    cg = smoothing(0)
    both = ep.union(cg, cg, suffixes=("_1", "_2"), keep=("k", "by"))
    assert {name: delay.token for name, delay in both.delays.items()} == {
        "before_1": "smoothed_1",
        "before_2": "smoothed_2",
    }
    assert ep.rename(cg, tokens={"smoothed": "s", "before": "b"}).delays == {"b": ("s", 0)}
    assert ep.extend(cg, {"more": abs}, {"more": ("y", "size")}).delays == cg.delays
    assert ep.group(cg, "all", functions=["smooth", "scale"]).delays == cg.delays
    assert (cg | cg).delays == cg.delays
    upstream = ep.CompGraph(
        {"read": lambda b: b, "make": lambda x: x, "other": lambda x: x},
        {"read": ("b", "seen"), "make": ("x", "made"), "other": ("x", "o")},
    )
    part = ep.subgraph(ep.delay(upstream, "made", "b"), "seen")
    assert (list(part.functions), dict(part.delays)) == (["read", "make"], {"b": ("made", None)})
    assert not ep.subgraph(ep.delay(upstream, "made", "b"), "o").delays


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda cg: ep.delay(cg, "x", "y"), "function 'scale' makes it"),
        (lambda cg: ep.delay(cg, "x", "x"), "its own previous value"),
        (lambda cg: ep.delay(cg, "y", "before"), "previous value of 'smoothed' already"),
        (lambda cg: cg | smoothing(1), "begins with another value there"),
        (lambda cg: ep.extend(cg, {"f": abs}, {"f": ("x", "before")}), "function 'f' makes it"),
    ],
)
def test_what_can_not_be_delayed_is_said_at_construction(make, text):
    with pytest.raises(GraphError, match=text):
        make(smoothing())


def test_a_delay_of_an_unknown_token_names_the_nearest():
    with pytest.raises(UnknownName, match="'smoothed'"):
        ep.delay(smoothing(), "smothed", "k")
    with pytest.raises(TypeError, match="takes computational graphs"):
        ep.delay(ep.CompGraphRunner(smoothing()), "y", "k")


def test_a_delay_is_drawn_as_a_dashed_arrow_back():
    assert 'class="edge back"' in to_svg(smoothing())
    assert 'class="edge back"' not in to_svg(ep.subgraph(ep.CompGraph({"f": abs}, {"f": ("x", "y")}), "y"))


@given(
    st.lists(st.tuples(st.sampled_from(["run", "rerun", "trial", "reset", "fail"]), st.integers(-3, 3)), max_size=30)
)
def test_any_series_of_runs_equals_a_loop_over_one_variable(actions):
    runner = ep.CompGraphRunner(smoothing(0), {"k": 0.5, "by": 1})
    before, left, x, k = 0, 0, None, 0.5
    for action, number in actions:
        if action == "run":
            before, x = left, number
            left = smooth(x, before, k)
            assert runner.run(x=x)["y"] == left
        elif action == "reset":
            runner.reset()
            left = 0
        elif x is None:
            continue
        elif action == "rerun":
            k = number / 4
            left = smooth(x, before, k)
            assert runner.rerun(k=k)["y"] == left
        elif action == "trial":
            assert runner.trial({"k": number / 8})["y"] == smooth(x, before, number / 8)
        else:
            with pytest.raises(TypeError):
                runner.run(x=None)
            before, x = left, None
            assert dict(runner.state) == {"before": left}
            runner.run(x=number)
            before, x = left, number
            left = smooth(x, before, k)
        assert dict(runner.state) == {"before": left}


# -- where delays meet other features ---------------------------------------------------------------------------------


def test_a_delayed_payload_is_what_it_was_although_its_buffer_is_filled_again():
    cg = ep.CompGraph(
        {"step": lambda x, last: 0 if last is None else int(x.max()) - int(last.max()), "crop": lambda x: x[:2]},
        {"step": (("x", "last"), "d"), "crop": ("x", "part")},
    )
    for token in ("x", "part"):
        runner, buffer, found = ep.CompGraphRunner(ep.delay(cg, token, "last")), np.zeros(4, np.uint8), []
        for value in (1, 2, 4, 8, 16, 32):
            buffer[:] = value
            found.append(runner.run(x=buffer)["d"])
        assert found == [0, 1, 2, 4, 8, 16]


def test_a_run_that_began_with_nothing_says_so():
    cg = ep.CompGraph(
        {"step": lambda x, last: x - last, "ten": lambda x: 10 * x}, {"step": (("x", "last"), "d"), "ten": ("x", "t")}
    )
    runner = ep.CompGraphRunner(ep.delay(cg, "x", "last", ep.Nothing))
    assert dict(runner.run(x=1).state_before) == {"last": ep.Nothing}
    assert (runner.last["d"], runner.last["t"], runner.run(x=4)["d"]) == (ep.Nothing, 10, 3)


@pytest.mark.parametrize("guard", [True, False])
def test_a_nested_pipeline_whose_state_is_nothing_runs_all_the_same(guard):
    cg = ep.CompGraph(
        {"step": lambda x, last: x - last, "ten": lambda x: 10 * x}, {"step": (("x", "last"), "d"), "ten": ("x", "t")}
    )
    inner = ep.Pipeline("inner", ep.delay(cg, "x", "last", ep.Nothing))
    runner = ep.CompGraphRunner(ep.CompGraph({"inner": inner}, {"inner": ("x", ("d", "t"))}), guard=guard)
    found = [(run["d"], run["t"]) for run in (runner.run(x=x) for x in (1, 4, 9, 16, 25, 36))]
    assert found == [(ep.Nothing, 10), (3, 40), (5, 90), (7, 160), (9, 250), (11, 360)]


def test_a_rerun_that_chooses_another_branch_leaves_what_a_run_from_scratch_leaves():
    cg = ep.CompGraph(
        {"add": lambda x, b: x + b, "negate": lambda x: -x}, {"add": (("x", "b"), "total"), "negate": ("x", "negative")}
    ) | ep.switch("choose", {"on": "total", "off": "negative"}, by="mode", output="out")
    runner = ep.CompGraphRunner(ep.delay(cg, "total", "b", 0), {"mode": "on"})
    runner.run(x=1)
    runner.rerun(mode="off")
    assert dict(runner.state) == {"b": 0}
    runner.rerun(mode="on")
    assert dict(runner.state) == {"b": 1}


def test_a_trial_is_not_adopted_after_a_reset(runner):
    runner.run(x=4)
    tried = runner.trial({"k": 1.0})
    runner.reset()
    assert not runner.adopt(tried)
    assert dict(runner.state) == {"before": None}


def test_runs_and_adopted_trials_of_two_threads_lose_nothing():
    cg = ep.CompGraph({"add": lambda x, t: x + t}, {"add": (("x", "before"), "total")})
    runner, adopted, is_over = ep.CompGraphRunner(ep.delay(cg, "total", "before", 0)), [], threading.Event()

    def adopt():
        while not is_over.is_set():
            adopted.append(runner.adopt(runner.trial({}, payload={"x": 1})))

    thread = threading.Thread(target=adopt)
    thread.start()
    for _ in range(500):
        runner.run(x=1)
    is_over.set()
    thread.join(60)
    assert dict(runner.state) == {"before": 500 + sum(adopted)}


def test_a_pipelines_own_series_goes_on_beside_that_of_an_outer_graph():
    cg = ep.CompGraph({"add": lambda x, t: x + t}, {"add": (("x", "before"), "total")})
    inner = ep.Pipeline("inner", ep.delay(cg, "total", "before", 0))
    outer = ep.CompGraphRunner(ep.CompGraph({"inner": inner}, {"inner": ("x", "y")}))
    assert (inner(1), outer.run(x=100)["y"], inner(1), outer.run(x=100)["y"]) == (1, 100, 2, 200)
