"""Results and history in a database: a SQLite file, or any other that SQLAlchemy speaks to."""

from __future__ import annotations

from epypes.store.series import Series
from epypes.store.store import Store, as_store, opened_store

__all__ = ["Series", "Store", "as_store", "opened_store"]
