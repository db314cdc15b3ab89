"""What the private client lifts and sends, when contracts change, answers are lost, or inputs fail.

A scripted service answers: for what real ones do not show. ``test_private.py`` has the real ones.
"""

import base64
import dataclasses
import json
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from models.pack import ModelPack
from templates.contract import wire
from templates.contract.binding import Binding
from templates.decoys import DecoyGenerator
from templates.keys.rotation import ROTATION_VERSION
from templates.space.lifting import Strategy
from tests.api.deployment import make_source, photo, write_pack
from veilface_client import (
    ConnectionFailed,
    ContractMismatch,
    Enrollable,
    LiftFailed,
    PrivateClient,
    Probe,
    Retries,
    Unavailable,
    UnexpectedAnswer,
    results,
)
from veilface_client.lifting import Lifter

TOKEN = f"vf_{'0' * 12}_{'5e' * 32}"
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
    body = {
        "contract_id": binding.contract_id,
        "binding": binding.to_json(),
        "calibrations": [{"mode": "s2s", "probe_m": m} for m in dims],
        "photo_consistency": 0.2,
        "probe_consistency": 0.1,
        "default_level": "l",
        "photos": False,
        "generator": True,
        "receipt_key": {"algorithm": "Ed25519", "key_id": "k", "public_key": "p"},
        "request_id": "r",
    }
    contract = results.Contract.read(httpx.Response(200, json=body))
    return contract, results.Generator(data=decoys.to_bytes(), source_id=decoys.source_id)


@dataclasses.dataclass
class Scripted:
    """A service of two contracts: each time a template is refused it changes to the other one."""

    contracts: Sequence[tuple[results.Contract, results.Generator]]
    changes: int = 0
    stale_generators: int = 0
    current: int = 0
    lost: int = 0
    overloaded: int = 0
    bodies: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    fetched: int = 0

    @property
    def lifts(self) -> int:
        """How many lifts arrived: no two are equal."""
        return len({body["template"] for body in self.bodies})

    def refusal(self, status: int, code: str) -> httpx.Response:
        error = {"code": code, "message": "m", "details": {}}
        return httpx.Response(status, json={"error": error, "request_id": "r"})

    def __call__(self, request: httpx.Request) -> httpx.Response:
        path = request.url.path
        contract, generator = self.contracts[self.current % 2]
        if path == "/v1/contract":
            self.fetched += 1
            return httpx.Response(200, content=contract.raw)
        if path == "/v1/contract/generator":
            stale = self.stale_generators > 0
            self.stale_generators -= stale
            name = "other" if stale else generator.source_id
            return httpx.Response(200, content=generator.data, headers={"X-Decoy-Source-ID": name})
        self.bodies.append(json.loads(request.read()))
        if self.changes:
            self.changes -= 1
            self.current += 1
            return self.refusal(409, "contract_mismatch")
        if self.overloaded:
            self.overloaded -= 1
            return self.refusal(503, "overloaded")
        if self.lost:
            self.lost -= 1
            raise httpx.ReadError("broken")
        received = wire.decode(base64.b64decode(self.bodies[-1]["template"]))
        answer = {"contract_id": received.contract_id, "request_id": "r"}
        if path.endswith("/enrollment"):
            enrolled = {"template_id": "t", "replaced": False, "images": []}
            return httpx.Response(201, json=answer | enrolled)
        decided = {"decision": "accept", "reason": "match", "level": "l", "calibration_id": "k"}
        return httpx.Response(200, json=answer | decided)


@pytest.fixture
def service(pack: Path) -> Scripted:
    return Scripted([answers(pack), answers(pack, m=7)])


@pytest.fixture
def client(pack: Path, service: Scripted) -> Iterator[PrivateClient]:
    transport = httpx.MockTransport(service)
    retries = Retries(sendings=3)
    with PrivateClient("http://x", TOKEN, pack=pack, transport=transport, retries=retries) as made:
        yield made


def test_a_contract_that_changed_is_told_and_never_lifted_for_by_itself(
    client: PrivateClient, service: Scripted
) -> None:
    """Two lifts of one photo give the embedding away, and the service may only claim a change."""
    second = service.contracts[1][0].contract_id
    for call in (client.enroll, client.verify):
        service.changes = 1
        with pytest.raises(ContractMismatch) as failed:
            call("anna", photo(1))
        assert failed.value.lift is None, "repeating it heals nothing"
    assert (service.fetched, service.lifts, len(service.bodies)) == (2, 2, 2)
    service.current = 1
    assert client.enroll("anna", photo(2)).contract_id == second
    assert client.verify("anna", photo(3)).contract_id == second
    assert service.fetched == 3


def test_a_resend_repeats_the_template(client: PrivateClient, service: Scripted) -> None:
    lift = client.lift_enrollment([photo(1), photo(1, 1)], face="largest")
    assert service.bodies == [], "nothing of it is sent"
    service.lost = 2
    client.enroll("anna", lift)
    assert (len(service.bodies), service.lifts) == (3, 1)
    service.overloaded = 2
    assert client.verify("anna", photo(1))
    assert (len(service.bodies), service.lifts) == (6, 2)
    service.lost = 1
    with pytest.raises(ConnectionFailed):
        client.verify("anna", photo(1))
    assert len(service.bodies) == 7, "it may have been decided"


