"""Does the picture follow the hand, in JupyterLab, in a real browser?"""

from __future__ import annotations

from tests.benchmarks.row import Row
from tests.benchmarks.timing import Effort
from tests.browser.jupyter import browser_path


def missing() -> str:
    """Return why it can't be measured here; nothing if it can."""
    try:
        browser_path()
    except RuntimeError as error:
        return str(error)
    return ""


def rows(effort: Effort) -> list[Row]:
    from tests.benchmarks.tuning import hover
    from tests.benchmarks.tuning.goals import compared
    from tests.benchmarks.tuning.session import measured

    if missing():
        return []
    return [*compared(measured(effort)), hover.row(effort)]
