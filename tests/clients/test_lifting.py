"""What the private client does when contracts change, and when what it lifts with is no use.

A scripted service answers: for what real ones do not show. ``test_private.py`` has the real ones.
"""

import asyncio
import dataclasses
import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from pydantic import ValidationError

from models.pack import ModelPack
from templates.contract import wire
from templates.contract.binding import Binding
from templates.decoys import DecoyGenerator
from templates.keys.rotation import ROTATION_VERSION
from templates.space.lifting import Strategy
from tests.api.deployment import make_source, photo, write_pack
from veilface_client import (
    AsyncPrivateClient,
    ConnectionFailed,
    ContractMismatch,
    Enrollable,
    LiftFailed,
    LiftUnavailable,
    PrivateClient,
    Probe,
    Retries,
    Unavailable,
    UnexpectedAnswer,
    results,
)
from veilface_client.calls import Face
from veilface_client.lifting import Lifter

TOKEN = f"vf_{'0' * 12}_{'5e' * 32}"
CONTRACTS = ("a" * 64, "b" * 64)


@dataclasses.dataclass
class Inputs:
    """What lifting under a contract would need."""

    contract_id: str


class Lifts:
    """Stands in for lifting: each lift is the contract's id and its own number."""

    def __init__(self) -> None:
        self.inputs: Inputs | None = None
        self.made: list[tuple[str, list[bytes], Face | None]] = []

    def keep(self, contract: results.Contract, generator: results.Generator) -> Inputs:
        self.inputs = Inputs(contract.contract_id)
        return self.inputs

    def enrollment(
        self, inputs: Inputs, photos: Sequence[bytes], *, face: Face | None
    ) -> Enrollable:
        return Enrollable.of(self._lifted("enrollment", photos, face), inputs.contract_id)

    def probe(self, inputs: Inputs, photos: Sequence[bytes], *, face: Face | None) -> Probe:
        return Probe.of(self._lifted("probe", photos, face), inputs.contract_id)

    def _lifted(self, kind: str, photos: Sequence[bytes], face: Face | None) -> bytes:
        self.made.append((kind, list(photos), face))
        return f"lift {len(self.made)}".encode()


@dataclasses.dataclass
class Changing:
    """A service whose contract changes as often as it is told, before a template arrives."""

    changes: int = 0
    stale_generators: int = 0
    refuse_always: bool = False
    contract: int = 0
    lost: int = 0
    overloaded: int = 0
    bodies: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    paths: list[str] = dataclasses.field(default_factory=list)

    def __call__(self, request: httpx.Request) -> httpx.Response:
        path = request.url.path
        self.paths.append(path)
        current = CONTRACTS[self.contract % 2]
        if path == "/v1/contract":
            return httpx.Response(200, json=contract_answer(current))
        if path == "/v1/contract/generator":
            stale = self.stale_generators > 0
            self.stale_generators -= stale
            named = "other" if stale else f"source-{current}"
            return httpx.Response(200, content=b"G", headers={"X-Decoy-Source-ID": named})
        body = json.loads(request.read())
        self.bodies.append(body)
        if self.changes:
            self.changes -= 1
            self.contract += 1
            return mismatch()
        if self.refuse_always:
            return mismatch()
        if self.overloaded:
            self.overloaded -= 1
            error = {"code": "overloaded", "message": "m", "details": {}}
            return httpx.Response(503, json={"error": error, "request_id": "r"})
        if self.lost:
            self.lost -= 1
            raise httpx.ReadError("broken")
        answer = {"contract_id": current, "request_id": "r"}
        if path.endswith("/enrollment"):
            return httpx.Response(
                201, json={**answer, "template_id": "t", "replaced": False, "images": []}
            )
        decided = {"decision": "accept", "reason": "match", "level": "l", "calibration_id": "k"}
        return httpx.Response(200, json={**answer, **decided})


