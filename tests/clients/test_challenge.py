"""The client answers a challenge of a running service that asks for one."""

from collections.abc import Iterator

import pytest

from tests.api.deployment import deploy
from tests.clients.conftest import Running, started
from tests.heads import performed
from tests.marked_heads import frame, write_marked_pack
from veilface_client import Client


@pytest.fixture(scope="module")
def asking(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    folder = tmp_path_factory.mktemp("asking")
    pack = write_marked_pack(folder / "pack")
    with started(deploy(folder, pack=pack, liveness="active"), folder) as running:
        yield running


def test_frames_answer_a_challenge(asking: Running) -> None:
    with Client(asking.url, asking.deployment.token) as client:
        client.enroll("anna", frame())
        challenge = client.challenge("anna")
        frames = [frame(name) for name in performed(challenge.movements)]
        decision = client.verify("anna", frames, challenge=challenge)
        assert decision
        assert (decision.liveness, decision.liveness_failure) == ("passed", None)
        still = client.verify("anna", [frame()] * 5, challenge=client.challenge())
        assert not still
        assert (still.reason, still.liveness_failure) == ("liveness", "no_turn")
