"""POST /v1/compare: two photos, decided as a verification, and nothing left of either."""

import sqlite3
from pathlib import Path
from typing import Any

import pytest

from api.http.app import create_app
from api.http.schemas import VerifyAnswer
from api.settings import LivenessPolicy
from tests.api.calls import ask
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, deploy, images, photo
from tests.api.living import PASSED, calibrated, failed, liveness
from tests.api.shapes import assert_answer, assert_error
from tests.heads import POSES, head
from tests.marked_heads import draw, encoded

PATH = "/v1/compare"


def compare(client: Client, *photos: bytes, token: str | None = None, **fields: str) -> Any:
    headers = {} if token is None else bearer(token)
    return client.post(PATH, files=images(*photos), data=fields, headers=headers)


def test_it_decides_as_a_verification_of_the_same_two_photos(
    client: Client, deployment: Deployment
) -> None:
    client.put("/v1/subjects/alice/enrollment", files=images(photo(1)))
    for person, decision in ((1, "accept"), (2, "reject")):
        for level in ("fmr-1e-3", "fmr-1e-2"):
            body = assert_answer(
                compare(client, photo(1), photo(person, 7), level=level), 200, VerifyAnswer
            )
            fields = {"files": images(photo(person, 7)), "data": {"level": level}}
            verified = ask(client, deployment.token, **fields).json()
            assert body["decision"] == decision
            # The same decoys, in another rotation, which keeps distances up to its rounding.
            assert body.pop("distance") == pytest.approx(verified.pop("distance"), abs=1e-3)
            del body["request_id"], verified["request_id"]
            assert body == verified
    assert_error(compare(client, photo(1), photo(1), level="fmr-1e-9"), 422, "uncalibrated")


def test_nothing_is_kept_but_a_line_without_a_subject(tmp_path: Path) -> None:
    deployment = deploy(tmp_path, lockout_after=1)

    def rows() -> dict[str, int]:
        with sqlite3.connect(deployment.settings.data_dir / "veilface.db") as database:
            tables = [
                name
                for (name,) in database.execute(
                    "SELECT name FROM sqlite_master WHERE type = 'table'"
                )
            ]
            return {
                table: database.execute(f"SELECT count(*) FROM {table}").fetchone()[0]
                for table in tables
            }

    with Client(create_app(deployment.settings), headers=bearer(deployment.token)) as client:
        compare(client, photo(1), photo(1, 1))
        before = rows()
        answers = [compare(client, photo(1), photo(2, shot)) for shot in range(3)]
        assert {answer.json()["decision"] for answer in answers} == {"reject"}
        assert compare(client, photo(1), photo(1, 2)).json()["decision"] == "accept"
        assert rows() == before | {"audit_log": before["audit_log"] + 4}
        assert_error(compare(client, photo(1), b"no picture"), 400, "unsupported_image")
        lines = client.get("/v1/audit-log", params={"limit": 5}).json()["lines"]
    names = ("action", "outcome", "detail", "subject")
    assert [[line[name] for name in names] for line in lines] == [
        ["compare", "unsupported_image", None, None],
        ["compare", "accept", "fmr-1e-3", None],
        *[["compare", "reject", "fmr-1e-3", None]] * 3,
    ]


def test_who_may_ask_and_who_sees_the_distance(client: Client, deployment: Deployment) -> None:
    both = (photo(1), photo(1, 1))
    for rights, seen in (
        (("verify",), False),
        (("verify", "scores"), False),
        (("verify", "enroll"), False),
        (("verify", "scores", "enroll"), True),
    ):
        body = compare(client, *both, token=deployment.key(*rights)).json()
        assert (body["decision"], "distance" in body) == ("accept", seen)
    refused = compare(client, *both, token=deployment.key("enroll", "admin", "scores"))
    assert assert_error(refused, 403, "forbidden") == {"missing": ["verify"]}
    strict = deployment.key("verify", lowest_level="fmr-1e-3")
    refused = compare(client, *both, token=strict, level="fmr-1e-2")
    assert assert_error(refused, 403, "forbidden") == {"lowest_level": "fmr-1e-3"}


@pytest.mark.parametrize(
    ("request_of", "status", "code", "details"),
    [
        ({"files": images(photo(1))}, 422, "validation_failed", {"field": "images"}),
        ({"files": images(photo(1), photo(1), photo(1))}, 413, "too_many_images", {"limit": 2}),
        ({"files": images(photo(1), b"none")}, 400, "unsupported_image", {"image": 1}),
        ({"files": images(b"none", photo(1))}, 400, "unsupported_image", {"image": 0}),
        ({"files": images(photo(1), photo(2), name="image")}, 422, "validation_failed",
         {"known": ["face", "images", "level"]}),
        ({"files": images(photo(1), photo(2)), "data": {"subject_id": "a"}}, 422,
         "validation_failed", {"known": ["face", "images", "level"]}),
        ({"json": {"embedding": [1.0]}}, 400, "malformed_request",
         {"content_type": "multipart/form-data"}),
    ],
)  # fmt: skip
def test_what_is_refused(
    client: Client, request_of: dict[str, Any], status: int, code: str, details: dict[str, Any]
) -> None:
    assert assert_error(client.post(PATH, **request_of), status, code) == details


@pytest.mark.parametrize("policy", ["passive", "active"])
def test_the_liveness_policy_holds_for_the_second_photo(tmp_path: Path, policy: str) -> None:
    deployment = calibrated(tmp_path, liveness=LivenessPolicy(policy))
    points = head(**POSES["front"])
    live, dark = (encoded(draw(points, 1, background=level)) for level in (120, 0))
    with Client(create_app(deployment.settings), headers=bearer(deployment.token)) as client:
        if policy == "active":
            refused = compare(client, live, live)
            assert assert_error(refused, 403, "forbidden") == {"liveness": "active"}
            return
        assert liveness(compare(client, dark, live)) == PASSED
        assert liveness(compare(client, live, dark)) == failed("passive")
