"""Alembic migrations of the store.

The number of a revision is what it begins with. A revision such as ``0012_serves_0010`` also says
which earlier programs do everything they did on its schema, and stay at work during the migration:
those of 0010 and later. A new table is such a change, and a new column that they need not write.
They do not know the revision itself: its name, in the database, is what tells them.
"""

import re
from pathlib import Path

_SERVING = re.compile(r"\d{4}_serves_(\d{4})")


def number_of(revision: str) -> str:
    """Return the number of a revision, four digits."""
    return revision[:4]


def oldest_served(revision: str) -> str:
    """Return the number of the oldest program that may work on the schema of a revision."""
    named = _SERVING.fullmatch(revision)
    return number_of(revision) if named is None else named[1]


NEWEST = max(number_of(path.stem) for path in Path(__file__).parent.glob("versions/[0-9]*.py"))
"""Number of the revision that this program needs."""
