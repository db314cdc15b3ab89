from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from attacks.linkage import SCORES, foot_lengths, link, nearest_similarities
from attacks.outcomes import POOLED, AttackOutcome, Knowledge, Property, Scheme
from attacks.system import System
from models.pack import ModelPack
from templates.decoys import DecoyPool
from templates.space.lifting import Strategy
from tests.verify.synthetic import random_rotation
from verify import labelled_folder
from verify.comparisons import Lifter


def by_variant(outcomes: list[AttackOutcome]) -> dict[str, AttackOutcome]:
    return {each.variant: each for each in outcomes}


def test_templates_link_without_a_rotation_and_when_the_keys_leak(system: System) -> None:
    rows = by_variant(link(system, liftings=3))
    assert len(rows) == 3 * len(SCORES)
    control = rows["no rotation, nearest points"]
    leaked = rows["keys leaked, nearest points"]
    assert control.measured.value > 0.5
    assert abs(leaked.measured.value - control.measured.value) < 0.02
    assert leaked.knowledge is Knowledge.KEY
    assert leaked.breaks is Property.UNLINKABILITY
    assert leaked.judged
    assert not control.judged


def test_secret_rotations_unlink(system: System) -> None:
    rows = by_variant(link(system, liftings=3))
    for name in SCORES:
        row = rows[f"secret rotations, {name}"]
        assert row.measured.value <= float(str(row.details["null_95_percent"])), name


def test_different_people_do_not_link(system: System, strangers: np.ndarray) -> None:
    others = replace(system, victims=replace(system.victims, fresh=strangers))
    row = by_variant(link(others, liftings=2))["no rotation, nearest points"]
    assert row.measured.value <= float(str(row.details["null_95_percent"]))


def test_only_lengths_survive_a_rotation(system: System) -> None:
    turned = system.templates.rotated(random_rotation())
    np.testing.assert_allclose(
        foot_lengths(system.templates, system.templates),
        foot_lengths(system.templates, turned),
        atol=1e-6,
    )
    apart = nearest_similarities(system.templates, turned)
    assert np.diagonal(apart).mean() < 0.9


@pytest.mark.long
def test_real_faces_link_without_a_rotation_and_not_with_it(
    system: System, mbf_pack_dir: Path, lfw_aligned: Path
) -> None:
    """Issue 4, "what must be seen" 4; two photos each of 60 people, and decoys of 200 others."""
    folder = labelled_folder(lfw_aligned)
    names = np.asarray(folder.identities)
    _people, first = np.unique(names, return_index=True)
    several = [i for i in first if np.count_nonzero(names == names[i]) > 1][:60]
    single = [i for i in first if i not in several][:200]
    chosen = [*several, *(i + 1 for i in several), *single]
    assert (names[several] == names[chosen[60:120]]).all()
    pack = ModelPack.load(mbf_pack_dir, threads=1)
    crops = [np.asarray(Image.open(folder.paths[i]).convert("RGB")) for i in chosen]
    rows = np.concatenate(
        [pack.embed(np.stack(crops[start : start + 32])) for start in range(0, len(crops), 32)]
    )
    victims = replace(system.victims, enrolled=rows[:60], fresh=rows[60:120])
    lifter = Lifter(Strategy.ADVERSARIAL, DecoyPool(rows[120:]), system.contract.contract_id)
    # Two of 200: shared decoys, at similarity 1, are rare enough not to blur what mates show.
    scheme = Scheme("adversarial", POOLED, 2)
    faces = replace(system, scheme=scheme, lifter=lifter, victims=victims)
    faces = replace(faces, templates=faces.lift(rows[:60], "victims"))
    found = by_variant(link(faces, liftings=3))
    assert found["no rotation, nearest points"].measured.value > 0.8
    for name in SCORES:
        row = found[f"secret rotations, {name}"]
        assert row.measured.value <= float(str(row.details["null_95_percent"])), name
