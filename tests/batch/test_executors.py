"""Jobs on threads, processes and a pool that breaks: the same results, and bounded ends."""

from __future__ import annotations

import enum
import importlib
import io
import multiprocessing
import os
import pickle
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.batch.executors import run_jobs, worker_count
from epypes.batch.items import items_of
from epypes.batch.job import Job, SharedStart
from epypes.batch.packaged_graph import packed_job
from epypes.errors import ExecutorBroken, PromotionRefused, ScaleError
from tests.bundle.cells import cell

_WAIT_S = 60.0


def spawn():
    return multiprocessing.get_context("spawn")


def without_times(result):
    return [replace(outcome, times_ns=dict.fromkeys(outcome.times_ns), total_ns=0, kept={}) for outcome in result]


def mixed(crops, folder):
    """Images, a file, one that is not there, and one that a function fails on."""
    return [*crops[:5], folder / "crop7.png", "nowhere.png", crops[0][..., 0], *crops[8:]]


@pytest.fixture(scope="module")
def forked():
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("fork")) as pool:
        yield pool


@pytest.mark.slow
@pytest.mark.parametrize("who", ["threads", "processes", "forked"])
def test_results_are_the_same_on_every_executor(who, runner, crops, folder, request):
    expected = ep.map(runner, mixed(crops, folder), keep=["edges", "keypoints"])
    if who == "threads":
        with ThreadPoolExecutor(3) as pool:
            found = ep.map(runner, mixed(crops, folder), pool, keep=["edges", "keypoints"])
    else:
        pool = request.getfixturevalue(who)
        found = ep.map(runner, mixed(crops, folder), pool, keep=["edges", "keypoints"])
    assert len(expected.failures) == 2
    assert without_times(found) == without_times(expected)
    for one, other in zip(found, expected, strict=True):
        assert np.array_equal(one.kept.get("edges"), other.kept.get("edges"))
        assert [point.pt for point in one.kept.get("keypoints", ())] == [p.pt for p in other.kept.get("keypoints", ())]
        assert all(not value.flags.writeable for token, value in one.kept.items() if token == "edges")


def test_settings_are_the_same_in_this_thread_and_in_processes(runner, crops, processes):
    settings = tuple({"canny_lo": low} for low in (10, 60, 120))
    jobs = [Job(item, settings) for item in items_of(crops[:3], runner)]
    expected = [outcome for outcomes in run_jobs(runner, jobs) for outcome in outcomes]
    found = [outcome for outcomes in run_jobs(runner, jobs, processes) for outcome in outcomes]
    found.sort(key=lambda outcome: (outcome.number, outcome.setting["canny_lo"]))
    assert without_times(found) == without_times(expected)
    assert len({outcome.values["edge_pixels"] for outcome in found}) == 9


def test_where_a_job_starts_stays_in_this_process(runner, crops, processes):
    (item,) = items_of(crops[:1], runner)
    jobs = [Job(item, ({"canny_lo": low},), start=start) for start in [SharedStart()] for low in (10, 60)]

    def pixels(executor):
        outcomes = [outcome for outcomes in run_jobs(runner, jobs, executor) for outcome in outcomes]
        return {outcome.setting["canny_lo"]: outcome.values["edge_pixels"] for outcome in outcomes}

    assert pixels(processes) == pixels(None)
    assert packed_job(jobs[0]).start is None
    assert jobs[0].start is not None


@pytest.mark.slow
def test_members_of_the_notebooks_enumerations_travel(processes, crops):
    made = cell(
        """
    import enum


    class Side(enum.Enum):
        LEFT = 0
        RIGHT = 1


    def half(image, side):
        middle = image.shape[1] // 2
        return float((image[:, :middle] if side is Side.LEFT else image[:, middle:]).mean())
    """.replace("\n    ", "\n")
    )
    cg = ep.CompGraph({"half": made["half"]}, {"half": (("image", "side"), "brightness")})
    runner = ep.CompGraphRunner(cg, {"side": made["Side"].LEFT})
    assert issubclass(made["Side"], enum.Enum)
    (item,) = items_of(crops[:1], runner)
    job = Job(item, ({}, {"side": made["Side"].RIGHT}))
    ((left, right),) = run_jobs(runner, [job], processes)
    assert left.values["brightness"] == float(crops[0][:, :75].mean())
    assert right.values["brightness"] == float(crops[0][:, 75:].mean())
    assert right.setting == {"side": made["Side"].RIGHT}


