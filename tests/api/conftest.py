"""A running application on SQLite, and in the long tests on PostgreSQL too.

What differs between the two is the store's, whose own tests run on both.
"""

from collections.abc import Iterator
from pathlib import Path

import pytest

from api.http.app import create_app
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, deploy
from tests.databases import (
    migrate_ahead,
    postgres_database,  # noqa: F401
    postgres_url,  # noqa: F401
    url_of,
)


@pytest.fixture(scope="module")
def deployment(tmp_path_factory: pytest.TempPathFactory) -> Deployment:
    """A deployment on SQLite, shared by the tests of one module.

    Without the lockout: they fail to verify the same few subjects many times on purpose.
    """
    return deploy(tmp_path_factory.mktemp("deployment"), lockout_after=0)


@pytest.fixture(scope="module")
def client(deployment: Deployment) -> Iterator[Client]:
    """A client with the bootstrap key: all rights."""
    with Client(create_app(deployment.settings)) as running:
        running.headers.update(bearer(deployment.token))
        yield running


@pytest.fixture(params=["sqlite", pytest.param("postgres", marks=pytest.mark.long)])
def database_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """URL of an empty database."""
    return url_of(request, tmp_path)


@pytest.fixture
def both(tmp_path: Path, database_url: str) -> Iterator[tuple[Client, Deployment]]:
    """A fresh deployment on each database, with a client that has all rights."""
    migrate_ahead(database_url)
    deployment = deploy(tmp_path, database_url=database_url)
    with Client(create_app(deployment.settings)) as running:
        running.headers.update(bearer(deployment.token))
        yield running, deployment
