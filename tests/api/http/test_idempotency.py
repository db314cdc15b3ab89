import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from api.http.holder_keys import holder_key_of
from api.http.routes import enrollment
from api.http.schemas import HOLDER_KEY
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, environment_of, images, photo
from tests.api.shapes import assert_error


def put(client: Client, key: str | None, *files: bytes, subject: str = "idem", **more: Any) -> Any:
    headers = {} if key is None else {"Idempotency-Key": key}
    headers |= more.pop("headers", {})
    return client.put(
        f"/v1/subjects/{subject}/enrollment", files=images(*files), headers=headers, **more
    )


def without_request_id(answer: Any) -> dict[str, Any]:
    body = dict(answer.json())
    del body["request_id"]
    return body


def test_the_same_request_is_answered_once(both: tuple[Client, Deployment]) -> None:
    client, _ = both
    first = put(client, "key-1", photo(1))
    # httpx picks a new multipart boundary: the bytes differ, the request does not.
    second = put(client, "key-1", photo(1))
    assert (first.status_code, second.status_code) == (201, 201)
    assert without_request_id(first) == without_request_id(second)
    assert first.json()["request_id"] != second.json()["request_id"]
    assert "idempotency-replayed" not in first.headers
    assert second.headers["idempotency-replayed"] == "true"
    third = put(client, None, photo(1))
    assert (third.status_code, third.json()["replaced"]) == (200, True)


def test_another_request_under_the_key_conflicts(both: tuple[Client, Deployment]) -> None:
    client, deployment = both
    assert put(client, "key-2", photo(1)).status_code == 201
    for answer in (
        put(client, "key-2", photo(2)),
        put(client, "key-2", photo(1), photo(1, 1)),
        put(client, "key-2", photo(1), subject="somebody-else"),
        put(client, "key-2", photo(1), data={"face": "largest"}),
        put(client, "key-2", photo(1), data={"attributes": '{"gender": "Male"}'}),
    ):
        assert_error(answer, 409, "idempotency_conflict")
    # Another API key is another client: its keys do not meet ours.
    other = bearer(deployment.key("enroll"))
    assert put(client, "key-2", photo(2), headers=other).status_code == 200


def test_a_refused_write_gives_the_key_back(client: Client) -> None:
    assert_error(put(client, "key-3", photo(1), photo(2)), 422, "inconsistent_images")
    assert put(client, "key-3", photo(1), subject="key-3").status_code == 201


def test_deletion(both: tuple[Client, Deployment]) -> None:
    client, _ = both
    put(client, None, photo(1))
    headers = {"Idempotency-Key": "delete-1"}
    first = client.delete("/v1/subjects/idem", headers=headers)
    again = client.delete("/v1/subjects/idem", headers=headers)
    assert without_request_id(first) == without_request_id(again)
    # Enrolled anew: the old receipt would claim an erasure that did not happen.
    put(client, None, photo(1))
    second = client.delete("/v1/subjects/idem", headers=headers)
    assert second.json()["claims"]["held"] is True
    assert without_request_id(first) != without_request_id(second)
    assert_error(client.get("/v1/subjects/idem"), 404, "not_enrolled")
    assert_error(
        client.delete("/v1/subjects/idem", headers={"Idempotency-Key": "a b"}),
        422,
        "validation_failed",
    )


def test_import(client: Client) -> None:
    put(client, None, photo(1))
    data = client.get("/v1/subjects/idem/export").json()["export"]
    headers = {"Idempotency-Key": "import-1"}
    first = client.post("/v1/subjects/import", json={"export": data}, headers=headers)
    second = client.post("/v1/subjects/import", json={"export": data}, headers=headers)
    assert without_request_id(first) == without_request_id(second)
    assert second.json()["subject_id"] == "idem"


