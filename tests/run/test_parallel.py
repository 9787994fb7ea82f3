from __future__ import annotations

import contextvars
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

import epypes as ep
from epypes.run import execute

# Functions that take time without computing wait for a device that never answers.
WAIT_S = 0.02
device = threading.Event()


@pytest.fixture
def always(monkeypatch):
    """Threads are used wherever functions are independent, without trying whether it is faster."""
    monkeypatch.setattr(execute.Gain, "is_worth_it", lambda self: True)


def fork(count, function):
    """Make a graph of ``count`` functions of x side by side, joined by ``join``."""
    names = [f"f{index}" for index in range(count)]
    functions = dict.fromkeys(names, function) | {"join": lambda *ys: ys}
    return ep.CompGraph(
        functions,
        {name: ("x", f"y_{name}") for name in names} | {"join": (tuple(f"y_{name}" for name in names), "out")},
    )


def test_independent_functions_run_at_once(always):
    barrier = threading.Barrier(3)

    def meet(x):
        barrier.wait(60)  # passes only if three are in it at once
        return threading.get_ident()

    runner = ep.CompGraphRunner(fork(3, meet), workers=3)
    run = runner.run(x=1)
    assert len(set(run["out"])) == 3
    assert threading.get_ident() in run["out"], "the caller's thread works too"
    assert run.report.side_by_side
    assert run.report.ran == ("f0", "f1", "f2", "join"), "the report is in run order"


def test_no_more_functions_run_at_once_than_there_are_workers(always):
    running, most, lock = [0], [0], threading.Lock()
    done = threading.Event()

    def count(x):
        with lock:
            running[0] += 1
            most[0] = max(most[0], running[0])
        done.wait(0.01)
        with lock:
            running[0] -= 1

    ep.CompGraphRunner(fork(8, count), workers=2).run(x=1)
    assert most[0] == 2


def test_of_several_failures_the_first_in_run_order_is_the_one(always):
    release = threading.Event()

    def first(x):
        release.wait(60)
        raise ValueError("first")

    def second(x):
        release.set()
        raise KeyError("second")

    third = lambda x: x  # noqa: E731
    cg = ep.CompGraph(
        {"first": first, "second": second, "third": third},
        {"first": ("x", "a"), "second": ("x", "b"), "third": ("x", "c")},
    )
    runner = ep.CompGraphRunner(cg, workers=3)
    with pytest.raises(ValueError, match="first"):
        runner.run(x=1)
    assert runner.last.failure.function == "first"
    assert set(runner.last) == {"x"}, "what comes after a failure leaves no trace"
    assert runner.last.report.ran == ("first",)


def test_the_users_exception_keeps_its_line_and_its_note(always):
    def fails(x):
        raise ZeroDivisionError("here")

    runner = ep.CompGraphRunner(fork(2, fails), workers=2)
    with pytest.raises(ZeroDivisionError, match="here") as error:
        runner.run(x=7)
    assert error.traceback[-1].name == "fails"
    assert error.value.__notes__ == ["In function 'f0': (x=7) -> (y_f0)"]


