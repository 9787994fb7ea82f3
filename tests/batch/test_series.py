"""Graphs with state over series: one series in order, several side by side, and what of them is stored."""

from __future__ import annotations

import gc
import threading
import weakref
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.errors import PayloadError, PromotionRefused, ScaleError
from tests.bundle.cells import cell

SOURCE = """
import numpy as np


def smooth(x, before, k):
    if float(np.mean(x)) < 0:
        raise ValueError("negative")
    mean = np.asarray(x, float).mean(keepdims=True)
    return mean if before is None else k * mean + (1 - k) * before


def level(smoothed):
    return float(smoothed[0] if smoothed.ndim == 1 else smoothed.flat[0])
"""


def smoothing(initial=None, k=0.5):
    made = cell(SOURCE)
    cg = ep.CompGraph(
        {"smooth": made["smooth"], "level": made["level"]},
        {"smooth": (("x", "before", "k"), "smoothed"), "level": ("smoothed", "y")},
    )
    return ep.CompGraphRunner(ep.delay(cg, "smoothed", "before", initial), {"k": k})


def by_hand(xs, k=0.5):
    """The smoothed values of one series; None of what fails."""
    found, before = [], None
    for x in xs:
        if x < 0:
            found.append(None)
            continue
        before = x if before is None else k * x + (1 - k) * before
        found.append(before)
    return found


def values(result):
    return [outcome.values.get("y") for outcome in result]


def without_times(result):
    return [replace(outcome, times_ns={}, total_ns=0) for outcome in result]


@pytest.fixture
def runner():
    return smoothing()


@pytest.fixture(params=["this thread", "threads", pytest.param("processes", marks=pytest.mark.slow)])
def executor(request):
    if request.param == "threads":
        with ThreadPoolExecutor(3) as pool:
            yield pool
    else:
        yield request.getfixturevalue("processes") if request.param == "processes" else None


XS = [8.0, 4.0, -1.0, 0.0, 16.0, 2.0, 5.0]


def test_each_item_begins_with_what_the_one_before_it_has_left(runner, executor):
    result = ep.map(runner, XS, executor)
    assert values(result) == by_hand(XS)
    assert [outcome.name for outcome in result.failures] == ["#2"]
    assert "series" not in result.to_frame()
    assert values(ep.map(runner, (np.full((2, 2), x) for x in XS), executor)) == by_hand(XS)


def test_several_series_go_on_each_by_itself(runner, executor):
    xs = [float(number % 11) for number in range(40)]
    keys = ["left" if number % 3 else "right" for number in range(40)]
    expected = dict.fromkeys(range(40))
    for key in ("left", "right"):
        places = [place for place, other in enumerate(keys) if other == key]
        expected |= dict(zip(places, by_hand([xs[place] for place in places]), strict=True))
    for images in (xs, iter(xs)):
        result = ep.map(runner, images, executor, series=keys)
        assert values(result) == list(expected.values())
        assert result.to_frame()["series"].tolist() == keys
    assert "series" in result._repr_mimebundle_()["text/html"]


def test_an_ordered_folder_is_one_series_and_a_function_of_the_path_divides_it(runner, tmp_path, executor):
    for camera in ("a", "b"):
        (tmp_path / camera).mkdir()
        for number, x in enumerate((8, 4, 2, 6)):
            cv2.imwrite(str(tmp_path / camera / f"{number}.png"), np.full((4, 4), x + (camera == "b"), np.uint8))
    assert values(ep.map(runner, tmp_path / "a", executor)) == by_hand((8, 4, 2, 6))
    result = ep.map(runner, str(tmp_path / "*" / "*.png"), executor, series=lambda path: path.parent.name)
    assert values(result) == by_hand((8, 4, 2, 6)) + by_hand((9, 5, 3, 7))
    assert result.to_frame()["series"].tolist() == ["a"] * 4 + ["b"] * 4


def test_a_series_begins_with_the_initial_state_and_the_runner_keeps_its_own():
    runner = smoothing(np.array([4.0]))
    runner.run(x=100.0)
    before = dict(runner.state)
    assert values(ep.map(runner, [8.0, 2.0])) == [6.0, 4.0]
    assert (dict(runner.state), runner["y"]) == (before, 52.0)