def test_after_a_failure_the_lift_is_repeated(client: PrivateClient, service: Scripted) -> None:
    def failing(
        call: Callable[[str, Any], object], error: type[Exception], **failures: int
    ) -> Probe | Enrollable:
        for name, count in failures.items():
            setattr(service, name, count)
        with pytest.raises(error) as failed:
            call("anna", photo(1))
        assert "never with the photo" in failed.value.__notes__[0]
        lift = failed.value.lift  # type: ignore[attr-defined]
        assert isinstance(lift, Probe | Enrollable)
        assert call("anna", lift)
        return lift

    assert isinstance(failing(client.enroll, ConnectionFailed, lost=3), Enrollable)
    assert (len(service.bodies), service.lifts) == (4, 1)
    assert isinstance(failing(client.verify, ConnectionFailed, lost=1), Probe)
    assert (len(service.bodies), service.lifts) == (6, 2)
    assert isinstance(failing(client.verify, Unavailable, overloaded=3), Probe)
    assert (len(service.bodies), service.lifts) == (10, 3)


def test_a_generator_of_another_contract(client: PrivateClient, service: Scripted) -> None:
    service.stale_generators = 3
    with pytest.raises(UnexpectedAnswer, match="generator"):
        client.enroll("anna", photo(1))
    service.stale_generators = 2
    client.enroll("anna", photo(1))
    assert service.lifts == 1


def test_lifts_hold_the_projection_of_the_photos_mean(pack: Path) -> None:
    contract, generator = answers(pack)
    lifter = Lifter.load(pack, contract, generator)
    photos = [photo(1, 0), photo(1, 1)]
    models = ModelPack.load(pack, threads=1)
    mean = sum(models.embed_photo(each).embedding for each in photos)
    point = SOURCE.reduced(40).project((mean / np.linalg.norm(mean))[None])
    lifted = [
        lifter.lift(Enrollable, photos, None, None),
        lifter.lift(Probe, photos, None, None),
        lifter.lift(Probe, photos, 2, "largest"),
    ]
    for lift, m in zip(lifted, (8, 4, 2), strict=True):
        received = wire.decode(lift.template)
        assert received.contract_id == lift.contract_id == contract.contract_id
        assert (received.subspace.n, received.subspace.m) == (40, m)
        assert received.subspace.contains(point, tol=2e-3).all()
        assert repr(lift) == f"<{type(lift).__name__} of {len(lift.template)} bytes>"


def test_what_does_not_serve_is_said_without_a_lift(pack: Path, tmp_path: Path) -> None:
    contract, generator = answers(pack)
    broken = contract.model_copy(update={"raw": contract.raw.replace(b'"m":8', b'"m":7')})
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
    for folder, public, decoys, message in cases:
        with pytest.raises(LiftFailed, match=message):
            Lifter.load(folder, public, decoys)

    def refused(photos: Sequence[bytes], dim: int | None = None, **changes: Any) -> str:
        lifter = Lifter.load(pack, *answers(pack, **changes))
        with pytest.raises(LiftFailed) as failed:
            lifter.lift(Probe, photos, dim, None)
        return failed.value.message

    assert "of dimension 2, 4, not 5" in refused([photo(1)], 5)
    assert "no lifted probes" in refused([photo(1)], dims=())
    assert refused([photo(1), b"no picture"]).startswith("photo 2 of 2: ")
    assert refused([photo(1), photo(2)]).startswith("photos 1 and 2 do not look like")
    assert "1 to 10 photos, not 11" in refused([photo(1, shot) for shot in range(11)])


def test_without_the_library(monkeypatch: pytest.MonkeyPatch, pack: Path) -> None:
    monkeypatch.setitem(sys.modules, "enroll.public_contract", None)
    with pytest.raises(LiftFailed, match=r"veilface-client\[private\].* no package of yours"):
        Lifter.load(pack, *answers(pack))


LIFT_ALONE = """
import sys, pickle
blocked = {blocked!r}
sys.modules.update(dict.fromkeys(blocked))
from veilface_client import LiftFailed, Probe
from veilface_client.lifting import Lifter
folder, answers, photo = pickle.load(sys.stdin.buffer)
try:
    print(Lifter.load(folder, *answers).lift(Probe, [photo], None, None))
except LiftFailed as error:
    print(error)
"""
ONLY_ON_UNIX = ("fcntl", "grp", "pwd", "resource", "termios", "uvloop")


@pytest.mark.parametrize(
    ("file", "blocked", "printed"),
    [
        ("other.py", ONLY_ON_UNIX, "<Probe of "),
        ("models.py", (), "call no package of yours enroll, models or templates"),
    ],
    ids=["without what Windows lacks", "beside another package models"],
)
def test_in_another_process(
    file: str, blocked: Sequence[str], printed: str, pack: Path, tmp_path: Path
) -> None:
    (tmp_path / file).write_text("")
    script = f"import {file[:-3]}\n" + LIFT_ALONE.format(blocked=blocked)
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=tmp_path,
        input=pickle.dumps((pack, answers(pack), photo(1))),
        capture_output=True,
    )
    assert done.returncode == 0, done.stderr.decode()
    assert printed in done.stdout.decode()
