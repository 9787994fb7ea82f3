"""What does ``print()`` write of a plan, and of the times of one run and of many?"""

from __future__ import annotations

from epypes.display.paint.rows import Tabular, table_of
from epypes.display.paint.text import repr_text, text_table
from epypes.display.previews.short import reason


def to_text(shown: Tabular) -> str:
    """Return a plan, a report, reports or their summary as an aligned table of text; never raises."""
    try:
        return text_table(table_of(shown))
    except Exception as error:
        return f"{repr_text(shown)}\n(no table: {reason(error)})"