def test_runs_in_many_threads_with_workers_do_not_mix(always):
    runner = ep.CompGraphRunner(fork(4, lambda x: x), workers=2)
    wrong = []

    def run(value):
        outs = [runner.run(x=value)["out"] for _ in range(25)]
        wrong.extend(out for out in outs if out != (value,) * 4)

    threads = [threading.Thread(target=run, args=(value,)) for value in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert wrong == []


def test_the_overhead_of_functions_side_by_side_is_wall_time_less_the_critical_path(always):
    barrier = threading.Barrier(2)

    def meet(x):
        barrier.wait(60)
        device.wait(WAIT_S)

    report = ep.CompGraphRunner(fork(2, meet), workers=2).run(x=1).report
    assert report.critical_path_ns >= WAIT_S * 1e9
    assert report.overhead_ns == report.total_ns - report.critical_path_ns
    assert report.overhead_ns > report.total_ns - sum(report.durations_ns.values())


def test_the_context_of_the_caller_goes_along(always):
    setting = contextvars.ContextVar("setting", default="none")
    barrier = threading.Barrier(2)

    def read(x):
        barrier.wait(60)
        return setting.get()

    setting.set("mine")
    assert ep.CompGraphRunner(fork(2, read), workers=2).run(x=1)["out"] == ("mine", "mine")


@pytest.mark.slow
def test_threads_are_tried_where_functions_are_long_and_kept_where_they_are_faster():
    def wait(x):
        device.wait(WAIT_S)  # as a function that releases the interpreter's lock

    runner = ep.CompGraphRunner(fork(2, wait), workers=2)
    for _ in range(8):
        runner.run(x=1)
    assert [report.side_by_side for report in runner.reports] == [False] * 3 + [True] * 5


@pytest.mark.slow
def test_threads_are_given_up_where_they_are_slower():
    lock = threading.Lock()

    def exclusive(x):
        is_alone = lock.acquire(blocking=False)
        # Beside another one it takes much longer than after it.
        device.wait(WAIT_S * (1 if is_alone else 4))
        if is_alone:
            lock.release()

    runner = ep.CompGraphRunner(fork(2, exclusive), workers=2)
    for _ in range(10):
        runner.run(x=1)
    assert [report.side_by_side for report in runner.reports][-4:] == [False] * 4


@pytest.mark.slow
def test_threads_are_tried_when_functions_become_long_later(monkeypatch):
    monkeypatch.setattr(execute, "LOOK_AGAIN_AFTER", 4)

    def wait(seconds):
        device.wait(seconds)

    runner = ep.CompGraphRunner(fork(2, wait), workers=2)
    for seconds in [0] * 10 + [WAIT_S] * 10:
        runner.run(x=seconds)
    assert not any(report.side_by_side for report in runner.reports[:10])
    assert runner.reports[-1].side_by_side


def test_trivial_functions_and_chains_stay_in_the_callers_thread():
    wide = ep.CompGraphRunner(fork(20, lambda x: x), workers=4)
    chain = ep.CompGraphRunner(ep.CompGraph({"f": abs, "g": abs}, {"f": ("x", "y"), "g": ("y", "z")}), workers=4)
    for _ in range(20):
        wide.run(x=1)
        chain.run(x=1)
    assert not any(report.side_by_side for runner in (wide, chain) for report in runner.reports)


@pytest.mark.parametrize("workers", [0, -1, 1.5, True, "2", None])
def test_a_number_of_workers_that_is_none_is_refused(workers):
    with pytest.raises(ValueError, match="workers is how many functions may run at once"):
        ep.CompGraphRunner(fork(2, abs), workers=workers)


def test_the_interpreter_exits_while_a_function_never_returns_on_another_thread():
    code = """
import threading
import epypes as ep
from epypes.run import execute
execute.Gain.is_worth_it = lambda self: True
started = threading.Event()
main = threading.main_thread()
def f(x):
    if threading.current_thread() is main:
        started.wait(60)
        raise KeyboardInterrupt
    started.set()
    threading.Event().wait()
cg = ep.CompGraph({"f": f, "g": f}, {"f": ("x", "a"), "g": ("x", "b")})
runner = ep.CompGraphRunner(cg, workers=2)
try:
    runner.run(x=1)
except KeyboardInterrupt:
    print("interrupted", runner.last.failure.function)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("interrupted")


def waits(thread):
    """Whether a thread waits for others to be done."""
    return sys._current_frames()[thread.ident].f_code.co_name == "wait"


@pytest.mark.parametrize("comes", ["while it waits", "in a function"])
def test_ctrl_c_is_raised_also_if_a_function_has_failed(comes, always):
    main, threads, is_over = threading.current_thread(), [], threading.Event()

    def until(condition):
        end_s = time.monotonic() + 60
        while not condition():
            assert time.monotonic() < end_s

    def f(x):
        here = threading.current_thread()
        threads.append(here)
        until(lambda: len(threads) == 2)
        if here is not main and comes == "while it waits":
            until(lambda: waits(main))
            signal.pthread_kill(main.ident, signal.SIGINT)
            is_over.wait(60)
        elif here is main and comes == "in a function":
            until(lambda: waits(next(one for one in threads if one is not main)))
            raise KeyboardInterrupt
        raise ValueError

    runner = ep.CompGraphRunner(fork(2, f), workers=2)
    with pytest.raises(KeyboardInterrupt):
        runner.run(x=1)
    is_over.set()
    assert isinstance(runner.last.failure.exception, KeyboardInterrupt)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system can't fork")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_a_forked_process_makes_threads_of_its_own(always):
    barrier = threading.Barrier(2)
    runner = ep.CompGraphRunner(fork(2, lambda x: barrier.wait(60)), workers=2)
    runner.run(x=1)
    child = os.fork()
    if not child:
        try:
            runner.run(x=1)
            os._exit(0)
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
