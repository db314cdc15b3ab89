"""The policy that asks for photos that look live, over REST; before a black wall none does."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from api.http.app import create_app
from api.http.errors import StartError
from api.service.runtime import Runtime
from api.settings import LivenessPolicy
from tests.api.client import Client
from tests.api.deployment import bearer, deploy, images
from tests.api.living import (
    ANNA,
    PASSED,
    answered,
    calibrated,
    challenge,
    failed,
    liveness,
)
from tests.api.service.test_metrics import Rise
from tests.heads import POSES, head, performed
from tests.marked_heads import add_liveness, draw, encoded, write_marked_pack

PASSIVE = failed("passive")


def shown(pose: str = "front", *, dark: bool = False, roll: float = 0.0) -> bytes:
    points = head(**{"roll": roll, **POSES[pose]})
    return encoded(draw(points, ANNA, background=0 if dark else 120))


def serve(folder: Path, policy: str) -> Iterator[Client]:
    deployment = calibrated(folder, liveness=LivenessPolicy(policy))
    with Client(create_app(deployment.settings)) as client:
        client.headers.update(bearer(deployment.token))
        put = client.put("/v1/subjects/anna/enrollment", files=images(shown()))
        assert put.status_code == 201, put.text
        yield client


@pytest.fixture(scope="module")
def passive(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    yield from serve(tmp_path_factory.mktemp("passive"), "passive")


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    yield from serve(tmp_path_factory.mktemp("both"), "both")


def verified(client: Client, *photos: bytes) -> Any:
    return client.post("/v1/subjects/anna/verify", files=images(*photos))


def test_photos_that_look_live_pass_and_others_are_rejected(passive: Client) -> None:
    assert liveness(verified(passive, shown())) == PASSED
    rise = Rise(passive)
    assert liveness(verified(passive, shown(dark=True))) == PASSIVE
    labels = {"decision": "reject", "level": "fmr-1e-3", "probe": "photo"}
    assert rise("veilface_decisions_total", reason="liveness", **labels) == 1
    assert rise("veilface_decisions_total", reason="no_match", **labels) == 0


def test_several_photos_count_by_their_mean(passive: Client) -> None:
    live, dark = ([shown(dark=dark, roll=roll) for roll in (0, 2)] for dark in (False, True))
    assert liveness(verified(passive, *live, dark[0])) == PASSED
    assert liveness(verified(passive, live[0], *dark)) == PASSIVE


def test_frames_are_held_against_both(passive: Client, both: Client) -> None:
    for client in (passive, both):
        asked = challenge(client)
        names = performed(asked["movements"])
        frames = [shown(name) for name in names]
        assert liveness(answered(client, asked["challenge_id"], frames)) == PASSED
        asked = challenge(client)
        dark = [shown(name, dark=True) for name in performed(asked["movements"])]
        assert liveness(answered(client, asked["challenge_id"], dark)) == PASSIVE
        asked = challenge(client)
        still = [shown()] * 5
        assert liveness(answered(client, asked["challenge_id"], still)) == failed("no_turn")
    answer = verified(both, shown())
    assert answer.status_code == 403
    assert answer.json()["error"]["details"] == {"liveness": "both"}


def test_a_threshold_of_other_graphs_does_not_start(tmp_path: Path) -> None:
    deployment = calibrated(tmp_path, liveness=LivenessPolicy.PASSIVE)
    pack_file = tmp_path / "pack" / "pack.toml"
    pack_file.write_text(pack_file.read_text().replace("crop_scale = 2.7", "crop_scale = 2.0"))
    with pytest.raises(StartError, match="belongs to other liveness graphs"):
        Runtime.open(deployment.settings)


def test_a_contract_without_a_threshold_does_not_start(tmp_path: Path) -> None:
    pack = add_liveness(write_marked_pack(tmp_path / "pack"))
    settings = deploy(tmp_path, pack=pack).settings.model_copy(
        update={"liveness": LivenessPolicy.PASSIVE}
    )
    with pytest.raises(StartError, match="veilface calibrate --liveness"):
        Runtime.open(settings)
