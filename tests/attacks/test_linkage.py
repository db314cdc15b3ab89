from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from attacks.linkage import (
    foot_lengths,
    holder_rotations_of,
    link,
    rotations_of,
    span_overlaps,
    turned,
    turned_back,
    turned_points,
)
from attacks.outcomes import CONTROL, POOLED, AttackOutcome, Leaked, Property, Scheme
from attacks.population import Population
from attacks.second_order import Moments, decoy_moment
from attacks.stored.foot_point import foot_points
from attacks.system import System
from enroll import Enroller, Holder
from models.pack import ModelPack
from templates.contract import wire
from templates.decoys import DecoyPool
from templates.keys.rotation import SignedCosineRotation, TenantRotation
from templates.space.embedding import normalised
from tests.verify.synthetic import random_rotation
from verify import labelled_folder


def is_within_null(row: AttackOutcome) -> bool:
    """Within three standard deviations of the permutation null, as a normal one's 95 % tell them.

    Beyond the 95 % itself lies one row in twenty, be the rotations what they may.
    """
    high = float(str(row.details["null_95_percent"]))
    return row.measured.value <= row.chance + 3 * (high - row.chance) / 1.645


def by_variant(outcomes: list[AttackOutcome]) -> dict[str, AttackOutcome]:
    return {each.variant: each for each in outcomes}


def test_templates_link_when_the_keys_leak(system: System) -> None:
    rows = by_variant(link(system, liftings=3))
    assert len(rows) == 5
    leaked = rows["keys leaked, overlap of spans"]
    assert leaked.measured.value > 0.5
    assert leaked.leaked is Leaked.HOLDER_KEYS
    assert leaked.breaks is Property.UNLINKABILITY
    assert leaked.judged


@pytest.mark.parametrize("setting", ["secret rotations", "one tenant", "holder's key kept"])
def test_secret_rotations_unlink(system: System, setting: str) -> None:
    rows = by_variant(link(system, liftings=3))
    row = rows[f"{setting}, foot lengths"]
    assert (row.judged, row.leaked) == (True, Leaked.MASTER_KEY)
    assert is_within_null(row)
    assert not is_within_null(rows["keys leaked, overlap of spans"])


def test_each_template_of_a_tenant_has_a_rotation_of_its_own(system: System) -> None:
    rotations = rotations_of(system, "first", "template", 3)
    stored = turned(system.templates[:3], rotations)
    undone = turned_back(stored, rotations)
    np.testing.assert_allclose(undone.bases, system.templates[:3].bases, atol=1e-6)
    swapped = turned_back(stored, [*rotations[1:], rotations[0]])
    assert np.abs(swapped.feet - system.templates[:3].feet).max(axis=1).min() > 0.05
    rows = system.templates.feet[:3]
    np.testing.assert_allclose(turned_points(rows, rotations), stored.feet, atol=1e-6)
    others = rotations_of(system, "second", "template", 3), rotations_of(system, "first", "x", 3)
    for one, other in zip(rotations, others[0] + others[1], strict=False):
        assert np.abs(one.turned(rows) - other.turned(rows)).max() > 0.05


def test_a_holder_has_another_rotation_for_each_enrollment(system: System) -> None:
    first, again = (holder_rotations_of(system, name, 3) for name in ("first", "again"))
    rows = system.templates.feet[:3]
    assert np.abs(turned_points(rows, first) - turned_points(rows, again)).max(axis=1).min() > 0.05
    shifted = [*first[1:], first[0]]
    moved = turned_points(rows, first) - turned_points(rows, shifted)
    assert np.abs(moved).max(axis=1).min() > 0.05
    np.testing.assert_allclose(
        turned_back(turned(system.templates[:3], first), first).feet, rows, atol=1e-6
    )


def test_different_people_do_not_link(system: System, strangers: np.ndarray) -> None:
    others = replace(system, victims=replace(system.victims, fresh=strangers))
    rows = by_variant(link(others, liftings=2))
    row = rows["keys leaked, overlap of spans"]
    assert row.measured.value <= float(str(row.details["null_95_percent"]))


def test_lengths_know_one_set_again_in_two_rotations(system: System) -> None:
    control = by_variant(link(system, liftings=1))["one set for both, foot lengths"]
    assert control.unjudged == CONTROL
    assert float(str(control.details["identified_at_rank_1"])) > 0.9
    assert not is_within_null(control)


def test_of_who_keeps_a_key_no_length_tells_what_two_tenants_have(
    system: System, small_population: Population
) -> None:
    """By the service's enroller: the very same photos at two tenants, and twice at one."""
    keys, source = [bytes([i] * 32) for i in range(40)], system.source
    embeddings = small_population.victims.enrolled

    def lengths(tenant: str, *, kept: bool) -> np.ndarray:
        rotation = TenantRotation(tenant.encode().ljust(32), source.k)
        enroller = Enroller(system.contract, source, rotation=rotation, lift_secret=bytes(32))
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


def test_templates_of_ones_own_tell_no_other_rotation(system: System) -> None:
    """They tell the rotation that all templates of a tenant would have in common."""
    accounts, victims = system.lift(system.attacker[:90], "accounts"), system.templates
    own = rotations_of(system, "first", "account", len(accounts))
    others = rotations_of(system, "first", "victim", len(victims))

    def found(
        of_accounts: list[SignedCosineRotation], of_victims: list[SignedCosineRotation]
    ) -> float:
        stolen = turned(accounts, of_accounts)
        left, _, right = np.linalg.svd(stolen.feet.T.astype(float) @ accounts.feet)
        opened = turned(victims, of_victims).feet @ (left @ right)
        return float(np.einsum("ij,ij->i", normalised(opened), foot_points(victims)).mean())

    assert found(own[:1] * len(accounts), own[:1] * len(victims)) > 0.99
    assert abs(found(own, others)) < 0.1


def test_only_lengths_survive_a_rotation(system: System) -> None:
    rotation = random_rotation()
    rotated = system.templates.turned_by(lambda points: points @ rotation.T)
    np.testing.assert_allclose(
        foot_lengths(system.templates, system.templates),
        foot_lengths(system.templates, rotated),
        atol=1e-6,
    )
    decoys = Moments.of(decoy_moment(system.source))
    same, apart = (
        np.diagonal(span_overlaps(system.templates, batch, decoys)).mean()
        for batch in (system.templates, rotated)
    )
    assert apart < 0.2 * same


@pytest.mark.long
def test_real_faces_link_without_rotations_and_not_with_them(
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
    # Two of 200: shared decoys, at similarity 1, are rare enough not to blur what mates show.
    scheme = Scheme("adversarial", POOLED, 2)
    faces = replace(system, scheme=scheme, source=DecoyPool(rows[120:]), victims=victims)
    faces = replace(faces, templates=faces.lift(rows[:60], "victims"))
    found = by_variant(link(faces, liftings=3))
    assert found["keys leaked, overlap of spans"].measured.value > 0.8
    for setting in ("secret rotations", "one tenant", "holder's key kept"):
        assert is_within_null(found[f"{setting}, foot lengths"]), setting
