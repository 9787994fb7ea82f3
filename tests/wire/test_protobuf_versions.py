"""All supported versions of protobuf make the same bytes and read those of the others."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.wire import exchange

pytestmark = pytest.mark.packaging

ROOT = Path(__file__).parents[2]
VERSIONS = ["4.25", "5.29", "6", "7"]
# The texts of uv; any other error is a failure of the test.
NO_WHEEL = ("has no usable wheels", "has no wheels with a matching Python")


@pytest.fixture(scope="module")
def environment(request, tmp_path_factory):
    """An environment with one version of protobuf, numpy, and nothing else."""
    folder = tmp_path_factory.mktemp(f"protobuf-{request.param}")
    python = folder / "bin" / "python"
    uv = [sys.executable, "-m", "uv"]
    subprocess.run([*uv, "venv", "--quiet", "--python", sys.executable, str(folder)], check=True)
    packages = ["numpy", f"protobuf=={request.param}.*"]
    install = [*uv, "pip", "install", "--quiet", "--only-binary", ":all:", "--python", str(python), *packages]
    done = subprocess.run(install, capture_output=True, text=True, check=False)
    if any(words in done.stderr for words in NO_WHEEL):
        pytest.skip(f"protobuf {request.param} has no wheel for this Python")
    assert done.returncode == 0, done.stderr
    return request.param, python


FIRST, *BETWEEN, LAST = VERSIONS
# Of the implementation in Python, the oldest and the newest.
TRIED = [
    *((version, "upb", "users first") for version in VERSIONS),
    *((version, "python", "ours first") for version in (FIRST, LAST)),
]
AS_WELL = [
    *((version, "python", "ours first") for version in BETWEEN),
    *((version, *how) for version in VERSIONS for how in (("upb", "ours first"), ("python", "users first"))),
]


@pytest.mark.parametrize(
    ("environment", "made_by", "order"),
    [*TRIED, *(pytest.param(*each, marks=pytest.mark.soak) for each in AS_WELL)],
    indirect=["environment"],
)
def test_a_version_makes_the_same_bytes_and_understands_those_of_this_one(environment, made_by, order):
    version, python = environment
    variables = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "PROTOCOL_BUFFERS_PYTHON_IMPLEMENTATION": made_by,
    }
    ours = exchange.made()
    done = subprocess.run(
        [str(python), "-W", "error", "-m", "tests.wire.exchange", order],
        input=json.dumps(ours),
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
        env=variables,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    theirs = json.loads(done.stdout)
    assert theirs["protobuf"].startswith(f"{version}.")
    assert theirs["made_by"] == made_by
    assert theirs["made"] == ours
    assert theirs["refusals"] == exchange.refusals()