def test_a_file_that_can_not_be_read_leaves_the_state_as_it_was(runner, tmp_path):
    for number, x in ((0, 8), (2, 4)):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((4, 4), x, np.uint8))
    (tmp_path / "1.png").write_bytes(b"no image")
    result = ep.map(runner, tmp_path)
    assert values(result) == [8.0, None, 6.0]
    assert result[1].error_info.kind == "ImageFileError"


def test_of_several_source_tokens_the_function_is_given_a_dict():
    cg = ep.CompGraph({"add": lambda x, camera, t: t + x}, {"add": (("x", "camera", "before"), "total")})
    runner = ep.CompGraphRunner(ep.delay(cg, "total", "before", 0))
    items = [{"x": 1, "camera": 0}, {"x": 10, "camera": 1}, {"x": 2, "camera": 0}]
    result = ep.map(runner, items, series=lambda item: item["camera"])
    assert [outcome.values["total"] for outcome in result] == [1, 10, 3]


def test_series_run_side_by_side_and_one_series_never_does():
    barrier, running, most = threading.Barrier(2, timeout=60), set(), 0

    def add(x, before):
        nonlocal most
        key = x[0]
        assert key not in running
        running.add(key)
        if x[1] == 0:
            barrier.wait()  # both series have begun
        most = max(most, len(running))
        running.discard(key)
        return before + 1

    runner = ep.CompGraphRunner(ep.delay(ep.CompGraph({"add": add}, {"add": (("x", "before"), "n")}), "n", "before", 0))
    items = [(key, number) for key in "ab" for number in range(50)]
    with ThreadPoolExecutor(4) as pool:
        result = ep.map(runner, items, pool, series=lambda item: item[0])
    assert [outcome.values["n"] for outcome in result] == [*range(1, 51)] * 2
    assert most == 2


@pytest.mark.parametrize(
    ("series", "text"),
    [
        ("camera", "says no series"),
        (3, "says no series"),
        ([1], "series has 1 keys, and there are more items"),
        ([1, 2, 3], "more keys than there are items: 2"),
        ([[1], [2]], "The series of #0 is .*which is no key"),
        ([float("nan")] * 2, "nan, which is no key"),
    ],
)
def test_keys_that_divide_nothing_are_refused(runner, series, text):
    with pytest.raises(ScaleError, match=text):
        ep.map(runner, [1.0, 2.0], series=series)


def test_what_a_function_of_series_raises_is_its_own_and_names_the_item(runner):
    with pytest.raises(AttributeError) as raised:
        ep.map(runner, [1.0, 2.0], series=lambda path: path.parent.name)
    assert raised.value.__notes__ == [
        "In series=, which was called with a 'float', the input of item #0. It gets the Path of a file, else the value "
        "itself."
    ]


def test_a_case_without_any_image_is_named(runner):
    with pytest.raises(ScaleError, match="The inputs of case 'dark': The image set is empty"):
        ep.check(runner, [ep.Case([1.0], name="light"), ep.Case([], name="dark")])


def test_keys_of_a_graph_without_state_are_a_column_only():
    runner = ep.CompGraphRunner(ep.CompGraph({"double": lambda x: 2 * x}, {"double": ("x", "y")}))
    frame = ep.map(runner, [1, 2], series="ab"[:0] or ["a", "b"]).to_frame()
    assert frame[["series", "y"]].to_numpy().tolist() == [["a", 2], ["b", 4]]


@pytest.mark.parametrize("threads", [0, 2])
def test_a_long_series_is_never_in_memory_as_a_whole(threads):
    alive, most = set(), 0

    def frames():
        nonlocal most
        for number in range(200):
            frame = np.full((10, 10), number % 7, np.uint8)
            alive.add(number)
            weakref.finalize(frame, alive.discard, number)
            most = max(most, len(alive))
            yield frame
            del frame

    cg = ep.CompGraph({"add": lambda x, t: t + int(x[0, 0])}, {"add": (("x", "before"), "total")})
    runner = ep.CompGraphRunner(ep.delay(cg, "total", "before", 0))
    gc.disable()
    try:
        if threads:
            with ThreadPoolExecutor(threads) as pool:
                result = ep.map(runner, frames(), pool)
        else:
            result = ep.map(runner, frames())
    finally:
        gc.enable()
    assert result[-1].values["total"] == sum(number % 7 for number in range(200))
    assert most <= (4 if not threads else 20)


# -- sweeps -----------------------------------------------------------------------------------------------------


