"""Databases for the tests of stores: a SQLite file and a real PostgreSQL."""

from __future__ import annotations

from itertools import count

import pytest

from epypes.store import Store
from tests.store.postgres import server

_numbers = count(1)


@pytest.fixture(scope="session")
def postgres():
    with server() as made:
        yield made


@pytest.fixture(params=["sqlite", pytest.param("postgres", marks=pytest.mark.slow)])
def place(request, tmp_path):
    """An empty database, as it is given to a Store."""
    if request.param == "sqlite":
        return str(tmp_path / "results.sqlite")
    return request.getfixturevalue("postgres").url(f"test_{next(_numbers)}")


@pytest.fixture
def store(place):
    with Store(place) as made:
        yield made
