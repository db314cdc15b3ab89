"""Two real people in one enrollment: nearly never both accepted, at little cost to one person."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.hostile_probes import Faces, contract_of
from benchmarks.two_people import (
    both_accepted,
    by_all_photos,
    by_one_photo,
    embedded,
    enrolled_means,
    photos_of,
    refused_genuine,
)
from models.extraction import Extractor
from models.pack import ModelPack
from templates.contract.document import Contract
from templates.decoys import DecoyGenerator
from verify import labelled_folder

CALIBRATED, ATTACKERS, DECOY_FACES = 400, 200, 600


@pytest.fixture(scope="module")
def pack(mbf_pack_dir: Path) -> ModelPack:
    return ModelPack.load(mbf_pack_dir)


@pytest.fixture(scope="module")
def sets(
    pack: ModelPack, lfw_aligned: Path, lfw_photos: Path
) -> tuple[Faces, Faces, Contract, DecoyGenerator]:
    """200 people of the crops, the 80 of the photos, and a contract of none of them."""
    folder = labelled_folder(lfw_aligned)
    photos: dict[str, list[Path]] = {}
    for path, name in zip(folder.paths, folder.identities, strict=True):
        photos.setdefault(name, []).append(path)
    people, _ = embedded(pack, lfw_photos, aligned=False)
    shown = set(people.names)
    several = [name for name in sorted(photos) if len(photos[name]) >= 3 and name not in shown]
    chosen = np.random.default_rng(0).permutation(several).tolist()
    calibrated, attacking = chosen[:CALIBRATED], chosen[CALIBRATED : CALIBRATED + ATTACKERS]
    single = [name for name in sorted(photos) if len(photos[name]) == 1 and name not in shown]

    def faces(names: list[str], most: int) -> Faces:
        name_of = {path: name for name in names for path in photos[name][:most]}
        found = Extractor(pack, aligned=True).extract(list(name_of))
        return Faces(found.descriptors, np.array([name_of[path] for path in found.paths]))

    source = DecoyGenerator.fit(faces(single[:DECOY_FACES], 1).descriptors)
    contract = contract_of(faces(calibrated, 3), source, 64, (0,))
    return faces(attacking, 3), people, contract, source


@pytest.mark.long
@pytest.mark.timeout(580)
@pytest.mark.parametrize("which", [0, 1])
def test_no_more_than_one_in_a_hundred_gets_both_accepted(
    sets: tuple[Faces, Faces, Contract, DecoyGenerator], which: int
) -> None:
    faces, contract, source = sets[which], sets[2], sets[3]
    assert isinstance(faces, Faces)
    people = photos_of(faces)
    for attempts in (by_one_photo(faces, people), by_all_photos(faces, people, own=1, others=1)):
        assert len(attempts) == len(people)
        passed, means = enrolled_means(faces, attempts, contract)
        assert both_accepted(faces, passed, means, contract, source) <= 0.01 * len(attempts)


@pytest.mark.long
@pytest.mark.timeout(580)
@pytest.mark.parametrize("which", [0, 1])
def test_three_photos_of_one_person_are_taken(
    sets: tuple[Faces, Faces, Contract, DecoyGenerator], which: int
) -> None:
    faces, contract = sets[which], sets[2]
    assert isinstance(faces, Faces)
    refused, trials = refused_genuine(faces, contract, photos=3)
    assert trials in (80, ATTACKERS)
    assert refused <= 0.02 * trials