def contract_answer(contract_id: str) -> dict[str, Any]:
    return {
        "contract_id": contract_id,
        "binding": {"decoy_source_id": f"source-{contract_id}"},
        "calibrations": [],
        "default_level": "l",
        "photos": False,
        "generator": True,
        "receipt_key": {"algorithm": "Ed25519", "key_id": "k", "public_key": "p"},
        "request_id": "r",
    }


def mismatch() -> httpx.Response:
    error = {"code": "contract_mismatch", "message": "m", "details": {}}
    return httpx.Response(409, json={"error": error, "request_id": "r"})


Make = Callable[..., PrivateClient]


@pytest.fixture
def lifts(monkeypatch: pytest.MonkeyPatch) -> Lifts:
    """What clients of this test lift with."""
    made = Lifts()
    for module in ("client", "async_client"):
        monkeypatch.setattr(f"veilface_client.{module}.Lifter", lambda pack, *, dim: made)
    return made


@pytest.fixture
def make() -> Iterator[Make]:
    """Private clients of a scripted service, closed at the end."""
    made: list[PrivateClient] = []

    def client(service: Callable[[httpx.Request], httpx.Response]) -> PrivateClient:
        made.append(
            PrivateClient(
                "http://service.test",
                TOKEN,
                pack="pack",
                transport=httpx.MockTransport(service),
                retries=Retries(first_s=0.0),
            )
        )
        return made[-1]

    yield client
    for each in made:
        each.close()


def test_a_contract_that_changed_is_fetched_once_more(make: Make, lifts: Lifts) -> None:
    service = Changing(changes=1)
    client = make(service)
    assert client.enroll("anna", b"photo").contract_id == CONTRACTS[1]
    assert service.paths.count("/v1/contract") == 2
    assert len(lifts.made) == 2
    service.changes = 1
    assert client.verify("anna", b"photo").contract_id == CONTRACTS[0]
    assert service.paths.count("/v1/contract") == 3

    service.changes = 2
    with pytest.raises(ContractMismatch):
        client.enroll("anna", b"photo")
    assert len(lifts.made) == 6


def test_no_second_lift_where_the_contract_is_the_same(make: Make, lifts: Lifts) -> None:
    """The subject's stored template is of another contract: lifting again heals nothing."""
    service = Changing(refuse_always=True)
    client = make(service)
    for call in (lambda: client.enroll("anna", b"p"), lambda: client.verify("anna", b"p")):
        with pytest.raises(ContractMismatch):
            call()
    assert len(lifts.made) == 2


def test_a_resend_repeats_the_template_and_never_lifts_again(make: Make, lifts: Lifts) -> None:
    service = Changing(lost=2)
    make(service).enroll("anna", b"photo")
    assert len(service.bodies) == 3
    assert service.bodies[0] == service.bodies[1] == service.bodies[2]
    assert len(lifts.made) == 1


def test_a_probe_is_sent_again_only_where_it_was_not_decided(make: Make, lifts: Lifts) -> None:
    service = Changing(overloaded=2)
    client = make(service)
    assert client.verify("anna", b"photo")
    assert len(service.bodies) == 3
    assert service.bodies[0] == service.bodies[1] == service.bodies[2]
    assert len(lifts.made) == 1

    service.bodies.clear()
    service.lost = 1
    with pytest.raises(ConnectionFailed):
        client.verify("anna", b"photo")
    assert len(service.bodies) == 1, "it may have been decided"


def test_after_a_lost_answer_the_lift_is_repeated(make: Make, lifts: Lifts) -> None:
    service = Changing(lost=4)
    client = make(service)
    with pytest.raises(ConnectionFailed) as failed:
        client.enroll("anna", b"photo")
    lift = failed.value.lift
    assert isinstance(lift, Enrollable)
    assert "never with the photo" in failed.value.__notes__[0]
    assert client.enroll("anna", lift)
    assert len(service.bodies) == 5
    assert all(body == service.bodies[0] for body in service.bodies)
    assert len(lifts.made) == 1

    service.lost = 1
    with pytest.raises(ConnectionFailed) as failed:
        client.verify("anna", b"photo")
    probe = failed.value.lift
    assert isinstance(probe, Probe)
    assert client.verify("anna", probe)
    assert service.bodies[-1]["template"] == service.bodies[-2]["template"]
    assert len(lifts.made) == 2


