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


@pytest.fixture(scope="module", params=VERSIONS)
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


@pytest.mark.parametrize(
    ("made_by", "order"),
    [
        ("upb", "users first"),
        ("python", "ours first"),
        pytest.param("upb", "ours first", marks=pytest.mark.soak),
        pytest.param("python", "users first", marks=pytest.mark.soak),
    ],
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