def test_other_hyperparameters_need_no_other_bundle(runner, crops, processes, monkeypatch):
    ep.map(runner, crops[:2], processes)
    monkeypatch.setattr("epypes.batch.packaged_graph.promote", None)
    runner["canny_lo"] = 10
    assert without_times(ep.map(runner, crops[:2], processes)) == without_times(ep.map(runner, crops[:2]))


class Careful(Executor):
    """An executor that pickles all that goes to the processes, as they do, and keeps it."""

    def __init__(self, executor):
        self._executor, self.sent = executor, []

    def submit(self, fn, /, *args, **kwargs):
        self.sent.append(pickle.dumps((fn, args)))
        return self._executor.submit(fn, *args, **kwargs)


def test_no_function_of_the_notebook_is_ever_pickled(runner, crops, processes):
    careful = Careful(processes)
    result = ep.map(runner, crops, careful)
    assert not result.failures
    # By pickle they can't be: __main__ has no such function. What was sent names no module but these.
    with pytest.raises((pickle.PicklingError, AttributeError)):
        pickle.dumps(runner.cg.functions["gray"])
    allowed = ("epypes.batch.", "numpy", "pathlib", "builtins", "_codecs", "uuid")

    class Looking(pickle.Unpickler):
        def find_class(self, module, name):
            assert module.startswith(allowed), (module, name)
            return super().find_class(module, name)

    for sent in careful.sent:
        Looking(io.BytesIO(sent)).load()


@pytest.mark.slow
def test_a_large_bundle_is_sent_only_to_workers_that_ask_for_it(processes):
    made = cell(
        "import numpy as np\nTABLE = np.arange(40_000.0)\n\ndef look_up(image):\n    return float(TABLE[image].sum())"
    )
    runner = ep.CompGraphRunner(ep.CompGraph({"look_up": made["look_up"]}, {"look_up": ("image", "total")}))
    careful = Careful(processes)
    result = ep.map(runner, [np.array([number]) for number in range(20)], careful)
    assert [outcome.values["total"] for outcome in result] == [float(number) for number in range(20)]
    sizes = sorted(map(len, careful.sent))
    assert sizes[0] < 5_000
    assert sizes[-1] > 320_000


def test_a_set_of_which_nothing_can_be_run_gives_failures_as_well(runner, processes):
    result = ep.map(runner, ["nowhere.png", "neither.png"], processes)
    assert [outcome.error_info.kind for outcome in result] == ["ImageFileError", "ImageFileError"]


def test_a_graph_that_can_not_be_promoted_is_refused_with_the_reasons(crops, processes):
    lock = threading.Lock()

    def held(image):
        with lock:
            return 1

    runner = ep.CompGraphRunner(ep.CompGraph({"held": held}, {"held": ("image", "out")}))
    with pytest.raises(PromotionRefused, match="'held'") as refused:
        ep.map(runner, crops, processes)
    assert refused.value.__notes__ == [
        "Other processes run a graph as a bundle, never pickled: use a ThreadPoolExecutor, which runs it as it is, "
        "or no executor if a function keeps something from one item to the next."
    ]


@pytest.mark.slow
def test_a_module_next_to_the_notebook_goes_along_to_other_processes(processes, tmp_path, monkeypatch):
    (tmp_path / "beside_the_notebook.py").write_text("def half(image):\n    return int(image[0, 0]) // 2\n")
    monkeypatch.syspath_prepend(tmp_path)
    half = importlib.import_module("beside_the_notebook").half
    runner = ep.CompGraphRunner(ep.CompGraph({"half": half}, {"half": ("image", "out")}))
    found = ep.map(runner, [np.full((5, 5), value, np.uint8) for value in (4, 9)], processes)
    assert [outcome.values["out"] for outcome in found] == [2, 4]


@pytest.mark.slow
def test_a_function_that_keeps_something_is_refused_with_the_way_out(crops, processes):
    apply = cv2.createBackgroundSubtractorMOG2().apply
    runner = ep.CompGraphRunner(ep.CompGraph({"apply": apply}, {"apply": ("image", "mask")}))
    with pytest.raises(PromotionRefused, match="is a method of an object of class") as refused:
        ep.map(runner, crops, processes)
    assert "no executor if a function keeps something from one item to the next" in refused.value.__notes__[0]


