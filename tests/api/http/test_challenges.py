"""Challenges over REST: who passes, what fails and why, and what is used up."""

import base64
from collections.abc import Iterator
from typing import Any

import httpx
import numpy as np
import pytest

from api.http.app import create_app
from api.http.errors import StartError
from api.http.routes import challenges
from api.service.runtime import Runtime
from models.pack import ModelPack
from templates.store.lockout import LockoutPolicy
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, deploy, images, photo
from tests.api.living import (
    ANNA,
    BEN,
    PASSED,
    answered,
    challenge,
    failed,
    frames_of,
    liveness,
)
from tests.api.shapes import assert_error
from tests.heads import POSES, head, performed
from tests.marked_heads import draw, encoded, frame, write_marked_pack

Service = tuple[Client, Deployment]


def serve(folder: Any, **changes: Any) -> Iterator[Service]:
    pack = write_marked_pack(folder / "pack")
    deployment = deploy(folder, pack=pack, **{"lockout_after": 0, **changes})
    with Client(create_app(deployment.settings)) as client:
        client.headers.update(bearer(deployment.token))
        put = client.put("/v1/subjects/anna/enrollment", files=images(frame(person=ANNA)))
        assert put.status_code == 201, put.text
        yield client, deployment


@pytest.fixture(scope="module")
def off(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A deployment that asks for nothing."""
    yield from serve(tmp_path_factory.mktemp("off"))


@pytest.fixture(scope="module")
def active(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A deployment that asks for a challenge."""
    yield from serve(tmp_path_factory.mktemp("active"), liveness="active")


def test_who_makes_the_movements_is_accepted(active: Service) -> None:
    client, _ = active
    for subject in (None, "anna"):
        asked = challenge(client, subject)
        assert len(asked["movements"]) == len(set(asked["movements"])) == 3
        assert (asked["min_frames"], asked["max_frames"]) == (5, 12)
        frames = frames_of(performed(asked["movements"]))
        assert liveness(answered(client, asked["challenge_id"], frames)) == PASSED


def test_another_person_who_makes_them_is_no_match(active: Service) -> None:
    client, _ = active
    asked = challenge(client)
    frames = frames_of(performed(asked["movements"]), BEN)
    told = liveness(answered(client, asked["challenge_id"], frames))
    assert told == ("reject", "no_match", "passed", None)
    # Nobody is enrolled under this id, in the same shape.
    asked = challenge(client)
    frames = frames_of(performed(asked["movements"]))
    token = active[1].key("verify")
    answer = answered(client, asked["challenge_id"], frames, "nobody", headers=bearer(token))
    assert liveness(answer) == ("reject", "no_match", "passed", None)


def test_a_challenge_is_good_for_one_decision(active: Service) -> None:
    client, deployment = active
    asked = challenge(client)
    frames = frames_of(performed(asked["movements"]))
    assert liveness(answered(client, asked["challenge_id"], frames)) == PASSED
    # Neither with the key that asked for it, nor with another one of the tenant.
    other = bearer(deployment.key("verify"))
    for headers in ({}, other):
        again = answered(client, asked["challenge_id"], frames, headers=headers)
        assert_error(again, 401, "replayed")
        assert "used before" in again.json()["error"]["message"]
    # A rejection uses it up as well, whichever key it comes with.
    asked = challenge(client)
    frames = frames_of(performed(asked["movements"]))
    still = answered(client, asked["challenge_id"], frames_of(["front"] * 5), headers=other)
    assert liveness(still)[:3] == failed("")[:3]
    assert_error(answered(client, asked["challenge_id"], frames), 401, "replayed")


def test_a_photo_that_fails_leaves_the_challenge_good(active: Service) -> None:
    client, _ = active
    asked = challenge(client)
    frames = frames_of(performed(asked["movements"]))
    faceless = encoded(draw(head(**POSES["front"]), marked=False))
    answer = answered(client, asked["challenge_id"], [*frames[:5], faceless])
    assert assert_error(answer, 422, "no_face")["image"] == 5
    assert liveness(answered(client, asked["challenge_id"], frames)) == PASSED


def test_a_failed_challenge_counts_for_the_lockout(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("api.service.opening.LOCKOUT", LockoutPolicy(first_s=3600))
    for client, _ in serve(tmp_path, liveness="active", lockout_after=1):
        told = answered(client, challenge(client)["challenge_id"], frames_of(["front"] * 5))
        assert liveness(told) == failed("no_turn")
        asked = challenge(client)
        frames = frames_of(performed(asked["movements"]))
        assert_error(answered(client, asked["challenge_id"], frames), 423, "locked_out")


def test_why_is_told_to_keys_with_scores_only(active: Service) -> None:
    client, deployment = active
    asked = challenge(client)
    headers = bearer(deployment.key("verify"))
    answer = answered(client, asked["challenge_id"], frames_of(["front"] * 5), headers=headers)
    assert liveness(answer) == ("reject", "liveness", "failed", None)


def test_an_answer_that_is_late_is_refused(
    active: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    client, _ = active
    monkeypatch.setattr(challenges, "LIFETIME_S", -2)
    late = challenge(client)
    frames = frames_of(performed(late["movements"]))
    monkeypatch.undo()
    answer = answered(client, late["challenge_id"], frames)
    assert_error(answer, 401, "replayed")
    assert "expired" in answer.json()["error"]["message"]


def test_too_many_frames_are_refused(active: Service, off: Service) -> None:
    client, _ = active
    asked = challenge(client)
    answer = answered(client, asked["challenge_id"], [frame()] * 13)
    assert assert_error(answer, 413, "too_many_images") == {"limit": 12}
    # Without a challenge the limit of photos holds.
    answer = off[0].post("/v1/subjects/anna/verify", files=images(*[frame()] * 6))
    assert assert_error(answer, 413, "too_many_images") == {"limit": 5}


def test_a_challenge_of_another_tenant_or_subject_is_none(active: Service) -> None:
    client, deployment = active
    theirs = challenge(client, headers=bearer(deployment.key("verify", tenant="other")))
    bobs = challenge(client, "bob")
    good = challenge(client)["challenge_id"]
    sealed = base64.urlsafe_b64decode(good + "=" * (-len(good) % 4))
    altered = base64.urlsafe_b64encode(sealed[:-1] + bytes([sealed[-1] ^ 1])).decode().rstrip("=")
    made_up = [altered, good[:40], "x", "é", base64.urlsafe_b64encode(bytes(200)).decode()]
    for challenge_id in (theirs["challenge_id"], bobs["challenge_id"], *made_up):
        answer = answered(client, challenge_id, [frame()] * 5)
        assert assert_error(answer, 422, "validation_failed") == {"field": "challenge_id"}


def test_a_challenge_needs_the_right_and_a_well_formed_request(active: Service) -> None:
    client, deployment = active
    enrolls = bearer(deployment.key("enroll"))
    assert_error(client.post("/v1/challenges", json={}, headers=enrolls), 403, "forbidden")
    for body in ({"subject": "anna"}, {"subject_id": 5}, {"subject_id": "a b"}):
        assert_error(client.post("/v1/challenges", json=body), 422, "validation_failed")


def test_a_policy_refuses_what_cannot_show_liveness(active: Service) -> None:
    client, deployment = active
    assert client.get("/v1/key").json()["liveness"] == "active"
    answer = client.post("/v1/subjects/anna/verify", files=images(frame(person=ANNA), name="image"))
    assert assert_error(answer, 403, "forbidden") == {"liveness": "active"}
    assert "POST /v1/challenges" in answer.json()["error"]["message"]
    pack = ModelPack.load(deployment.settings.pack or "", threads=1)
    embedding = pack.embed_photo(frame(person=ANNA)).embedding.astype(np.float64)
    for body in ({"embedding": embedding.tolist()}, {"embeddings": [embedding.tolist()]}):
        answer = client.post("/v1/subjects/anna/verify", json=body)
        assert assert_error(answer, 403, "forbidden") == {"liveness": "active"}
        assert "embeddings and lifted probes cannot show" in answer.json()["error"]["message"]


@pytest.mark.parametrize(
    ("changes", "remedy"),
    [
        ({"liveness": "active"}, "add a SCRFD or YuNet .onnx file"),
        ({"liveness": "passive"}, "no liveness graph"),
    ],
    ids=str,
)
def test_a_policy_that_cannot_be_checked_does_not_start(
    tmp_path: Any, changes: dict[str, str], remedy: str
) -> None:
    # The tiny pack has no detector.
    settings = deploy(tmp_path).settings
    with pytest.raises(StartError, match=remedy):
        Runtime.open(type(settings)(**{**settings.model_dump(exclude_unset=True), **changes}))


def test_a_service_without_a_detector_gives_no_challenge(tmp_path: Any) -> None:
    deployment = deploy(tmp_path)
    with Client(create_app(deployment.settings)) as client:
        client.headers.update(bearer(deployment.token))
        assert_error(client.post("/v1/challenges", json={}), 404, "not_found")
        answer = client.post(
            "/v1/subjects/anna/verify",
            files=images(*[photo(1)] * 5),
            data={"challenge_id": "made-up"},
        )
        assert_error(answer, 422, "validation_failed")


def test_a_challenge_of_a_token_and_the_token_are_used_up_together(active: Service) -> None:
    client, _ = active

    def token() -> dict[str, str]:
        body = {"subject_id": "anna", "action": "verify"}
        return bearer(client.post("/v1/tokens", json=body).json()["token"])

    def attempt(asked: dict[str, Any], headers: dict[str, str]) -> httpx.Response:
        frames = frames_of(performed(asked["movements"]))
        return answered(client, asked["challenge_id"], frames, headers=headers)

    mine, others = token(), token()
    first, second = challenge(client, headers=mine), challenge(client, "anna", headers=mine)
    refused = client.post("/v1/challenges", json={"subject_id": "ben"}, headers=mine)
    assert assert_error(refused, 403, "forbidden") == {"token": "subject"}
    # Photos alone, a challenge of the API key's, and one of another token's.
    alone = client.post("/v1/subjects/anna/verify", files=images(frame()), headers=mine)
    assert assert_error(alone, 403, "forbidden")["liveness"] == "active"
    for asked in (challenge(client), challenge(client, headers=others)):
        assert_error(attempt(asked, mine), 422, "validation_failed")
    assert liveness(attempt(first, mine)) == PASSED
    for asked in (first, second):
        assert_error(attempt(asked, mine), 401, "replayed")
    # An API key, which chooses the level itself, makes no decision in the token's name.
    asked = challenge(client, headers=others)
    assert_error(attempt(asked, {}), 422, "validation_failed")
    assert liveness(attempt(asked, others)) == PASSED
