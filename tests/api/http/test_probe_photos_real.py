"""Bursts of real faces over REST, with both real packs."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from api.http.app import create_app
from api.http.schemas import VerifyAnswer
from api.service.opening import file_sealer, open_keyring
from models.errors import FaceError
from models.pack import ModelPack
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, deploy, images
from tests.api.real_people import calibrated_on_lfw
from tests.api.shapes import assert_answer, assert_error

pytestmark = pytest.mark.long

PEOPLE = 8
CALIBRATED = 40
DECOY_FACES = 150


@pytest.fixture(scope="module", params=["mbf_pack_dir", "yunet_pack_dir"])
def service(
    request: pytest.FixtureRequest,
    tmp_path_factory: pytest.TempPathFactory,
    lfw_photos: Path,
    lfw_aligned: Path,
) -> Iterator[tuple[Client, Deployment]]:
    """A service with a real pack, calibrated on people of LFW who are not verified here."""
    pack_dir: Path = request.getfixturevalue(request.param)
    deployment = deploy(tmp_path_factory.mktemp("real"), pack=pack_dir, lockout_after=0)
    settings = deployment.settings
    contract = calibrated_on_lfw(
        settings,
        pack_dir,
        lfw_aligned,
        without={person.name for person in lfw_photos.iterdir()},
        decoy_faces=DECOY_FACES,
        people=CALIBRATED,
        m=8,
        targets=(1e-2,),
    )
    contract.save(settings.resolved_contract_file, file_sealer(open_keyring(settings)))
    with Client(create_app(settings), headers=bearer(deployment.token)) as client:
        yield client, deployment


@pytest.fixture(scope="module")
def people(service: tuple[Client, Deployment], lfw_photos: Path) -> list[list[bytes]]:
    """Five photos each of some people; each shows one face that is clearly meant."""
    pack = service[0].app.state.runtime.pack
    photos_of = (
        [photo.read_bytes() for photo in sorted(folder.glob("*.jpg"))]
        for folder in sorted(lfw_photos.iterdir())
    )
    usable = (photos for photos in photos_of if all(is_usable(pack, each) for each in photos))
    return list(itertools.islice(usable, PEOPLE))


def is_usable(pack: ModelPack, photo: bytes) -> bool:
    try:
        pack.crop_photo(photo)
    except FaceError:
        return False
    return True


def verify(client: Client, subject: str, *photos: bytes, **options: Any) -> Any:
    return client.post(
        f"/v1/subjects/{subject}/verify",
        files=images(*photos),
        **options,
    )


def test_bursts_of_real_people(
    service: tuple[Client, Deployment], people: list[list[bytes]]
) -> None:
    """Two photos enroll, the other three are the burst; each also against the next person."""
    decisions: dict[str, list[str]] = {"genuine": [], "impostor": []}
    distances: dict[str, list[float]] = {"genuine": [], "alone": []}
    client = service[0]
    pack = client.app.state.runtime.pack
    for number, photos in enumerate(people):
        enrolled = client.put(
            f"/v1/subjects/{number}/enrollment",
            files=images(*photos[:2]),
        )
        assert enrolled.status_code == 201, enrolled.text
        probes = {"genuine": photos[2:], "impostor": people[(number + 1) % PEOPLE][2:]}
        for kind, burst in probes.items():
            answer = verify(client, str(number), *burst)
            if answer.status_code == 422:  # of LFW's years apart, one in fifty
                assert_error(answer, 422, "inconsistent_images")
                continue
            body = assert_answer(answer, 200, VerifyAnswer)
            decisions[kind].append(body["decision"])
            rows = [pack.embed_photo(photo).embedding for photo in burst]
            mean = np.sum(rows, axis=0, dtype=np.float64)
            numbers = [float(x) for x in mean / np.linalg.norm(mean)]
            sent = client.post(f"/v1/subjects/{number}/verify", json={"embedding": numbers}).json()
            assert body["distance"] == pytest.approx(sent["distance"], abs=1e-4)
            if kind == "genuine":
                distances[kind].append(body["distance"])
                alone = [verify(client, str(number), photo).json() for photo in burst]
                distances["alone"].append(np.mean([each["distance"] for each in alone]))
    assert len(decisions["genuine"]) >= PEOPLE - 1
    assert decisions["genuine"].count("reject") <= 1
    assert decisions["impostor"].count("accept") <= 1
    # What the burst is for: it is nearer to the template than its photos are. How many are rejected
    # tells nothing beyond: eight bursts resolve no rate.
    assert (np.array(distances["genuine"]) < np.array(distances["alone"])).all()


def test_a_stranger_in_a_burst_is_named(
    service: tuple[Client, Deployment], people: list[list[bytes]]
) -> None:
    client, deployment = service
    token = bearer(deployment.key("verify"))
    for number, photos in enumerate(people):
        stranger = people[(number + 1) % PEOPLE][4]
        errors = []
        for subject in (str(number), "nobody"):
            answer = verify(client, subject, photos[2], stranger, photos[3], headers=token)
            assert 1 in assert_error(answer, 422, "inconsistent_images")["photos"]
            errors.append(answer.json()["error"])
        assert errors[0] == errors[1]