@pytest.mark.slow
def test_a_kept_value_without_a_codec_is_refused_with_the_way_out(processes):
    made = cell("class Plain:\n    pass\n\ndef make(image):\n    return Plain()\n\ndef use(plain):\n    return 1")
    cg = ep.CompGraph({"make": made["make"], "use": made["use"]}, {"make": ("image", "plain"), "use": ("plain", "n")})
    with pytest.raises(ScaleError, match=r"Token 'plain' can't travel .* Use a ThreadPoolExecutor"):
        ep.map(ep.CompGraphRunner(cg), [1, 2], processes, keep=["plain"])


# -- workers that can't -----------------------------------------------------------------------------------------


def have_no_opencv():
    sys.modules["cv2"] = None


def have_no_place():
    tempfile.tempdir = "/nowhere"


@pytest.mark.slow
def test_a_worker_that_lacks_a_package_raises_with_the_way_out(runner, crops):
    with (
        ProcessPoolExecutor(1, mp_context=spawn(), initializer=have_no_opencv) as pool,
        pytest.raises(
            ScaleError, match=r"can't load the graph: ModuleNotFoundError.*cv2.*Install there .*opencv"
        ) as told,
    ):
        ep.map(runner, crops, pool)
    assert str(os.getpid()) not in str(told.value)


@pytest.mark.slow
def test_a_worker_that_can_not_unpack_the_bundle_raises(runner, crops):
    with (
        ProcessPoolExecutor(1, mp_context=spawn(), initializer=have_no_place) as pool,
        pytest.raises(ScaleError, match=r"can't load the graph: FileNotFoundError"),
    ):
        ep.map(runner, crops, pool)


MORTAL = """
import os
import signal


def weigh(image, notebook):
    if int(image[0, 0]) == 7 and os.getpid() != notebook:
        os.kill(os.getpid(), signal.SIGKILL)
    return int(image[0, 0])
"""


def mortal_runner():
    """A graph whose function kills every process but this one when the image begins with 7."""
    made = cell(MORTAL)
    cg = ep.CompGraph({"weigh": made["weigh"]}, {"weigh": (("image", "notebook"), "level")})
    return ep.CompGraphRunner(cg, {"notebook": os.getpid()})


@pytest.mark.slow
def test_a_pool_whose_worker_dies_says_how_many_were_done_and_a_store_lets_it_go_on(tmp_path):
    runner, images = mortal_runner(), [np.full((2, 2), level) for level in (0, 1, 2, 3, 7, 4, 5)]
    store = tmp_path / "r.sqlite"
    with (
        ProcessPoolExecutor(1, mp_context=spawn()) as pool,
        pytest.raises(ExecutorBroken, match="The executor broke after .* with store=") as told,
    ):
        ep.map(runner, images, pool, store=store, name="levels", ahead=1)
    assert 1 <= told.value.done <= 4
    with ep.Store(store) as opened:
        assert len(opened.series("map", "levels")) == told.value.done
    # Here it does not die.
    assert [outcome.values["level"] for outcome in ep.map(runner, images, store=store, name="levels")] == [
        0,
        1,
        2,
        3,
        7,
        4,
        5,
    ]


@pytest.mark.parametrize("kind", [ThreadPoolExecutor, ProcessPoolExecutor])
def test_a_pool_that_was_shut_down_raises_with_the_way_out(kind, runner, crops):
    pool = kind(1)
    pool.shutdown()
    with pytest.raises(ExecutorBroken, match=r"takes no jobs after 0 outcomes: it was shut down.*Make a new") as told:
        ep.map(runner, crops, pool)
    assert told.value.done == 0
    assert "RuntimeError: cannot schedule new futures" in str(told.value)


def test_a_pool_that_is_shut_down_half_way_says_how_many_were_done(runner, crops):
    pool = ThreadPoolExecutor(1)

    def images():
        yield from crops[:6]
        pool.shutdown(wait=False)
        yield from crops[6:]

    with pytest.raises(ExecutorBroken, match=r"takes no jobs after \d outcomes?: it was shut down") as told:
        ep.map(runner, images(), pool, ahead=1)
    assert 1 <= told.value.done <= 6


# -- stopping ---------------------------------------------------------------------------------------------------


class Gate:
    """A function that waits, with all but the first item, until it is let through."""

    def __init__(self):
        self.reached, self.opened, self.calls = threading.Event(), threading.Event(), 0

    def runner(self):
        def wait(image):
            self.calls += 1
            if image:
                self.reached.set()
                self.opened.wait(_WAIT_S)
            return int(image)

        return ep.CompGraphRunner(ep.CompGraph({"wait": wait}, {"wait": ("image", "out")}))


