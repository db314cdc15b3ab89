"""Every byte that the private client sends, searched for a face: real photos, a real pack.

The search is that of ``tests/leaks.py``. What it finds when a photo or a descriptor is sent on
purpose, through the same proxy, shows that it would have found one.
"""

import base64
import dataclasses
import json
import re
from dataclasses import dataclass
from pathlib import Path

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from models.decoding import decode_image
from models.errors import FaceError
from models.pack import ModelPack
from models.selection import FacePolicy
from tests.api.deployment import deploy
from tests.clients.conftest import started
from tests.clients.proxy import Proxy
from tests.leaks import LeakSearch
from veilface_client import Client, PrivateClient, Unavailable

ENROLLED = 3


@dataclass(frozen=True, repr=False)
class Traffic:
    """What was sent, and what must not be in it."""

    private: bytes
    photo: bytes
    embedding: bytes
    files: list[bytes]
    descriptors: dict[str, NDArray[np.floating]]
    search: LeakSearch
    decided: str


def somebody(people: Path, pack: ModelPack) -> tuple[list[bytes], NDArray[np.float32]]:
    """The first person whose four photos show one face each, clearly of one person."""
    for person in sorted(path for path in people.iterdir() if path.is_dir()):
        files = [path.read_bytes() for path in sorted(person.glob("*.jpg"))[: ENROLLED + 1]]
        try:
            rows = np.stack(
                [pack.embed_photo(each, policy=FacePolicy.SINGLE).embedding for each in files]
            )
        except FaceError:
            continue
        if (rows @ rows.T).min() > 0.6:
            return files, rows
    pytest.fail("nobody is alone in four photos")


@pytest.fixture(scope="module")
def traffic(
    tmp_path_factory: pytest.TempPathFactory, mbf_pack_dir: Path, lfw_photos: Path
) -> Traffic:
    folder = tmp_path_factory.mktemp("leaves")
    pack = ModelPack.load(mbf_pack_dir, threads=1)
    files, rows = somebody(lfw_photos, pack)
    deployment = deploy(folder, pack=mbf_pack_dir)
    deployment.allow_templates()
    settings = deployment.settings.model_copy(update={"pack": None})
    with (
        started(dataclasses.replace(deployment, settings=settings), folder) as service,
        Proxy(service.port) as proxy,
    ):
        with PrivateClient(proxy.url, deployment.token, pack=mbf_pack_dir) as client:
            client.enroll("someone", files[:ENROLLED])
            decided = client.verify("someone", files[ENROLLED]).reason
            client.page()
            client.erase("someone")
        private = proxy.taken()
        with Client(proxy.url, deployment.token) as careless, pytest.raises(Unavailable):
            careless.verify("someone", files[ENROLLED])
        photo = proxy.taken()
        httpx.post(
            f"{proxy.url}/v1/subjects/someone/verify",
            headers={"Authorization": f"Bearer {deployment.token}"},
            json={"embedding": [float(number) for number in rows[ENROLLED]]},
        )
        embedding = proxy.taken()
    mean = rows[:ENROLLED].mean(axis=0)
    descriptors = {f"descriptor {i}": row for i, row in enumerate(rows)} | {
        "plain mean": mean,
        "descriptor that was lifted": mean / np.linalg.norm(mean),
    }
    crops = [pack.crop_photo(each, policy=FacePolicy.SINGLE, quality=None).crop for each in files]
    strings = {
        name: content
        for i, (file, crop) in enumerate(zip(files, crops, strict=True))
        for name, content in (
            (f"photo {i}", file),
            (f"pixels {i}", decode_image(file).tobytes()),
            (f"crop {i}", crop.tobytes()),
        )
    }
    search = LeakSearch(vectors=descriptors, strings=strings)
    return Traffic(private, photo, embedding, files, descriptors, search, decided)


def test_the_traffic_is_all_there(traffic: Traffic) -> None:
    """An empty recording would leak nothing either."""
    # The thresholds of this contract are made up: what matters is that it was decided.
    assert traffic.decided in ("match", "no_match")
    methods = re.findall(rb"([A-Z]+) /v1/\S+ HTTP/1\.1\r\n", traffic.private)
    assert methods == [b"GET", b"GET", b"PUT", b"POST", b"GET", b"DELETE"]
    assert traffic.private.count(b'{"template":"') == 2


def test_nothing_of_a_face_leaves(traffic: Traffic) -> None:
    assert traffic.search.find(traffic.private) == []


def test_an_enrollment_and_a_probe_are_what_left(traffic: Traffic) -> None:
    """And of the right size: no room in them for a photo."""
    bodies = [json.loads(body) for body in re.findall(rb'\{"template":"[^}]*\}', traffic.private)]
    assert [sorted(body) for body in bodies] == [["template"], ["template"]]
    assert all(len(base64.b64decode(body["template"])) < 40_000 for body in bodies)


def test_a_photo_that_is_sent_is_found(traffic: Traffic) -> None:
    found = {leak.what for leak in traffic.search.find(traffic.photo)}
    # JPEG files of one encoder share their tables: other photos' heads may be found in this one.
    assert f"photo {ENROLLED}" in found
    assert all(what.startswith("photo ") for what in found)


def test_a_descriptor_that_is_sent_is_found(traffic: Traffic) -> None:
    found = traffic.search.find(traffic.embedding)
    assert {leak.what for leak in found} == {f"descriptor {ENROLLED}"}
    assert {leak.form for leak in found} == {"decimals"}


NAMES = [*(f"descriptor {i}" for i in range(ENROLLED + 1)), "plain mean"]
NAMES.append("descriptor that was lifted")
