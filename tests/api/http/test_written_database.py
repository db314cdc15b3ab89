"""An attacker who reads and writes the database and has no master key, as the service meets them.

The store's own tests (``tests/templates/store/test_written_database.py``) have each column, and
what ``veilface audit-log verify`` reports. Here is what a caller is told.
"""

import hashlib
import os
import uuid
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import sqlalchemy as sa

from templates.store.database import Database
from tests.api.calls import attempt, enroll
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer
from tests.api.shapes import assert_error

Run = Callable[..., list[Any]]


@pytest.fixture
def run(both: tuple[Client, Deployment]) -> Iterator[Run]:
    """Runs a statement of the attacker's."""
    database = Database(both[1].settings.resolved_database_url)

    def execute(statement: str, **values: object) -> list[Any]:
        def work(connection: sa.Connection) -> list[Any]:
            result = connection.execute(sa.text(statement), values)
            return [row._asdict() for row in result] if result.returns_rows else []

        return database.write(work)

    yield execute
    database.close()


@pytest.mark.parametrize(
    "change", ["a new row", "rights = 'admin,enroll,verify'", "token_hash = :token_hash"]
)
def test_a_key_that_was_made_up_or_widened_is_unknown(
    both: tuple[Client, Deployment], run: Run, change: str
) -> None:
    client, deployment = both
    own = deployment.key("verify")
    prefix, secret = own.split("_")[1], os.urandom(32).hex()
    token = own if change.startswith("rights") else f"vf_{prefix}_{secret}"
    if change == "a new row":
        token = f"vf_{os.urandom(6).hex()}_{secret}"
        row = run("SELECT * FROM api_keys WHERE prefix = :prefix", prefix=prefix)[0]
        row |= {"id": uuid.uuid4().hex, "prefix": token.split("_")[1]}
        row["token_hash"] = hashlib.sha256(token.encode()).digest()
        columns, values = ", ".join(row), ", ".join(f":{name}" for name in row)
        run(f"INSERT INTO api_keys ({columns}) VALUES ({values})", **row)
    else:
        values = {"token_hash": hashlib.sha256(token.encode()).digest()} if ":" in change else {}
        run(f"UPDATE api_keys SET {change} WHERE prefix = :prefix", prefix=prefix, **values)
    refused, unknown = (
        client.get("/v1/contract", headers=bearer(each))
        for each in (token, f"vf_{os.urandom(6).hex()}_{secret}")
    )
    assert_error(refused, 401, "unauthorized")
    assert refused.json()["error"] == unknown.json()["error"]


def test_a_token_whose_use_was_forgotten_is_taken_again_and_reported(
    both: tuple[Client, Deployment], run: Run
) -> None:
    client, _ = both
    enroll(client)
    asked = {"subject_id": "alice", "action": "verify"}
    token = client.post("/v1/tokens", json=asked).json()["token"]
    assert attempt(client, token, 1).status_code == 200
    assert_error(attempt(client, token, 1), 401, "replayed")
    assert client.app.state.runtime.store.verify_audit_log()[0].problem is None
    run("UPDATE audit_log SET token = NULL")
    assert attempt(client, token, 1).status_code == 200
    problem = client.app.state.runtime.store.verify_audit_log()[0].problem
    assert problem is not None
    assert problem.what == "altered"
