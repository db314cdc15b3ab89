"""Deployments that check liveness, challenges of theirs, and what they answer."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx

from api.http.schemas import ChallengeAnswer, VerifyAnswer
from api.service.opening import file_sealer, open_keyring
from models.pack import ModelPack
from templates.contract.document import LivenessCalibration
from tests.api.client import Client
from tests.api.deployment import RATE, Deployment, deploy, images
from tests.api.shapes import assert_answer
from tests.marked_heads import add_liveness, frame, write_marked_pack

ANNA, BEN = 1, 2


def calibrated(folder: Path, **changes: Any) -> Deployment:
    """A deployment whose contract has a liveness threshold, which it does not ask for yet."""
    pack_dir = add_liveness(write_marked_pack(folder / "pack"))
    deployment = deploy(folder, pack=pack_dir, lockout_after=0)
    graphs = ModelPack.load(pack_dir, threads=1).liveness
    assert graphs is not None
    contract = replace(
        deployment.contract,
        liveness=LivenessCalibration(
            graphs=graphs.graphs, threshold=0.5, bpcer=RATE, target_bpcer=0.01
        ),
    )
    settings = deployment.settings
    contract.save(settings.resolved_contract_file, file_sealer(open_keyring(settings)))
    return replace(deployment, settings=settings.model_copy(update=changes))


def challenge(client: Client, subject: str | None = None, **options: Any) -> dict[str, Any]:
    body = {} if subject is None else {"subject_id": subject}
    return assert_answer(client.post("/v1/challenges", json=body, **options), 200, ChallengeAnswer)


def answered(
    client: Client,
    challenge_id: str,
    frames: Sequence[bytes],
    subject: str = "anna",
    **options: Any,
) -> httpx.Response:
    answer: httpx.Response = client.post(
        f"/v1/subjects/{subject}/verify",
        files=images(*frames),
        data={"challenge_id": challenge_id},
        **options,
    )
    return answer


def frames_of(names: Sequence[str], person: int = ANNA) -> list[bytes]:
    return [frame(name, person) for name in names]


def liveness(answer: httpx.Response) -> tuple[str, str, str, str | None]:
    body = assert_answer(answer, 200, VerifyAnswer)
    return body["decision"], body["reason"], body["liveness"], body.get("liveness_failure")


PASSED = ("accept", "match", "passed", None)


def failed(why: str) -> tuple[str, str, str, str]:
    return "reject", "liveness", "failed", why