def test_each_setting_of_a_sweep_is_a_series_of_its_own(runner, executor):
    result = ep.sweep(runner, {"k": [0.25, 0.5, 1.0]}, XS, executor, show=())
    for k in (0.25, 0.5, 1.0):
        assert values([outcome for outcome in result if outcome.setting["k"] == k]) == by_hand(XS, k)
    assert [outcome.number for outcome in result] == [number for number in range(7) for _ in range(3)]


def test_a_sweep_of_the_last_payload_begins_as_the_last_run_did(runner):
    with pytest.raises(PayloadError):
        ep.sweep(runner, {"k": [0.5]})
    runner.run(x=8.0)
    runner.run(x=4.0)
    assert values(ep.sweep(runner, {"k": [0.25, 1.0]}, show=())) == [7.0, 4.0]
    assert dict(runner.state) == {"before": [6.0]}


# -- stored results ---------------------------------------------------------------------------------------------


@pytest.fixture
def calls():
    return []


@pytest.fixture
def noted(calls):
    class Log:
        def __call__(self, x):
            calls.append(x)

    from tests.calls import log_to

    logger = log_to(Log())

    def add(x, before):
        logger.info(x)
        return before + x

    return ep.CompGraphRunner(ep.delay(ep.CompGraph({"add": add}, {"add": (("x", "before"), "y")}), "y", "before", 0))


def test_a_series_that_is_stored_is_not_run_again(noted, calls, tmp_path):
    options = {"store": tmp_path / "r.sqlite", "name": "a", "series": ["l", "r", "l", "r"]}
    first = ep.map(noted, [1, 10, 2, 20], **options)
    assert values(first) == [1, 10, 3, 30]
    calls.clear()
    assert without_times(ep.map(noted, [1, 10, 2, 20], **options)) == without_times(first)
    assert calls == []
    assert values(ep.map(noted, [1, 10, 2, 21], **options)) == [1, 10, 3, 31]
    assert calls == [10, 21]


def test_an_item_counts_for_all_that_came_before_it(noted, calls, tmp_path):
    options = {"store": tmp_path / "r.sqlite", "name": "a"}
    ep.map(noted, [1, 2, 3], **options)
    assert values(ep.map(noted, [5, 2, 3], **options)) == [5, 7, 10]
    assert values(ep.map(noted, [1, 2, 3], **options)) == [1, 3, 6]
    assert values(ep.map(noted, [5, 2, 3], **options)) == [5, 7, 10]
    assert calls == [1, 2, 3, 5, 2, 3]
    assert values(ep.map(noted, [1, 2, 3, 4], **options)) == [1, 3, 6, 10]


def test_an_interrupted_series_is_run_from_its_beginning(noted, calls, tmp_path, monkeypatch):
    options = {"store": tmp_path / "r.sqlite", "name": "a", "series": ["l", "l", "r", "r", "r"]}

    def interrupted():
        yield from (1, 2, 10, 20)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ep.map(noted, interrupted(), **options)
    calls.clear()
    assert values(ep.map(noted, [1, 2, 10, 20, 30], **options)) == [1, 3, 10, 30, 60]
    assert calls == [10, 20, 30]


def test_an_interrupt_within_a_function_ends_the_map():
    def interrupted(x, before):
        if x == 2:
            raise KeyboardInterrupt
        return x

    cg = ep.CompGraph({"f": interrupted}, {"f": (("x", "before"), "y")})
    with pytest.raises(KeyboardInterrupt):
        ep.map(ep.CompGraphRunner(ep.delay(cg, "y", "before")), [1, 2, 3])


def test_of_a_generator_everything_is_run(noted, calls, tmp_path):
    for _ in range(2):
        assert values(ep.map(noted, iter([1, 2]), store=tmp_path / "r.sqlite", name="a")) == [1, 3]
    assert calls == [1, 2, 1, 2]


def test_another_initial_state_is_another_computation(tmp_path):
    for initial in (None, np.array([4.0])):
        found = values(ep.map(smoothing(initial), [8.0, 2.0], store=tmp_path / "r.sqlite"))
        assert found == ([8.0, 5.0] if initial is None else [6.0, 4.0])


# -- cases ------------------------------------------------------------------------------------------------------


