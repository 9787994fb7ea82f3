"""Fixtures of the brokers: a test gets one by naming it.

Each broker is started when a test first needs it, and is shared by all tests of the process. A test that ends a broker
starts it again.
"""

from __future__ import annotations

import importlib
import subprocess
import tempfile
from pathlib import Path

import pytest

NAMES = ("rabbitmq", "nats", "mosquitto")


def running(name, **options):
    """Start a broker for the time of a fixture, or skip where it is not installed."""
    module = importlib.import_module(f"tests.brokers.{name}")
    if not module.is_installed():
        pytest.skip(f"{name} is not installed on this machine: sh .ci/packages")
    with module.server(**options) as made:
        yield made


@pytest.fixture(scope="session")
def certificates():
    """A folder with a certificate for 127.0.0.1 that is its own authority: ca.pem, cert.pem and key.pem."""
    # Not in pytest's folder, which the accounts of the brokers may not enter.
    with tempfile.TemporaryDirectory(prefix="epypes-certificates-") as made:
        folder = Path(made)
        folder.chmod(0o755)
        command = (
            "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2 -subj /CN=127.0.0.1"
        )
        more = "-addext subjectAltName=IP:127.0.0.1 -keyout key.pem -out cert.pem"
        subprocess.run([*command.split(), *more.split()], cwd=folder, check=True, capture_output=True, timeout=60)
        (folder / "ca.pem").write_bytes((folder / "cert.pem").read_bytes())
        for file in folder.iterdir():
            file.chmod(0o644)
        yield folder


@pytest.fixture(scope="session")
def rabbitmq(certificates):
    """A RabbitMQ server, which also listens with encryption."""
    yield from running("rabbitmq", certificates=certificates)


@pytest.fixture(scope="session")
def nats():
    """A NATS server with JetStream."""
    yield from running("nats")


@pytest.fixture(scope="session")
def mosquitto():
    """An MQTT 5 server."""
    yield from running("mosquitto")


@pytest.fixture(params=[pytest.param(name, marks=pytest.mark.slow) for name in NAMES])
def broker(request):
    """Each of them in turn."""
    return request.getfixturevalue(request.param)
