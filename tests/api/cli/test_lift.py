import base64
import json
import stat

import numpy as np
import pytest

from api.service.opening import file_sealer
from models.demo import DEMO_NOTICE
from models.pack import ModelPack
from templates.contract import wire
from templates.contract.document import Binding, Contract
from templates.decoys import DecoyGenerator
from templates.keys.sealing import MasterKeyring
from tests.api.cli.conftest import DIM, PROBE_DIM, key_file, run


@pytest.fixture
def public(world, tmp_path):
    """The answer of GET /v1/contract, as a client has it."""
    contract = Contract.load(
        world.data / "contract.json", file_sealer(MasterKeyring.load(key_file(world.data)))
    )
    file = tmp_path / "public.json"
    file.write_text(json.dumps({**contract.to_json(), "photos": True, "request_id": "x"}))
    return file


@pytest.fixture
def lift(world, public):
    def call(*arguments):
        return run(
            *("lift", *arguments, "--pack", world.pack, "--contract", public),
            *("--generator", world.data / "decoys.veil"),
        )

    return call


def test_an_enrollment_holds_the_projection_of_the_photos_mean(world, lift, tmp_path):
    out = tmp_path / "me.veil"
    photos = world.photos(1, range(3))
    ran = lift(*photos, "--out", out, "--json")
    assert ran.status == 0, ran.stderr
    assert DEMO_NOTICE in ran.stderr
    data = out.read_bytes()
    axes = world.calibrated["contract"]["binding"]["axes"]
    assert ran.json["bytes"] == len(data) == wire.encoded_size(axes, DIM)
    assert stat.S_IMODE(out.stat().st_mode) == 0o600
    received = wire.decode(data)
    assert received.contract_id == world.calibrated["contract"]["contract_id"]
    assert received.subspace.m == DIM
    pack = ModelPack.load(world.pack)
    mean = sum(pack.embed_photo(photo.read_bytes()).embedding for photo in photos)
    mean = mean / np.linalg.norm(mean)
    decoys = DecoyGenerator.load(world.data / "decoys.veil").reduced(received.subspace.n)
    assert received.subspace.contains(decoys.project(mean[None]), tol=2e-3).all()
    assert ran.json["kind"] == "enrollment"


def test_a_probe_has_a_calibrated_dimension_and_goes_to_stdout(world, lift):
    (photo,) = world.photos(1, range(1))
    ran = lift(photo, "--probe", "--out", "-", "--level", "fmr-1e-2")
    assert ran.status == 0
    sent = ran.json
    assert wire.decode(base64.b64decode(sent.pop("template"))).subspace.m == PROBE_DIM
    assert sent == {"level": "fmr-1e-2"}


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (("--dim", "5"), 2, "add --probe"),
        (("--probe", "--level", "fmr-1e-2"), 2, "--level goes with --probe --out -"),
        (("--probe", "--dim", "5"), 1, f"of dimension {PROBE_DIM}, not 5"),
    ],
)
def test_other_dimensions_are_refused(world, lift, tmp_path, arguments, status, said):
    ran = lift(*world.photos(1, range(1)), *arguments, "--out", tmp_path / "x")
    assert ran.status == status
    assert said in ran.stderr
    assert not (tmp_path / "x").exists()


def test_photos_of_two_people_are_refused_by_name(world, lift, tmp_path):
    photos = [*world.photos(1, range(1)), *world.photos(2, range(1, 2))]
    ran = lift(*photos, "--out", tmp_path / "x")
    assert ran.status == 1
    assert "0.png and 1.png do not look like the same person" in ran.stderr


def test_a_changed_contract_is_refused(world, lift, public, tmp_path):
    document = json.loads(public.read_text())
    document["binding"]["m"] = 2
    public.write_text(json.dumps(document))
    ran = lift(*world.photos(1, range(1)), "--out", tmp_path / "x")
    assert ran.status == 1
    assert "contract_id" in ran.stderr


def test_decoys_of_another_model_are_refused_though_the_contract_names_them(
    world, public, tmp_path
):
    other = tmp_path / "other.veil"
    document = json.loads(public.read_text())
    own = DecoyGenerator.load(world.data / "decoys.veil").reduced(document["binding"]["axes"])
    source = DecoyGenerator(own.axes, own.mean, own.root, made_with="5a" * 32)
    source.save(other)
    document["binding"]["decoy_source_id"] = source.source_id
    document["contract_id"] = Binding.from_json(document["binding"]).contract_id
    public.write_text(json.dumps(document))
    ran = run(
        *("lift", *world.photos(1, range(1)), "--contract", public, "--out", tmp_path / "x"),
        *("--pack", world.pack, "--generator", other),
    )
    assert ran.status == 1
    assert "another model" in ran.stderr
    assert not (tmp_path / "x").exists()
