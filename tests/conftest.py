"""Graphs and images that many tests share, the environment of what they start, and how the tests are distributed."""

from __future__ import annotations

import os
import signal
import subprocess

import cv2
import hypothesis
import numpy as np
import pytest
from skimage import data
from xdist.scheduler import LoadFileScheduling

import epypes as ep
from epypes.bundle.proof import replay_process
from epypes.cli import main
from tests import hangs
from tests.brokers.fixtures import broker, certificates, mosquitto, nats, rabbitmq
from tests.brokers.nats import is_installed
from tests.browser.conftest import theme_of
from tests.replays import WarmProcesses

__all__ = ["broker", "certificates", "mosquitto", "nats", "rabbitmq"]

# Dask reads it when it is imported: a worker that is started again is a fork of a process that has Dask loaded.
os.environ.setdefault("DASK_DISTRIBUTED__WORKER__MULTIPROCESSING_METHOD", "forkserver")
# What is started in the background of a shell ignores Ctrl+C, and so would all that tests start and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

# `make soak` asks for far more examples; tests that search at random are marked "fuzz" and don't set their number.
hypothesis.settings.register_profile("quick", max_examples=100, stateful_step_count=20, deadline=None)
hypothesis.settings.register_profile("soak", parent=hypothesis.settings.get_profile("quick"), max_examples=2_000)
hypothesis.settings.load_profile("soak" if "EPYPES_SOAK" in os.environ else "quick")


def pytest_configure(config):
    config.pluginmanager.register(hangs)


# One RabbitMQ for all of them: each start takes five seconds of processor time.
_WITH_RABBITMQ = (
    "tests/brokers/test_pipelines.py",
    "tests/service/test_replica_processes.py",
    "tests/service/test_replicas.py",
    "tests/transport/test_amqp.py",
    "tests/transport/test_channels.py",
)


class _Scheduling(LoadFileScheduling):
    """Tests of one file share what they begin with; those of the browser share JupyterLab, in two groups of files."""

    def _split_scope(self, nodeid):
        file = super()._split_scope(nodeid)
        if file in _WITH_RABBITMQ:
            return "tests with RabbitMQ"
        return f"tests/browser, {theme_of(file)}" if file.startswith("tests/browser/") else file


def pytest_xdist_make_scheduler(config, log):
    return _Scheduling(config, log)


def pytest_collection_modifyitems(items):
    """Where there is no broker, the tutorial on brokers says that in place of the outputs that are saved in it."""
    if not is_installed():
        reason = "nats is not installed on this machine: sh .ci/packages"
        for item in items:
            if item.path.name == "09_beyond_one_machine.ipynb":
                item.add_marker(pytest.mark.skip(reason=reason))


def grayscale(im):
    return cv2.cvtColor(im, cv2.COLOR_BGR2GRAY)


def blur(img, k):
    return cv2.GaussianBlur(img, (k, k), 0)


EDGE_FUNCTIONS = {"grayscale": grayscale, "blur": blur, "canny": cv2.Canny}
EDGE_IO = {
    "grayscale": ("image", "image_gray"),
    "blur": (("image_gray", "blur_kernel"), "image_blurred"),
    "canny": (("image_blurred", "canny_lo", "canny_hi"), "edges"),
}
EDGE_HPARAMS = {"blur_kernel": 11, "canny_lo": 70, "canny_hi": 200}


@pytest.fixture
def edge_graph() -> ep.CompGraph:
    return ep.CompGraph(EDGE_FUNCTIONS, EDGE_IO)


@pytest.fixture
def edge_runner(edge_graph) -> ep.CompGraphRunner:
    return ep.CompGraphRunner(edge_graph, EDGE_HPARAMS)


@pytest.fixture(scope="session")
def photograph() -> np.ndarray:
    """A real photograph, (400, 600, 3) BGR, uint8."""
    return cv2.cvtColor(data.coffee(), cv2.COLOR_RGB2BGR)


@pytest.fixture(scope="session")
def straight_edges(photograph) -> np.ndarray:
    """The edges as straight-line OpenCV computes them."""
    gray = cv2.cvtColor(photograph, cv2.COLOR_BGR2GRAY)
    return cv2.Canny(cv2.GaussianBlur(gray, (11, 11), 0), 70, 200)


@pytest.fixture(scope="session", autouse=True)
def warm_replays():
    """Replays are forks of a process that has NumPy and EPypes loaded, but for those of `fresh_interpreter`."""
    processes = WarmProcesses()
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(replay_process, "subprocess", processes)
        yield processes
    processes.close()


@pytest.fixture
def fresh_interpreter(warm_replays, monkeypatch):
    """Replays start an interpreter, as they do for users."""
    monkeypatch.setattr(warm_replays, "is_on", False)


@pytest.fixture
def own_folders(tmp_path_factory, monkeypatch):
    """State files, failures and settings of a test stand apart from those of the user's services."""
    for name in ("XDG_RUNTIME_DIR", "XDG_STATE_HOME", "XDG_CONFIG_HOME"):
        monkeypatch.setenv(name, str(tmp_path_factory.mktemp(name)))


@pytest.fixture
def epypes(capsys):
    """Run a command in this process, as far as its exit."""

    def run(*arguments):
        with pytest.raises(SystemExit) as stop:
            main(list(map(str, arguments)))
        said, code = capsys.readouterr(), stop.value.code
        if isinstance(code, str):  # as the interpreter does at its end
            return subprocess.CompletedProcess(arguments, 1, said.out, said.err + code + "\n")
        return subprocess.CompletedProcess(arguments, code or 0, said.out, said.err)

    return run
