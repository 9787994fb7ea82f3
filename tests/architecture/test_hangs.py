"""A test that hangs is reported with its native stack, and ended."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

# A call of the C library keeps the interpreter's lock: neither a signal handler nor a thread of Python runs.
HANGING = """
import ctypes

def test_that_hangs():
    library, mutex = ctypes.PyDLL(None), ctypes.create_string_buffer(64)
    library.pthread_mutex_lock(mutex)
    library.pthread_mutex_lock(mutex)
"""


@pytest.mark.slow
def test_a_test_that_never_gives_up_the_interpreter_lock_is_reported_and_fails(tmp_path):
    (tmp_path / "test_hanging.py").write_text(HANGING)
    (tmp_path / "conftest.py").write_text("from tests.hangs import *")
    plugins = ("-p", "xdist", "-p", "pytest_timeout")
    limits = ("-o", "faulthandler_timeout=1", "-o", "timeout=2", "-o", f"pythonpath={ROOT}")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *plugins, "-n", "1", *limits, "--rootdir", str(tmp_path), str(tmp_path)],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
        timeout=120,
        check=False,
    )
    assert done.returncode not in (0, 5)
    assert "test_that_hangs has not ended after 1 s: the stacks of process" in done.stderr
    assert "pthread_mutex_lock" in done.stderr, "the native frame, from py-spy"
    assert "Aborting process" in done.stderr
