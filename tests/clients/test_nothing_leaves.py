"""Every byte that the private client sends, searched for a face: real photos, a real pack.

What the search finds when a photo or an embedding is sent on purpose, through the same proxy, shows
that it would have found one.
"""

import dataclasses
from pathlib import Path

import httpx
import numpy as np
import pytest

from models.errors import FaceError
from models.pack import ModelPack
from models.selection import FacePolicy
from tests.api.deployment import deploy
from tests.clients.conftest import started
from tests.clients.proxy import Proxy
from tests.clients.recorded import faces_of, requests_in
from veilface_client import Client, PrivateClient, Unavailable

ENROLLED = 3


def somebody(people: Path, pack: ModelPack) -> list[Path]:
    """Four photos of the first person who is alone and clearly the same in them."""
    for person in sorted(path for path in people.iterdir() if path.is_dir()):
        files = sorted(person.glob("*.jpg"))[: ENROLLED + 1]
        try:
            rows = np.stack(
                [
                    pack.embed_photo(each.read_bytes(), policy=FacePolicy.SINGLE).embedding
                    for each in files
                ]
            )
        except FaceError:
            continue
        if (rows @ rows.T).min() > 0.6:
            return files
    pytest.fail("nobody is alone in four photos")


def test_nothing_of_a_face_leaves(tmp_path: Path, mbf_pack_dir: Path, lfw_photos: Path) -> None:
    pack = ModelPack.load(mbf_pack_dir, threads=1)
    files = somebody(lfw_photos, pack)
    probe = files[ENROLLED]
    deployment = deploy(tmp_path, pack=mbf_pack_dir)
    deployment.allow_templates()
    packless = deployment.settings.model_copy(update={"pack": None})
    with (
        started(dataclasses.replace(deployment, settings=packless), tmp_path) as service,
        Proxy(service.port) as proxy,
    ):
        with PrivateClient(proxy.url, deployment.token, pack=mbf_pack_dir) as client:
            client.enroll("someone", files[:ENROLLED])
            # The thresholds of this contract are made up: what matters is that it was decided.
            assert client.verify("someone", probe).reason in ("match", "no_match")
            client.erase("someone")
        private = proxy.taken()
        with Client(proxy.url, deployment.token) as careless, pytest.raises(Unavailable):
            careless.verify("someone", probe)
        photo = proxy.taken()
        httpx.post(
            f"{proxy.url}/v1/subjects/someone/verify",
            headers={"Authorization": f"Bearer {deployment.token}"},
            json={"embedding": pack.embed_photo(probe.read_bytes()).embedding.tolist()},
        )
        embedding = proxy.taken()

    calls, rest = requests_in(private)
    assert rest == 0
    assert list(calls) == [
        "DELETE /v1/subjects/*",
        "GET /v1/contract",
        "GET /v1/contract/generator",
        "POST /v1/subjects/*/verify",
        "PUT /v1/subjects/*/enrollment",
    ]
    for call in ("POST /v1/subjects/*/verify", "PUT /v1/subjects/*/enrollment"):
        assert (calls[call]["times"], calls[call]["members"]) == (1, ["template"])
    search = faces_of(pack, {"someone": files[:ENROLLED]}, {probe.name: probe.read_bytes()})
    assert search.find(private) == []
    # JPEG files of one encoder share their tables: other photos' heads may be found in this one.
    assert f"photo {probe.name}" in {leak.what for leak in search.find(photo)}
    assert {leak.what for leak in search.find(embedding)} == {f"embedding {probe.name}"}
