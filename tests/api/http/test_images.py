"""Photos without one usable face through the API: the right code each, and no 5xx."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from api.http.app import create_app
from tests.api.awkward import Case, encode, scenes
from tests.api.client import Client
from tests.api.deployment import (
    bearer,
    deploy,
    images,
    photo,
    picture,
)
from tests.api.shapes import assert_error
from tests.models.pictures import png


def code_of(answer: Any) -> str:
    """``ok`` or the error's code; every error must have the one shape."""
    if answer.status_code in (200, 201):
        return "ok"
    code = str(answer.json()["error"]["code"])
    assert_error(answer, answer.status_code, code)
    assert answer.status_code < 500
    return code


def verify(client: Client, sent: bytes, **options: Any) -> Any:
    return client.post("/v1/subjects/a/verify", files=images(sent, name="image"), **options)


def failures(client: Client, cases: list[Case]) -> list[str]:
    """What was answered to cases that may not be answered so."""
    wrong = []
    for case in cases:
        code = code_of(verify(client, case.data))
        if code not in case.codes:
            wrong.append(f"{case.name}: {code}, expected {sorted(case.codes)}")
    return wrong


def encoded(pixels: np.ndarray[Any, Any]) -> bytes:
    return encode(pixels, "PNG")


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (b"", "unsupported_image"),
        (b"http://127.0.0.1/face.jpg", "unsupported_image"),
        (photo(1)[:500], "unsupported_image"),
        (encode(picture(1), "GIF"), "unsupported_image"),
        (png(65_535, 65_535), "image_too_large"),
    ],
)
def test_what_cannot_be_read_has_its_code(client: Client, data: bytes, code: str) -> None:
    """What else is refused, and in how much memory, is the decoder's (``tests/models``)."""
    assert code_of(client.put("/v1/subjects/a/enrollment", files=images(data))) == code


@pytest.fixture(scope="module")
def faces(lfw_photos: Path) -> list[np.ndarray[Any, Any]]:
    """One photo each of two people, and a second one of the first."""
    people = sorted(path for path in lfw_photos.iterdir() if path.is_dir())
    files = [sorted(people[0].iterdir())[0], sorted(people[1].iterdir())[0]]
    files.append(sorted(people[0].iterdir())[1])
    return [np.asarray(Image.open(path).convert("RGB")) for path in files]


@pytest.fixture(scope="module")
def real(
    tmp_path_factory: pytest.TempPathFactory,
    mbf_pack_dir: Path,
    faces: list[np.ndarray[Any, Any]],
) -> Iterator[Client]:
    """With a real detector and a real embedder; the thresholds are not calibrated."""
    deployment = deploy(tmp_path_factory.mktemp("real"), pack=mbf_pack_dir, lockout_after=0)
    with Client(create_app(deployment.settings), headers=bearer(deployment.token)) as client:
        put = client.put("/v1/subjects/a/enrollment", files=images(encoded(faces[0])))
        assert put.status_code == 201, put.text
        yield client


def test_scenes_without_one_usable_face(real: Client, faces: list[np.ndarray[Any, Any]]) -> None:
    assert failures(real, list(scenes(faces[0], faces[1]))) == []


def test_the_largest_face_is_taken_when_asked_for(
    real: Client, faces: list[np.ndarray[Any, Any]]
) -> None:
    height, width = faces[0].shape[:2]
    small = np.asarray(Image.fromarray(faces[1]).resize((width * 4 // 5, height * 4 // 5)))
    scene = np.full((height * 5 // 2, width * 5 // 2, 3), 127, np.uint8)
    top, left = height * 3 // 4, width * 3 // 4
    scene[top : top + height, left : left + width] = faces[0]
    scene[: small.shape[0], : small.shape[1]] = small
    data = encoded(scene)
    assert code_of(verify(real, data)) == "multiple_faces"
    assert verify(real, data, data={"face": "largest"}).json()["decision"] == "accept"


@pytest.mark.long
def test_enrolling_awkward_photos_changes_nothing(
    real: Client, faces: list[np.ndarray[Any, Any]]
) -> None:
    before = real.get("/v1/subjects/a").json()
    seen: Counter[str] = Counter()
    for case in scenes(faces[0], faces[1]):
        answer = real.put("/v1/subjects/a/enrollment", files=images(encoded(faces[0]), case.data))
        code = code_of(answer)
        assert code in case.codes
        assert answer.json()["error"]["details"]["image"] == 1
        seen[code] += 1
        if case.name == "out of focus":
            assert "blur" in answer.json()["error"]["details"]
        if case.name == "in the dark":
            assert "darkness" in answer.json()["error"]["details"]
    assert {"no_face", "multiple_faces", "low_quality"} <= set(seen)
    after = real.get("/v1/subjects/a").json()
    assert {**before, "request_id": ""} == {**after, "request_id": ""}