def test_the_case_of_a_graph_with_state_is_a_sequence_of_which_the_end_is_measured(runner, tmp_path, executor):
    (tmp_path / "frames").mkdir()
    for number, x in enumerate((8, 4, 2)):
        cv2.imwrite(str(tmp_path / "frames" / f"{number}.png"), np.full((4, 4), x, np.uint8))
    cases = [
        ep.Case([8.0, 4.0], {"y": 6.0}, name="good"),
        ep.Case([8.0, 4.0], {"y": 4.0}, name="state"),
        ep.Case(tmp_path / "frames", {"y": 4.0}, name="folder"),
        ep.Case([8.0, 4.0], {"y": 4.0}, hyperparameters={"k": 1.0}, name="other k"),
        ep.Case(8.0, {"y": 8.0}, name="one"),
        ep.Case([8.0, -1.0, 4.0], {"y": 6.0}, name="fails"),
        ep.Case(tmp_path / "nowhere" / "*.png", {"y": 6.0}, name="missing"),
    ]
    result = ep.check(runner, cases, executor)
    assert [name for name, has_passed in result.cases.items() if not has_passed] == ["state", "fails", "missing"]
    reasons = {outcome.case: outcome.reason for outcome in result.failures}
    assert reasons["fails"] == "smooth: ValueError: negative (frame 1: #1)"
    assert "No file matches" in reasons["missing"]


def test_cases_in_a_file_name_folders_and_lists(runner, tmp_path):
    (tmp_path / "frames").mkdir()
    for number, x in enumerate((8, 4)):
        cv2.imwrite(str(tmp_path / "frames" / f"{number}.png"), np.full((4, 4), x, np.uint8))
    (tmp_path / "CASES.toml").write_text(
        """
[[case]]
inputs = "frames"
[[case.check]]
expected = 6.0

[[case]]
inputs = ["frames/1.png", {x = "frames/0.png"}]
[[case.check]]
expected = 6.0

[[case]]
inputs = "frames/*.png"
[[case.check]]
token = "y"
min = 7.0
"""
    )
    result = ep.check(runner, tmp_path / "CASES.toml")
    assert list(result.cases.values()) == [True, True, False]


def test_single_images_as_cases_are_refused_with_both_ways_out(runner, crops):
    for given in ([crops[0], crops[1]], [1.0], [{"x": 1.0}], ["a.png"]):
        with pytest.raises(
            ScaleError, match=r"a case is a sequence of images.* write \[\[\.\.\.\]\].* ep\.Case\(image\)"
        ):
            ep.check(runner, given)
        with pytest.raises(ScaleError, match="a case is a sequence of images"):
            ep.optimize(runner, "y", given, 2, ranges={"k": (0.0, 1.0)})


def test_a_search_runs_whole_series(runner, executor, tmp_path):
    options = {"ranges": {"k": [0.25, 0.5, 1.0]}, "direction": "minimize", "executor": executor}
    options |= {"store": tmp_path / "r.sqlite"}
    result = ep.optimize(runner, "y", [[8.0, 4.0, 0.0], [6.0, 2.0]], 12, **options)
    assert result.best == {"k": 1.0}
    assert {trial.setting["k"]: trial.value for trial in result} == {
        k: (by_hand([8.0, 4.0, 0.0], k)[-1] + by_hand([6.0, 2.0], k)[-1]) / 2 for k in (0.25, 0.5, 1.0)
    }
    assert runner.last is None
    assert len(ep.optimize(runner, "y", [[8.0, 4.0, 0.0], [6.0, 2.0]], 12, **options)) == 12


@pytest.mark.parametrize("threads", [0, 2])
def test_a_search_that_is_stopped_does_not_wait_for_the_end_of_a_sequence(threads):
    stop, calls = threading.Event(), []

    def add(x, before, gain):
        calls.append(x)
        if x == 3:
            stop.set()
        return before + gain * x

    cg = ep.CompGraph({"add": add}, {"add": (("x", "before", "gain"), "total")})
    runner = ep.CompGraphRunner(ep.delay(cg, "total", "before", 0), {"gain": 1})
    with ThreadPoolExecutor(threads or 1) as pool:
        executor = pool if threads else None
        found = ep.optimize(runner, "total", [range(1000)], 50, ranges={"gain": (0, 5)}, executor=executor, stop=stop)
    assert found.was_stopped
    assert len(found) == 0
    assert max(calls) == 3


def test_a_folder_is_one_case_of_a_search(runner, tmp_path):
    for number, x in enumerate((8, 4)):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((4, 4), x, np.uint8))
    result = ep.optimize(runner, "y", tmp_path, 1, ranges={"k": (0.0, 1.0)})
    assert result.best_value == 6.0


