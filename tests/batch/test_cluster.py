"""A Dask cluster gives the same results, also when its workers die."""

from __future__ import annotations

import logging
import os
import signal
import socket
import threading
from dataclasses import replace

import dask
import numpy as np
import pytest
from distributed import Client, LocalCluster

import epypes as ep
from epypes.batch.executors import worker_count
from epypes.errors import ExecutorBroken
from tests.batch.test_executors import mixed, mortal_runner, without_times
from tests.bundle.cells import cell

pytestmark = pytest.mark.slow

_WAIT_S = 120.0


@pytest.fixture(scope="module")
def client():
    """A cluster of two worker processes; what kills three of them is given up."""
    with (
        dask.config.set(
            {
                "distributed.scheduler.allowed-failures": 1,
                # On a machine that is busy with other tests a worker takes its time to begin.
                "distributed.comm.timeouts.connect": "120s",
            }
        ),
        LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            host="127.0.0.1",
            # Without an address it listens on port 8787 all the same, and warns if another cluster does so already.
            dashboard_address="127.0.0.1:0",
            scheduler_kwargs={"dashboard": False},
            silence_logs=logging.CRITICAL,
        ) as cluster,
        Client(cluster) as made,
    ):
        yield made


def test_a_client_that_was_closed_raises_with_the_way_out(client, runner, crops):
    with Client(client.scheduler.address) as other:
        executor = other.get_executor()
        assert worker_count(executor) == 2
    with pytest.raises(ExecutorBroken, match=r"takes no jobs .* Make a new one") as told:
        ep.map(runner, crops, executor)
    assert told.value.done == 0


def test_a_cluster_gives_what_this_thread_gives(client, runner, crops, folder):
    expected = ep.map(runner, mixed(crops, folder), keep=["keypoints"])
    executor = client.get_executor()
    assert worker_count(executor) == 2
    found = ep.map(runner, mixed(crops, folder), executor, keep=["keypoints"])
    assert without_times(found) == without_times(expected)
    again = ep.map(runner, mixed(crops, folder), executor, keep=["keypoints"])
    assert without_times(again) == without_times(expected)


def test_a_cluster_reads_files_itself(client, runner, folder):
    expected, found = ep.map(runner, folder), ep.map(runner, folder, client.get_executor())
    assert without_times(found) == without_times(expected)
    assert [outcome.name for outcome in found] == [f"crop{number}.png" for number in range(12)]


HELD = """
import os
import socket


def weigh(image, port):
    level = int(image[0, 0])
    if port:
        with socket.create_connection(("127.0.0.1", port)) as line:
            line.send(str(os.getpid()).encode())
            # Until this worker is killed, or may go on.
            line.recv(1)
    return level * level
"""


def test_a_worker_killed_half_way_loses_nothing_and_nothing_comes_twice(client):
    made = cell(HELD)
    cg = ep.CompGraph({"weigh": made["weigh"]}, {"weigh": (("image", "port"), "weight")})
    runner = ep.CompGraphRunner(cg)
    came = []

    def kill_the_first():
        while True:
            line, _ = server.accept()
            with line:
                process = int(line.recv(20) or 0)
                if not process:
                    return
                came.append(process)
                if len(came) == 1:
                    os.kill(process, signal.SIGKILL)
                else:
                    line.send(b".")

    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        images = [{"image": np.full((2, 2), n), "port": port if n == 20 else 0} for n in range(40)]
        killer = threading.Thread(target=kill_the_first)
        killer.start()
        try:
            result = ep.map(runner, images, client.get_executor())
            expected = ep.map(runner, images)
        finally:
            socket.create_connection(("127.0.0.1", port)).close()
            killer.join(_WAIT_S)
    killed, second, last = came
    assert last == os.getpid()
    assert last not in (killed, second)
    assert killed != second
    assert [outcome.number for outcome in result] == list(range(40))
    assert [outcome.values["weight"] for outcome in result] == [level * level for level in range(40)]
    assert without_times(result) == without_times(expected)


def test_an_image_that_kills_every_worker_is_a_row_that_says_so(client):
    runner, levels = mortal_runner(), (0, 1, 2, 7, 3)
    result = ep.map(runner, [np.full((2, 2), level) for level in levels], client.get_executor())
    assert [outcome.values.get("level") for outcome in result] == [0, 1, 2, None, 3]
    (failure,) = result.failures
    assert str(failure.error_info) == "KilledWorker: every worker that ran it died"
    assert replace(failure, error_info=None).values == {}


def test_a_series_keeps_its_order_and_its_state_on_the_cluster(client):
    made = cell("def add(x, before):\n    return before + x\n")
    runner = ep.CompGraphRunner(
        ep.delay(ep.CompGraph({"add": made["add"]}, {"add": (("x", "before"), "total")}), "total", "before", 0)
    )
    keys = ["left", "right"] * 10
    found = ep.map(runner, list(range(20)), client.get_executor(), series=keys)
    assert [outcome.values["total"] for outcome in found] == [sum(range(n % 2, n + 1, 2)) for n in range(20)]