def test_the_same_asynchronously(lifts: Lifts) -> None:
    service = Changing(lost=2)

    async def scenario() -> None:
        async with AsyncPrivateClient(
            "http://service.test",
            TOKEN,
            pack="pack",
            transport=httpx.MockTransport(service),
            retries=Retries(sendings=1),
        ) as client:
            lift = await client.lift_enrollment(b"photo")
            for _ in range(2):
                with pytest.raises(ConnectionFailed) as failed:
                    await client.enroll("anna", lift)
                assert failed.value.lift is lift
            assert await client.enroll("anna", lift)

    asyncio.run(scenario())
    assert len(service.bodies) == 3
    assert len(lifts.made) == 1


def test_a_lift_is_sent_as_often_as_it_must_and_never_made_again(make: Make, lifts: Lifts) -> None:
    service = Changing()
    client = make(service)
    lift = client.lift_enrollment([b"one", b"two"], face="largest")
    assert service.bodies == [], "nothing of it is sent"
    assert lifts.made == [("enrollment", [b"one", b"two"], "largest")]
    for subject in ("anna", "anna", "bert"):
        client.enroll(subject, lift)
    assert len({body["template"] for body in service.bodies}) == 1
    with pytest.raises(ValidationError):
        lift.template = b"other"  # type: ignore[misc]

    service.changes = 1
    with pytest.raises(ContractMismatch) as failed:
        client.enroll("anna", lift)
    assert failed.value.lift is None, "repeating it heals nothing"
    assert len(lifts.made) == 1


def test_what_was_not_done_is_repeated_with_the_lift_too(make: Make, lifts: Lifts) -> None:
    service = Changing(overloaded=4)
    client = make(service)
    with pytest.raises(Unavailable) as failed:
        client.verify("anna", b"photo")
    assert isinstance(failed.value.lift, Probe)
    assert client.verify("anna", failed.value.lift)
    assert len(lifts.made) == 1


def test_a_generator_of_another_contract(make: Make, lifts: Lifts) -> None:
    make(Changing(stale_generators=2)).enroll("anna", b"photo")
    lifts.inputs = None
    with pytest.raises(UnexpectedAnswer, match="generator"):
        make(Changing(stale_generators=3)).enroll("anna", b"photo")
    assert len(lifts.made) == 1


SOURCE = make_source()