def test_many_at_once_write_once(both: tuple[Client, Deployment]) -> None:
    client, _ = both
    answers: list[Any] = []
    start = threading.Barrier(6)

    def send() -> None:
        start.wait()
        answers.append(put(client, "at-once", photo(1), subject="once"))

    threads = [threading.Thread(target=send) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert {answer.status_code for answer in answers} <= {201, 409}
    assert len({a.json()["template_id"] for a in answers if a.status_code == 201}) == 1
    final = put(client, "at-once", photo(1), subject="once")
    assert final.status_code == 201
    assert final.headers["idempotency-replayed"] == "true"


ROOT = Path(__file__).resolve().parents[3]
KILLED_AFTER_THE_COMMIT = """
import json, os, signal, sys

from api.http.app import create_app
from api.settings import load_settings
from templates.store.subjects import Subjects
from tests.api.client import Client
from tests.api.deployment import images, photo

put = Subjects.put

def put_and_end(*given, **named):
    put(*given, **named)
    os.kill(os.getpid(), signal.SIGKILL)

Subjects.put = put_and_end
path, headers, fields = json.loads(sys.argv[1])
with Client(create_app(load_settings())) as client:
    client.put(path, files=images(photo(1)), headers=headers, data=fields)
"""


@pytest.mark.long
@pytest.mark.parametrize("storage", ["service", "holder"])
def test_a_retry_does_not_meet_its_own_write_of_a_service_that_was_killed(
    client: Client, deployment: Deployment, storage: str
) -> None:
    """The precondition is of the first sending: what that one wrote does not count."""
    subject, headers = f"{storage}-1", {"Idempotency-Key": f"{storage}-1", "If-None-Match": "*"}
    fields = {} if storage == "service" else {"storage": storage}
    ended = subprocess.run(
        [
            sys.executable,
            "-c",
            KILLED_AFTER_THE_COMMIT,
            json.dumps(
                [
                    f"/v1/subjects/{subject}/enrollment",
                    headers | bearer(deployment.token),
                    fields,
                ]
            ),
        ],
        cwd=ROOT,
        env={
            **{name: text for name, text in os.environ.items() if not name.startswith("VEILFACE_")},
            **environment_of(deployment.settings),
        },
        capture_output=True,
        check=False,
    )
    assert ended.returncode == -signal.SIGKILL, ended.stderr.decode()
    written = client.get(f"/v1/subjects/{subject}").json()["template_id"]
    again = put(client, None, photo(1), subject=subject, headers=headers, data=fields)
    if storage == "service":
        assert (again.status_code, again.json()["template_id"]) == (201, written)
        assert again.headers["Idempotency-Replayed"] == "true"
    else:  # the template was lost with the answer: another one is made
        assert (again.status_code, again.json()["replaced"]) == (200, True)
        assert again.json()["held_template"]
    # The control: another request does meet it.
    assert_error(
        put(client, None, photo(1), subject=subject, headers={**headers, "Idempotency-Key": "2"}),
        409,
        "enrollment_conflict",
    )


def test_the_holders_key_is_wiped_of_a_request_that_is_not_done_too(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys: list[bytearray] = []

    def seen(*given: Any) -> bytearray | None:
        if (key := holder_key_of(*given)) is not None:
            assert any(key)
            keys.append(key)
        return key

    monkeypatch.setattr(enrollment, "holder_key_of", seen)
    sent = {"subject": "keyed", "data": {"holder_key": HOLDER_KEY}}
    done, replayed, refused = (
        put(client, key, photo(1), headers=more, **sent)
        for key, more in (("keyed", {}), ("keyed", {}), ("refused", {"If-None-Match": "*"}))
    )
    conflict = put(client, "keyed", photo(2), **sent)
    assert (done.status_code, done.json()["holder_key"]) == (201, True)
    assert replayed.headers["Idempotency-Replayed"] == "true"
    assert_error(refused, 409, "enrollment_conflict")
    assert_error(conflict, 409, "idempotency_conflict")
    assert [any(key) for key in keys] == [False] * 4


def test_records_hold_no_subject_and_no_token(client: Client, deployment: Deployment) -> None:
    put(client, "secret-key-name", photo(1), subject="named-subject")
    files = list(deployment.settings.data_dir.glob("veilface.db*"))
    stored = b"".join(path.read_bytes() for path in files)
    assert b"named-subject" in stored  # the subjects table: the control of this search
    assert b"secret-key-name" not in stored
    client.delete("/v1/subjects/named-subject")
    stored = b"".join(path.read_bytes() for path in files)
    assert b"named-subject" not in stored
    assert deployment.token.encode() not in stored


@pytest.mark.parametrize("key", ["", "with space", "x" * 256, "tab\tx"])
def test_a_key_must_be_visible_and_short(client: Client, key: str) -> None:
    assert_error(put(client, key, photo(1)), 422, "validation_failed")
