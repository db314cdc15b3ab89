"""Databases for the scenarios: those of the other tests, and a server that may be stopped."""

from collections.abc import Iterator

import pytest

from tests.databases import database_url, postgres_database, postgres_url  # noqa: F401
from tests.reliability.cluster import Cluster, NoPostgres
from tests.required import absent


@pytest.fixture
def cluster_address() -> str:
    """That the server of `cluster` listens on; a test that asks for another overrides it."""
    return "127.0.0.1"


@pytest.fixture
def cluster(cluster_address: str) -> Iterator[Cluster]:
    """A running PostgreSQL server of this test's own."""
    try:
        made = Cluster(cluster_address)
    except NoPostgres as reason:
        absent(str(reason), "VEILFACE_REQUIRE_POSTGRES")
    with made:
        yield made
