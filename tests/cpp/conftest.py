"""The export to C++ needs NumPy 2."""

import numpy as np
import pytest


@pytest.fixture(scope="session", autouse=True)
def _numpy_2():
    if int(np.__version__.partition(".")[0]) < 2:
        pytest.skip("the export to C++ needs NumPy 2")
