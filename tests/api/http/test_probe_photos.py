"""A probe of several photos, or embeddings, of one person: one mean, one decision, one attempt."""

from typing import Any

import numpy as np
import pytest

from api.http.schemas import LockoutAnswer, VerifyAnswer
from models.pack import ModelPack
from tests.api.calls import ask, embedding
from tests.api.client import Client
from tests.api.deployment import Deployment, images, photo
from tests.api.shapes import assert_answer, assert_error

BURST = tuple(photo(1, shot) for shot in (5, 6, 7))


@pytest.fixture(scope="module")
def scored(client: Client, deployment: Deployment) -> str:
    """A key that is told distances and may send embeddings; ``alice`` is person 1."""
    answer = client.put("/v1/subjects/alice/enrollment", files=images(photo(1), photo(1, 1)))
    assert answer.status_code == 201
    return deployment.key("verify", "scores", "enroll", "embeddings")


def decided(answer: Any) -> dict[str, Any]:
    return assert_answer(answer, 200, VerifyAnswer)


def mean_of(rows: list[list[float]]) -> list[float]:
    mean = np.asarray(rows, dtype=np.float64).sum(axis=0)
    return [float(x) for x in mean / np.linalg.norm(mean)]


@pytest.mark.parametrize("name", ["image", "images"])
def test_photos_are_averaged_under_either_name(client: Client, scored: str, name: str) -> None:
    for person, decision in ((1, "accept"), (2, "reject")):
        rows = [embedding(client, person, shot) for shot in (5, 6, 7)]
        burst = images(*(photo(person, shot) for shot in (5, 6, 7)), name=name)
        answer = decided(ask(client, scored, files=burst))
        mean = decided(ask(client, scored, json={"embedding": mean_of(rows)}))
        assert answer["decision"] == mean["decision"] == decision
        assert answer["distance"] == pytest.approx(mean["distance"], abs=1e-5)
        alone = [decided(ask(client, scored, files=[one]))["distance"] for one in burst]
        # One photo may happen to be as far away as the mean, but not all of them.
        assert max(abs(answer["distance"] - distance) for distance in alone) > 1e-4


def test_embeddings_are_averaged(client: Client, scored: str) -> None:
    rows = [embedding(client, 1, shot) for shot in range(5)]
    for count in (1, 2, 5):
        several = decided(ask(client, scored, json={"embeddings": rows[:count]}))
        mean = decided(ask(client, scored, json={"embedding": mean_of(rows[:count])}))
        assert several["decision"] == "accept"
        assert several["distance"] == pytest.approx(mean["distance"], abs=1e-5)


def test_two_people_in_one_burst_are_refused_by_number(
    client: Client, scored: str, deployment: Deployment
) -> None:
    mixed = [(1, 5), (2, 5), (1, 6), (1, 7)]
    photos = images(*(photo(*each) for each in mixed))
    rows = [embedding(client, *each) for each in mixed]
    for subject, token in (("alice", scored), ("nobody", deployment.key("verify", "embeddings"))):
        for request in ({"files": photos}, {"json": {"embeddings": rows}}):
            answer = ask(client, token, subject, **request)
            assert assert_error(answer, 422, "inconsistent_images") == {"photos": [1]}
            assert answer.json()["error"]["message"].startswith(
                "photo 2 does not look like the person on photos 1, 3 and 4;"
            )
    pair = ask(client, scored, files=photos[:2])
    assert assert_error(pair, 422, "inconsistent_images") == {"photos": [0, 1]}


def test_an_unusable_photo_refuses_the_burst_by_number(client: Client, scored: str) -> None:
    answer = ask(client, scored, files=images(BURST[0], b"no picture", BURST[1]))
    assert assert_error(answer, 400, "unsupported_image")["image"] == 1
    assert answer.json()["error"]["message"].startswith("photo 2 of 3: ")
    alone = ask(client, scored, files=images(b"no picture"))
    assert_error(alone, 400, "unsupported_image")
    assert "photo 1" not in alone.json()["error"]["message"]


def test_more_than_five_are_too_many(client: Client, scored: str) -> None:
    five = images(*(photo(1, shot) for shot in range(5)))
    assert decided(ask(client, scored, files=five))["decision"] == "accept"
    answer = ask(client, scored, files=five + five[:1])
    assert assert_error(answer, 413, "too_many_images") == {"limit": 5}
    rows = [embedding(client, 1, shot) for shot in range(6)]
    assert_error(ask(client, scored, json={"embeddings": rows}), 400, "invalid_embedding")


def test_a_burst_is_one_attempt(both: tuple[Client, Deployment]) -> None:
    client, deployment = both
    client.put("/v1/subjects/alice/enrollment", files=images(photo(1), photo(1, 1)))
    token = deployment.key("verify", "embeddings")
    stranger = images(*(photo(2, shot) for shot in (5, 6, 7)))
    rows = [embedding(client, 2, shot) for shot in (5, 6, 7)]
    for subject in ("alice", "nobody"):

        def failures(subject: str = subject) -> int:
            answer = client.get(f"/v1/subjects/{subject}/lockout")
            return int(assert_answer(answer, 200, LockoutAnswer)["consecutive_failures"])

        for number in (1, 3):
            assert decided(ask(client, token, subject, files=stranger))["decision"] == "reject"
            assert failures() == number
            # What is refused is no attempt.
            refused = ask(client, token, subject, files=images(*BURST, photo(2)))
            assert_error(refused, 422, "inconsistent_images")
            assert failures() == number
            sent = ask(client, token, subject, json={"embeddings": rows})
            assert decided(sent)["decision"] == "reject"
            assert failures() == number + 1
        ask(client, token, subject, files=stranger)
        locked = ask(client, token, subject, files=images(*BURST))
        assert_error(locked, 423, "locked_out")


def test_who_is_not_enrolled_looks_the_same_and_costs_as_many_photos(
    client: Client, deployment: Deployment, scored: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    token = deployment.key("verify")
    embed, embedded = ModelPack.embed_photo, []

    def counted(self: ModelPack, data: bytes, **options: Any) -> Any:
        embedded.append(data)
        return embed(self, data, **options)

    monkeypatch.setattr(ModelPack, "embed_photo", counted)
    burst = [photo(2, shot) for shot in (5, 6, 7)]
    for sent in (burst, [burst[0], photo(3), burst[1]]):
        answers, work = [], []
        for subject in ("alice", "nobody"):
            embedded.clear()
            answer = ask(client, token, subject, files=images(*sent)).json()
            del answer["request_id"]
            answers.append(answer)
            work.append(list(embedded))
        assert answers[0] == answers[1]
        assert work == [sent, sent]
