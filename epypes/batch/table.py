"""How do outcomes become the rows of a table?"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from epypes.batch.outcome import Outcome
from epypes.graph import CompGraph
from epypes.optional import optional_import

if TYPE_CHECKING:
    import pandas as pd

_FIXED: Final = ("name", "failure", "total_ms")


def frame_of(
    outcomes: Sequence[Outcome], cg: CompGraph | None = None, extra: Mapping[str, Sequence[Any]] | None = None
) -> pd.DataFrame:
    """Return a table with one row per outcome.

    Parameters
    ----------
    outcomes
        The rows.
    cg
        Gives the order of sink tokens and functions; without, it is the one in which outcomes have them.
    extra
        Columns by name, each with a value per outcome; they stand after ``name``.

    Returns
    -------
    pandas.DataFrame
        ``name``, the extra columns, ``failure`` (None, or what failed), one column per sink token, ``total_ms``, and
        ``"<function> ms"`` of what ran. A token that is called like another column has `` (token)`` after its name.
    """
    columns: dict[str, Sequence[Any]] = {"name": [outcome.name for outcome in outcomes]}
    columns |= {column: none_as_it_is(values) for column, values in (extra or {}).items()}
    columns["failure"] = none_as_it_is(
        [None if outcome.trouble is None else " ".join(str(outcome.trouble).split()) for outcome in outcomes]
    )
    tokens = _all((outcome.values for outcome in outcomes), () if cg is None else cg.sink_tokens)
    functions = _all((outcome.times_ns for outcome in outcomes), () if cg is None else cg.functions)
    for token in tokens:
        is_taken = token in columns or token in _FIXED
        columns[f"{token} (token)" if is_taken else token] = _column(
            [outcome.values.get(token) for outcome in outcomes]
        )
    columns["total_ms"] = [outcome.total_ns / 1e6 for outcome in outcomes]
    for function in functions:
        columns[f"{function} ms"] = [_in_ms(outcome.times_ns.get(function)) for outcome in outcomes]
    with optional_import():
        import pandas as pd
    return pd.DataFrame(columns)


def _column(values: list[Any]) -> Any:
    """Return values as a column; integers and truth values of which some are missing stay what they are."""
    kinds = {type(value) for value in values if value is not None}
    if None in values and len(kinds) == 1 and kinds <= {bool, int}:
        with optional_import():
            import pandas as pd
        try:
            return pd.array(values, dtype="boolean" if bool in kinds else "Int64")
        except OverflowError:  # above 64 bits
            return values
    return values


def none_as_it_is(values: Sequence[Any]) -> Any:
    """Return values as a column; where None is one of them it stays None, since NaN is another value."""
    has_none = any(value is None for value in values)
    if not has_none:
        return values
    with optional_import():
        import pandas as pd
    return pd.Series(list(values), dtype=object)


def _in_ms(duration_ns: int | None) -> float:
    return float("nan") if duration_ns is None else duration_ns / 1e6


def _all(found: Iterable[Mapping[str, Any]], first: Iterable[str]) -> list[str]:
    """Return the names in all mappings: those of ``first`` in that order, then the others as they come."""
    order = dict.fromkeys(first)
    for names in found:
        order |= dict.fromkeys(names)
    return list(order)
