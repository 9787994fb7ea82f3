"""How does a test get a broker? By naming it: tests/conftest.py knows these.

Each is started when it is first asked for and lives as long as the tests do. Who ends one has to start it again.
"""

from __future__ import annotations

import importlib

import pytest

NAMES = ("rabbitmq", "nats", "mosquitto")


def running(name):
    """Start a broker for the time of a fixture, or skip where it is not installed."""
    module = importlib.import_module(f"tests.brokers.{name}")
    if not module.is_installed():
        pytest.skip(f"{name} is not installed on this machine: sh .ci/brokers")
    with module.server() as made:
        yield made


@pytest.fixture(scope="session")
def rabbitmq():
    """A RabbitMQ server."""
    yield from running("rabbitmq")


@pytest.fixture(scope="session")
def nats():
    """A NATS server with JetStream."""
    yield from running("nats")


@pytest.fixture(scope="session")
def mosquitto():
    """An MQTT 5 server."""
    yield from running("mosquitto")


@pytest.fixture(params=NAMES)
def broker(request):
    """Each of them in turn."""
    return request.getfixturevalue(request.param)