@pytest.fixture(scope="module")
def pack(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pack of :func:`answers`."""
    return write_pack(tmp_path_factory.mktemp("lifting") / "tiny")


def answers(
    pack: Path, *, dims: Sequence[int] = (2, 4), **changes: Any
) -> tuple[results.Contract, results.Generator]:
    """Contract and generator of 40 axes, as a service answers them."""
    info = ModelPack.load(pack, threads=1).info
    decoys = SOURCE.reduced(40)
    binding = Binding(
        **{
            "embedder_sha256": info.embedder_sha256,
            "preprocessing": info.preprocessing,
            "n": info.n,
            "axes": decoys.k,
            "strategy": Strategy.ADVERSARIAL,
            "m": 8,
            "decoy_source_id": decoys.source_id,
            "rotation_version": ROTATION_VERSION,
            **changes,
        }
    )
    body = contract_answer(binding.contract_id) | {
        "binding": binding.to_json(),
        "calibrations": [{"mode": "s2s", "probe_m": m} for m in dims],
        "photo_consistency": 0.2,
        "probe_consistency": 0.1,
    }
    raw = json.dumps(body).encode()
    contract = results.Contract.model_validate_json(raw).model_copy(update={"raw": raw})
    return contract, results.Generator(data=decoys.to_bytes(), source_id=decoys.source_id)


def test_lifts_hold_the_projection_of_the_photos_mean(pack: Path) -> None:
    lifter = Lifter(pack, dim=None)
    contract, generator = answers(pack)
    inputs = lifter.keep(contract, generator)
    assert lifter.keep(contract, generator) is inputs
    photos = [photo(1, 0), photo(1, 1)]
    models = ModelPack.load(pack, threads=1)
    mean = sum(models.embed_photo(each).embedding for each in photos)
    point = SOURCE.reduced(40).project((mean / np.linalg.norm(mean))[None])
    lifted = [lifter.enrollment(inputs, photos, face=None), lifter.probe(inputs, photos, face=None)]
    lifted.append(Lifter(pack, dim=2).probe(inputs, photos, face="largest"))
    for lift, m in zip(lifted, (8, 4, 2), strict=True):
        received = wire.decode(lift.template)
        assert received.contract_id == lift.contract_id == contract.contract_id
        assert (received.subspace.n, received.subspace.m) == (40, m)
        assert received.subspace.contains(point, tol=2e-3).all()


def test_what_does_not_serve_is_said_without_a_lift(pack: Path, tmp_path: Path) -> None:
    contract, generator = answers(pack)
    broken = contract.model_copy(update={"raw": contract.raw.replace(b'"m": 8', b'"m": 7')})
    fewer = SOURCE.reduced(39)
    other = DecoyGenerator(SOURCE.axes, -SOURCE.mean, SOURCE.root)
    foreign, short = (
        results.Generator(data=each.to_bytes(), source_id=each.source_id) for each in (other, fewer)
    )
    cases = [
        (pack, broken, generator, "contract_id"),
        (pack, contract, foreign, "bound to the decoy source"),
        (pack, contract, short, "40 were asked for"),
        (pack, contract, results.Generator(data=b"G", source_id="s"), "truncated"),
        (pack, *answers(pack, n=65), "the pack gives 64"),
        (tmp_path / "absent", contract, generator, "absent"),
    ]
    for folder, public, decoys, said in cases:
        with pytest.raises(LiftFailed, match=said):
            Lifter(folder, dim=None).keep(public, decoys)

    def refused(photos: Sequence[bytes], dim: int | None = None, **changes: Any) -> str:
        lifter = Lifter(pack, dim=dim)
        with pytest.raises(LiftFailed) as failed:
            lifter.probe(lifter.keep(*answers(pack, **changes)), photos, face=None)
        return failed.value.message

    assert "of dimension 2, 4, not 5" in refused([photo(1)], 5)
    assert "no lifted probes" in refused([photo(1)], dims=())
    assert refused([photo(1), b"no picture"]).startswith("photo 2 of 2: ")
    assert refused([photo(1), photo(2)]).startswith("photos 1 and 2 do not look like")
    assert "1 to 10 photos, not 11" in refused([photo(1, shot) for shot in range(11)])


def test_without_the_library(monkeypatch: pytest.MonkeyPatch, pack: Path) -> None:
    monkeypatch.setitem(sys.modules, "enroll.public_contract", None)
    with pytest.raises(LiftUnavailable, match="call no package of yours"):
        Lifter(pack, dim=None).keep(*answers(pack))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(LiftUnavailable, match=r"veilface-client\[private\]"):
        PrivateClient("http://service.test", TOKEN, pack=pack)


def test_a_program_s_own_package_of_the_same_name_is_told(tmp_path: Path) -> None:
    (tmp_path / "models.py").write_text("")
    script = """
import models
from veilface_client import LiftUnavailable, results
from veilface_client.lifting import Lifter
contract = results.Contract.model_construct(contract_id="c", raw=b"{}")
try:
    Lifter("pack", dim=None).keep(contract, results.Generator(data=b"", source_id="s"))
except LiftUnavailable as error:
    print(error)
"""
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "call no package of yours enroll, models or templates" in done.stdout


def test_a_probe_prints_its_size_alone() -> None:
    assert repr(Probe(template=b"12345", contract_id="c")) == "<Probe of 5 bytes>"
