"""Decoys of another descriptor space: neither calibrated nor served."""

from pathlib import Path

import pytest

from api.http.errors import StartError
from api.service.opening import open_decoys, open_keyring
from models.pack import ModelPack
from templates.contract.document import Contract
from templates.decoys import DecoyGenerator
from templates.errors import ContractMismatch
from templates.space.lifting import Strategy
from tests.api.deployment import Deployment, deploy, make_contract, make_source
from verify.preparation import binding_for, require_made_with

ELSEWHERE = "5a" * 32


@pytest.fixture(scope="module")
def deployment(tmp_path_factory: pytest.TempPathFactory) -> Deployment:
    return deploy(tmp_path_factory.mktemp("decoys"))


def made(made_with: str | None) -> DecoyGenerator:
    source = make_source()
    return DecoyGenerator(source.axes, source.mean, source.root, made_with=made_with)


def bound_to(deployment: Deployment, source: DecoyGenerator) -> Contract:
    assert deployment.settings.pack is not None
    return make_contract(ModelPack.load(deployment.settings.pack, threads=1), source)


def test_a_service_starts_with_decoys_of_its_contracts_space_only(
    deployment: Deployment, tmp_path: Path
) -> None:
    keyring = open_keyring(deployment.settings)
    settings = deployment.settings.model_copy(update={"data_dir": tmp_path})
    for made_with in (None, deployment.contract.binding.embedding_id):
        source = made(made_with)
        source.save(tmp_path / "decoys.veil")
        opened = open_decoys(settings, keyring, bound_to(deployment, source))
        assert opened is not None
        assert opened.made_with == made_with
    source = made(ELSEWHERE)
    source.save(tmp_path / "decoys.veil")
    with pytest.raises(StartError, match="with this pack and the same --flip"):
        open_decoys(settings, keyring, bound_to(deployment, source))


def test_a_pack_is_bound_to_decoys_of_its_own_space_only(deployment: Deployment) -> None:
    assert deployment.settings.pack is not None
    pack, flipped = (
        ModelPack.load(deployment.settings.pack, threads=1, flip=flip) for flip in (False, True)
    )
    source = made(deployment.contract.binding.embedding_id)
    binding = binding_for(pack, source, strategy=Strategy.ADVERSARIAL, m=4)
    assert binding.embedding_id == source.made_with
    require_made_with(source, pack)
    with pytest.raises(ContractMismatch, match="the same --flip"):
        binding_for(flipped, source, strategy=Strategy.ADVERSARIAL, m=4)
    with pytest.raises(ContractMismatch, match="another preprocessing"):
        require_made_with(source, flipped)
    binding_for(pack, made(None), strategy=Strategy.ADVERSARIAL, m=4)
    with pytest.raises(ContractMismatch, match="do not say which model"):
        require_made_with(made(None), pack)
