"""POST /v1/photos/check: enrollment's detector and limits, no embedding, nothing kept."""

import io
import sqlite3
from typing import Any

import numpy as np
import pytest
from PIL import Image

from api.http.schemas import PhotoCheckAnswer
from models.embedding import Embedder
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, images, photo
from tests.api.shapes import assert_answer, assert_error

PATH = "/v1/photos/check"


def grey(level: int) -> bytes:
    """A picture of the right shape without any detail."""
    out = io.BytesIO()
    Image.new("RGB", (112, 112), (level, level, level)).save(out, "PNG")
    return out.getvalue()


def test_a_photo_that_would_do(client: Client) -> None:
    body = assert_answer(
        client.post(PATH, files=images(photo(1), name="image")), 200, PhotoCheckAnswer
    )
    assert body["usable"] is True
    assert body["code"] is None
    assert body["box"] is None  # this pack has no detector
    assert body["message"] == "an aligned crop of a face, clear enough"
    assert body["quality"]["sharpness"] > 0.5


def test_a_photo_that_would_not_do_says_what_an_enrollment_says(client: Client) -> None:
    body = assert_answer(
        client.post(PATH, files=images(grey(5), name="image")), 200, PhotoCheckAnswer
    )
    refused = client.put("/v1/subjects/dark/enrollment", files=images(grey(5)))
    details = assert_error(refused, 422, "low_quality")
    assert body["usable"] is False
    assert body["code"] == "low_quality"
    assert set(body["details"]) == {"blur", "darkness"}
    assert {"image": 0, **body["details"]} == details


def test_it_embeds_nothing_and_keeps_nothing(
    client: Client, deployment: Deployment, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: Any, **__: Any) -> np.ndarray:
        raise AssertionError("a check embedded the photo")

    def rows() -> dict[str, list[Any]]:
        with sqlite3.connect(deployment.settings.data_dir / "veilface.db") as database:
            return {
                table: database.execute(f"SELECT count(*) FROM {table}").fetchall()
                for table in ("subjects", "audit_log", "failed_attempts")
            }

    before = rows()
    monkeypatch.setattr(Embedder, "embed", never)
    for one in (photo(2), grey(5)):
        assert client.post(PATH, files=images(one, name="image")).status_code == 200
    assert rows() == before


def test_who_may_ask(client: Client, deployment: Deployment) -> None:
    for rights, status in (("enroll", 200), ("verify", 200), ("erase", 403), ("admin", 403)):
        answer = client.post(
            PATH, files=images(photo(1), name="image"), headers=bearer(deployment.key(rights))
        )
        assert answer.status_code == status
    assert assert_error(answer, 403, "forbidden") == {"missing": ["enroll", "verify"]}
    nobody = client.post(PATH, files=images(photo(1), name="image"), headers={"Authorization": ""})
    assert_error(nobody, 401, "unauthorized")
