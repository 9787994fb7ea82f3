"""Folders for what the tested commands write."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def apart(own_folders):
    """Every command of these tests has folders of its own."""
