"""Where do the commands that the tests run keep what they write?"""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def apart(own_folders):
    """Every command of these tests has folders of its own."""