def test_a_search_steps_the_state_that_its_metric_does_not_read_itself():
    cg = ep.CompGraph(
        {"read": lambda before, gain: before * gain, "step": lambda x, before: before + x},
        {"read": (("before", "gain"), "seen"), "step": (("x", "before"), "total")},
    )
    runner = ep.CompGraphRunner(ep.delay(cg, "total", "before", 0), {"gain": 1})
    result = ep.optimize(runner, "seen", [[1, 2, 3, 4]], 1, ranges={"gain": [1]})
    assert result.best_value == 6.0


class CountingExecutor(Executor):
    """Hands calls on, and counts them."""

    def __init__(self, executor):
        self.executor, self.count = executor, 0

    def submit(self, call, /, *args, **kwargs):
        self.count += 1
        return self.executor.submit(call, *args, **kwargs)


@pytest.mark.slow
def test_cases_are_run_in_the_processes_that_are_given(processes):
    made = cell("def keep_most(x, before):\n    return max(x, before)\n")  # no other test has made a package of it
    cg = ep.CompGraph({"keep_most": made["keep_most"]}, {"keep_most": (("x", "before"), "y")})
    runner, counting = ep.CompGraphRunner(ep.delay(cg, "y", "before", 0)), CountingExecutor(processes)
    assert ep.check(runner, [ep.Case([8, 4], {"y": 8}), ep.Case([2], {"y": 2})], counting)
    assert counting.count >= 2


def test_a_state_that_can_not_travel_is_refused_with_the_way_out(processes):
    made = cell("""
class Track:
    def __init__(self, count):
        self.count = count


def follow(x, before):
    return Track(x if before is None else before.count + x)


def count(track):
    return track.count
""")
    cg = ep.CompGraph(
        {"follow": made["follow"], "count": made["count"]},
        {"follow": (("x", "before"), "track"), "count": ("track", "n")},
    )
    runner = ep.CompGraphRunner(ep.delay(cg, "track", "before"))
    assert [outcome.values["n"] for outcome in ep.map(runner, [1, 2, 3])] == [1, 3, 6]
    with pytest.raises((ScaleError, PromotionRefused), match="Track"):
        ep.map(runner, [1, 2, 3], processes)


# -- videos -----------------------------------------------------------------------------------------------------


@pytest.fixture
def make_video(tmp_path):
    """Write a grey video of these levels, losslessly."""

    def make(name, levels):
        writer = cv2.VideoWriter(str(tmp_path / name), cv2.VideoWriter_fourcc(*"FFV1"), 25, (64, 48))
        for level in levels:
            writer.write(np.full((48, 64, 3), level, np.uint8))
        writer.release()
        return tmp_path / name

    return make


def test_each_video_is_a_series_of_its_own(runner, make_video, executor):
    videos = [make_video("a.mkv", (8, 4, 2, 6)), make_video("b.mkv", (9, 5, 3, 7))]
    assert values(ep.map(runner, videos[0], executor)) == by_hand((8, 4, 2, 6))
    result = ep.map(runner, videos, executor)
    assert values(result) == by_hand((8, 4, 2, 6)) + by_hand((9, 5, 3, 7))
    assert result.to_frame()["series"].nunique() == 2
    one = ep.map(runner, videos, executor, series=lambda frame: "all")
    assert values(one) == by_hand((8, 4, 2, 6, 9, 5, 3, 7))


def test_a_video_is_one_case(runner, make_video, executor):
    path = make_video("a.mkv", (8, 4, 2))
    cases = [ep.Case(path, {"y": 4.0}), ep.Case(ep.video(path)[:2], {"y": 6.0}), ep.Case({"x": path}, {"y": 5.0})]
    assert list(ep.check(runner, cases, executor).cases.values()) == [True, True, False]
    assert ep.optimize(runner, "y", path, 1, ranges={"k": [0.5]}, executor=executor).best_value == 4.0


def test_a_video_whose_results_are_stored_is_not_run_again(make_video, tmp_path):
    runner = smoothing()
    path = make_video("a.mkv", (8, 4, 2))
    first = ep.map(runner, path, store=tmp_path / "r.sqlite")
    assert list(ep.map(runner, path, store=tmp_path / "r.sqlite")) == list(first)
