"""Which tables hold what is stored?"""

from __future__ import annotations

import hashlib
from typing import Final

from sqlalchemy import (
    BigInteger,
    Column,
    ForeignKey,
    Integer,
    MetaData,
    String,
    Table,
    Text,
    UniqueConstraint,
    bindparam,
    insert,
    select,
)
from sqlalchemy.dialects.mysql import LONGTEXT

# Raised when the tables change; a database of another version is refused.
SCHEMA: Final = 1

# SQLite counts rows by INTEGER alone; the TEXT of MySQL ends at 64 KB.
_NUMBER = BigInteger().with_variant(Integer(), "sqlite")
_LONG_TEXT = Text().with_variant(LONGTEXT(), "mysql", "mariadb")

metadata: Final = MetaData()

schema: Final = Table(
    "epypes_schema",
    metadata,
    Column("id", Integer, primary_key=True, autoincrement=False),
    Column("version", Integer, nullable=False),
)

# Names can be longer than an index takes, so their digests are what is unique.
series: Final = Table(
    "epypes_series",
    metadata,
    Column("id", _NUMBER, primary_key=True),
    Column("digest", String(64), nullable=False, unique=True),
    Column("kind", Text, nullable=False),
    Column("name", Text, nullable=False),
    Column("about", _LONG_TEXT, nullable=False),
    Column("made_ns", BigInteger, nullable=False),
)

rows: Final = Table(
    "epypes_rows",
    metadata,
    Column("id", _NUMBER, primary_key=True),
    Column("series_id", _NUMBER, ForeignKey("epypes_series.id"), nullable=False),
    Column("digest", String(64), nullable=False),
    Column("key", Text, nullable=False),
    Column("data", _LONG_TEXT, nullable=False),
    Column("written_ns", BigInteger, nullable=False),
    UniqueConstraint("series_id", "digest", name="epypes_rows_once"),
)

# Made once, since to make a statement takes three times as long as to execute it.
rows_there: Final = select(rows.c.digest).where(
    rows.c.series_id == bindparam("series"), rows.c.digest.in_(bindparam("digests", expanding=True))
)
row_data: Final = select(rows.c.data).where(
    rows.c.series_id == bindparam("series"), rows.c.digest == bindparam("digest")
)
new_row: Final = insert(rows)


def digest_of(*words: str) -> str:
    """Return what stands for these words in an index."""
    return hashlib.sha256("\0".join(words).encode()).hexdigest()
