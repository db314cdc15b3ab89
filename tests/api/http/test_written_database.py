"""An attacker who reads and writes the database and has no master key, as the service meets them.

The store's own tests (``tests/templates/store/test_written_database.py``) have each column, and
what ``veilface audit-log verify`` reports. Here is what a caller is told.
"""

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from templates.store import verify_audit_log
from templates.store.database import Database
from tests.api.calls import attempt, enroll
from tests.api.client import Client
from tests.api.deployment import Deployment
from tests.api.shapes import assert_error
from tests.databases import execute

Run = Callable[..., list[Any]]


@pytest.fixture
def run(both: tuple[Client, Deployment]) -> Iterator[Run]:
    """Runs a statement of the attacker's."""
    database = Database(both[1].settings.resolved_database_url)

    yield lambda *statements, **values: execute(database, *statements, **values)
    database.close()


def test_a_token_whose_use_was_forgotten_is_taken_again_and_reported(
    both: tuple[Client, Deployment], run: Run
) -> None:
    client, _ = both
    enroll(client)
    asked = {"subject_id": "alice", "action": "verify"}
    token = client.post("/v1/tokens", json=asked).json()["token"]
    assert attempt(client, token, 1).status_code == 200
    assert_error(attempt(client, token, 1), 401, "replayed")
    assert verify_audit_log(client.app.state.runtime.store).problem is None
    run("UPDATE audit_log SET token = NULL")
    assert attempt(client, token, 1).status_code == 200
    problem = verify_audit_log(client.app.state.runtime.store).problem
    assert problem is not None
    assert problem.what == "altered"
