"""Results and history in a database: a SQLite file, or any other that SQLAlchemy supports.

- ``store``: a database of series, and series of rows
- ``database``: URL, transactions, statements, and errors in plain words; it alone imports SQLAlchemy at its top
- ``writer``: writing on a background thread, so that no caller waits for a disk or a database
"""

from __future__ import annotations

from epypes.store.store import Series, Store, opened_store

__all__ = ["Series", "Store", "opened_store"]
