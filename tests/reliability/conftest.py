"""Databases for the scenarios: those of the other tests, and a server that may be stopped."""

import os
from collections.abc import Iterator

import pytest

from tests.databases import database_url, postgres_database, postgres_url  # noqa: F401
from tests.reliability.cluster import Cluster, NoPostgres


@pytest.fixture
def cluster() -> Iterator[Cluster]:
    """A running PostgreSQL server of this test's own."""
    try:
        made = Cluster()
    except NoPostgres as reason:
        if os.environ.get("VEILFACE_REQUIRE_POSTGRES") == "1":
            pytest.fail(f"{reason}, and VEILFACE_REQUIRE_POSTGRES=1 asks for one")
        pytest.skip(str(reason))
    with made:
        yield made