def many_jobs(runner) -> Iterator[Job]:
    for item in items_of(iter(range(1000)), runner):
        yield Job(item)


def test_a_stop_ends_it_and_leaves_nothing_queued():
    gate, stop = Gate(), threading.Event()
    runner = gate.runner()
    with ThreadPoolExecutor(2) as pool:
        outcomes = run_jobs(runner, many_jobs(runner), pool, stop=stop, ahead=100)
        found: Future[list] = Future()
        reader = threading.Thread(target=lambda: found.set_result([one for some in outcomes for one in some]))
        reader.start()
        assert gate.reached.wait(_WAIT_S)
        stop.set()
        gate.opened.set()
        assert 2 <= len(found.result(_WAIT_S)) <= 3
        reader.join(_WAIT_S)
        assert pool.submit(lambda: "free").result(_WAIT_S) == "free"
    assert gate.calls <= 3


def test_a_stop_in_this_thread_ends_after_the_item():
    stop = threading.Event()

    def note(image):
        if image == 2:
            stop.set()
        return int(image)

    runner = ep.CompGraphRunner(ep.CompGraph({"note": note}, {"note": ("image", "out")}))
    found = run_jobs(runner, (Job(item) for item in items_of(range(10), runner)), stop=stop)
    assert [outcome.values["out"] for outcomes in found for outcome in outcomes] == [0, 1, 2]


def test_closing_the_outcomes_leaves_nothing_queued():
    gate = Gate()
    runner = gate.runner()
    with ThreadPoolExecutor(2) as pool:
        outcomes = run_jobs(runner, many_jobs(runner), pool, ahead=100)
        next(outcomes)
        outcomes.close()
        gate.opened.set()
        pool.submit(lambda: None).result(_WAIT_S)
    assert gate.calls <= 3


def test_an_interruption_leaves_nothing_queued():
    gate = Gate()
    runner = gate.runner()
    main, filled = threading.main_thread().ident, threading.Event()

    def images():
        for number in range(100_000):
            yield number
            if number == 90:
                filled.set()

    def interrupt():
        filled.wait(_WAIT_S)
        signal.pthread_kill(main, signal.SIGINT)

    killer = threading.Thread(target=interrupt)
    with ThreadPoolExecutor(2) as pool:
        killer.start()
        with pytest.raises(KeyboardInterrupt):
            ep.map(runner, images(), pool, ahead=100)
        killer.join(_WAIT_S)
        gate.opened.set()
        pool.submit(lambda: None).result(_WAIT_S)
    assert gate.calls <= 40


def test_no_more_jobs_are_in_flight_than_may_be():
    taken = []

    def jobs(runner):
        for job in many_jobs(runner):
            taken.append(job)
            yield job

    gate = Gate()
    gate.opened.set()
    runner = gate.runner()
    with ThreadPoolExecutor(2) as pool:
        outcomes = run_jobs(runner, jobs(runner), pool, ahead=3)
        assert taken == []
        next(outcomes)
        assert len(taken) == 3
        outcomes.close()


def test_what_is_no_executor_is_refused_at_once(runner):
    with pytest.raises(TypeError, match="executor must be a concurrent.futures.Executor, not 'int'"):
        run_jobs(runner, [], 2)


def test_so_many_jobs_ahead_as_there_can_not_be_are_refused_at_once(runner):
    with pytest.raises(ValueError, match="1 or more, not 0"):
        run_jobs(runner, [], ahead=0)


def test_workers_are_counted(processes):
    with ThreadPoolExecutor(3) as pool:
        assert worker_count(pool) == 3
    assert worker_count(processes) == 2
    assert worker_count(Careful(processes)) == os.cpu_count()


@pytest.mark.slow
def test_the_threads_of_opencv_work_in_a_pool_that_forks(forked, crops):
    large = [cv2.resize(crop, (600, 600)) for crop in crops[:2]]
    cg = ep.CompGraph({"blur": cv2.medianBlur}, {"blur": (("image", "k"), "out")})
    runner = ep.CompGraphRunner(cg, {"k": 7})
    runner.run(image=large[0])
    (first, second) = ep.map(runner, large, forked, keep=["out"])
    assert np.array_equal(first.kept["out"], cv2.medianBlur(large[0], 7))
    assert np.array_equal(second.kept["out"], cv2.medianBlur(large[1], 7))
