"""Rotations: each template has its own, and nothing but a length survives one."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from attacks.bed import Pairs
from attacks.rotations import holder_rotations_of, rotations_of, turned, turned_back, turned_points
from attacks.runner import run_attack
from attacks.setup import AttackSetup
from attacks.stored.foot_point import foot_points
from attacks.stored.linkage import foot_lengths
from enroll import Enroller, Holder
from models.pack import ModelPack
from templates.contract import wire
from templates.decoys import DecoyPool
from templates.keys.rotation import SignedCosineRotation, TenantRotation
from templates.space.embedding import normalised
from templates.space.lifting import Strategy
from tests.attacks.beds import AXES, bed_of, is_within_null, population
from tests.verify.synthetic import random_rotation
from verify import labelled_folder


def test_each_template_of_a_tenant_has_a_rotation_of_its_own() -> None:
    bed = bed_of()
    rotations = rotations_of(bed, "first", "template", 3)
    stored = turned(bed.templates[:3], rotations)
    undone = turned_back(stored, rotations)
    np.testing.assert_allclose(undone.bases, bed.templates[:3].bases, atol=1e-6)
    swapped = turned_back(stored, [*rotations[1:], rotations[0]])
    assert np.abs(swapped.feet - bed.templates[:3].feet).max(axis=1).min() > 0.05
    rows = bed.templates.feet[:3]
    np.testing.assert_allclose(turned_points(rows, rotations), stored.feet, atol=1e-6)
    others = rotations_of(bed, "second", "template", 3), rotations_of(bed, "first", "x", 3)
    for one, other in zip(rotations, others[0] + others[1], strict=False):
        assert np.abs(one.turned(rows) - other.turned(rows)).max() > 0.05


def test_a_holder_has_another_rotation_for_each_enrollment() -> None:
    bed = bed_of()
    first, again = (holder_rotations_of(bed, name, 3) for name in ("first", "again"))
    rows = bed.templates.feet[:3]
    assert np.abs(turned_points(rows, first) - turned_points(rows, again)).max(axis=1).min() > 0.05
    shifted = [*first[1:], first[0]]
    moved = turned_points(rows, first) - turned_points(rows, shifted)
    assert np.abs(moved).max(axis=1).min() > 0.05
    back = turned_back(turned(bed.templates[:3], first), first)
    np.testing.assert_allclose(back.feet, rows, atol=1e-6)


def test_of_who_keeps_a_key_no_length_tells_what_two_tenants_have() -> None:
    """By the service's enroller: the very same photos at two tenants, and twice at one."""
    bed = bed_of()
    keys = [bytes([i] * 32) for i in range(40)]
    embeddings = population().victims.enrolled

    def lengths(tenant: str, *, kept: bool) -> np.ndarray:
        rotation = TenantRotation(tenant.encode().ljust(32), bed.source.k)
        enroller = Enroller(bed.service, bed.source, rotation=rotation, lift_secret=bytes(32))
        stored = [
            enroller.from_embeddings(
                row[None], holder=Holder(key, tenant, f"person {number}") if kept else None
            )
            for number, (key, row) in enumerate(zip(keys, embeddings, strict=True))
        ]
        return np.array([wire.decode(one.wire).subspace.foot_norm for one in stored])

    def linked(first: np.ndarray, second: np.ndarray) -> int:
        nearest = np.abs(first[:, None] - second).argmin(axis=1)
        return int(np.count_nonzero(nearest == np.arange(len(first))))

    assert linked(lengths("bank", kept=True), lengths("shop", kept=True)) <= 8  # by chance 1
    assert linked(lengths("bank", kept=True), lengths("bank", kept=True)) >= 30
    # Where no key is kept the master key opens both, whatever their lengths.
    assert linked(lengths("bank", kept=False), lengths("shop", kept=False)) >= 30


def test_templates_of_ones_own_tell_no_other_rotation() -> None:
    """They tell the rotation that all templates of a tenant would have in common."""
    bed = bed_of()
    accounts, victims = bed.lift(bed.gallery[:90], "accounts"), bed.templates
    own = rotations_of(bed, "first", "account", len(accounts))
    others = rotations_of(bed, "first", "victim", len(victims))

    def found(
        of_accounts: list[SignedCosineRotation], of_victims: list[SignedCosineRotation]
    ) -> float:
        stolen = turned(accounts, of_accounts)
        left, _, right = np.linalg.svd(stolen.feet.T.astype(float) @ accounts.feet)
        opened = turned(victims, of_victims).feet @ (left @ right)
        return float(np.einsum("ij,ij->i", normalised(opened), foot_points(victims)).mean())

    assert found(own[:1] * len(accounts), own[:1] * len(victims)) > 0.99
    assert abs(found(own, others)) < 0.1


def test_only_lengths_survive_a_rotation() -> None:
    bed = bed_of()
    rotation = random_rotation(AXES)
    rotated = bed.templates.turned_by(lambda points: points @ rotation.T)
    np.testing.assert_allclose(rotated.foot_norms, bed.templates.foot_norms, atol=1e-6)
    same, apart = (
        np.abs(np.einsum("ij,ij->i", foot_points(bed.templates), foot_points(batch)))
        for batch in (bed.templates, rotated)
    )
    assert same == pytest.approx(1)
    assert apart.mean() < 0.2


@pytest.mark.long
def test_real_faces_do_not_link_in_secret_rotations(mbf_pack_dir: Path, lfw_aligned: Path) -> None:
    """Two photos each of 60 people, and decoys of 200 others."""
    folder = labelled_folder(lfw_aligned)
    names = np.asarray(folder.identities)
    _people, first = np.unique(names, return_index=True)
    several = [i for i in first if np.count_nonzero(names == names[i]) > 1][:60]
    single = [i for i in first if i not in several][:200]
    chosen = [*several, *(i + 1 for i in several), *single]
    pack = ModelPack.load(mbf_pack_dir, threads=1)
    crops = [np.asarray(Image.open(folder.paths[i]).convert("RGB")) for i in chosen]
    rows = np.concatenate(
        [pack.embed(np.stack(crops[start : start + 32])) for start in range(0, len(crops), 32)]
    )
    # Two of 200: shared decoys, at similarity 1, are rare enough not to blur what mates show.
    setup = AttackSetup.of(Pairs(rows[:60], rows[60:120]), rows[120:], DecoyPool(rows[120:]))
    bed = setup.bed(Strategy.ADVERSARIAL, axes=rows.shape[1], m=2)
    *hidden, control = run_attack(foot_lengths, bed)
    assert control.succeeds
    for row in hidden:
        assert is_within_null(row), row.variant
