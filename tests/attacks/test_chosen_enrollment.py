from dataclasses import replace

import numpy as np
import pytest

import attacks.chosen_enrollment
from attacks.chosen_enrollment import (
    Sides,
    best_known_points,
    chosen_enrollment,
    estimate_from_sets,
    polar_factor,
    product_pairs,
)
from attacks.errors import AuditError
from attacks.outcomes import CONTROL, Knowledge, Leaked, Property
from attacks.system import System
from templates.keys.randomness import Keystream
from templates.space.subspace import SubspaceBatch
from tests.verify.synthetic import N, random_rotation, unit
from verify.comparisons import through_wire


def in_another_basis(batch: SubspaceBatch) -> SubspaceBatch:
    with Keystream.seeded("another basis") as stream:
        return SubspaceBatch.through(batch.feet, batch.bases, stream=stream)


def alignment(estimate: np.ndarray, rotation: np.ndarray) -> float:
    return float(np.trace(estimate.T @ rotation) / len(rotation))


def test_enough_accounts_fix_the_rotation(system: System) -> None:
    rotation = random_rotation()
    sent = system.lift(system.attacker[:20], "test of chosen enrollment")
    stolen = in_another_basis(sent).rotated(rotation)
    assert np.abs(stolen.bases - sent.rotated(rotation).bases).max() > 0.1  # no row is its image
    estimate = estimate_from_sets(Sides(sent, stolen))
    np.testing.assert_allclose(estimate @ estimate.T, np.eye(N), atol=1e-9)
    assert alignment(estimate, rotation) > 0.999


def test_the_pairs_alone_fix_it_too(system: System) -> None:
    """Without the refinement: foot points, and projections of those of others."""
    rotation = random_rotation(seed=6)
    sent = system.lift(system.attacker[:20], "test of chosen enrollment")
    stolen = in_another_basis(sent).rotated(rotation)
    assert alignment(polar_factor(product_pairs(Sides(sent, stolen))), rotation) > 0.999


def test_pairs_beyond_a_number_are_not_needed(
    system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    """80 accounts have 6,400 pairs, of which those after 64 × 64 are left out."""
    rotation = random_rotation(seed=7)
    sent = system.lift(system.attacker[:80], "test of chosen enrollment")
    turned = in_another_basis(sent).rotated(rotation)
    sides = Sides(sent, through_wire(turned, contract_id=system.contract.contract_id))
    some, capped = product_pairs(sides), estimate_from_sets(sides)
    monkeypatch.setattr(attacks.chosen_enrollment, "_MOST_PAIRS", np.inf)
    everything, uncapped = product_pairs(sides), estimate_from_sets(sides)
    # Each pair adds 1 to tr(Rᵀ Σ y xᵀ).
    numbers = [round(np.trace(rotation.T @ moment)) for moment in (some, everything)]
    assert numbers[0] < 65 * N < 90 * N < numbers[1]
    np.testing.assert_allclose(capped, uncapped, atol=1e-4)
    assert alignment(capped, rotation) > 0.9999


def test_the_polar_factor_is_found_where_lapack_gives_up(monkeypatch: pytest.MonkeyPatch) -> None:
    moment = np.random.default_rng(0).normal(size=(20, 20))

    def give_up(_moment: np.ndarray) -> None:
        raise np.linalg.LinAlgError("SVD did not converge")

    usual = polar_factor(moment)
    values, vectors = np.linalg.eigh(moment.T @ moment)
    np.testing.assert_allclose(usual, moment @ (vectors / np.sqrt(values)) @ vectors.T, atol=1e-8)
    monkeypatch.setattr(np.linalg, "svd", give_up)
    np.testing.assert_allclose(polar_factor(moment), usual, atol=1e-10)


def test_templates_of_others_fix_nothing(system: System) -> None:
    rotation = random_rotation()
    sent = system.lift(system.attacker[:20], "test of chosen enrollment")
    others = system.lift(system.attacker[20:40], "others").rotated(rotation)
    assert abs(alignment(estimate_from_sets(Sides(sent, others)), rotation)) < 0.1


def test_best_known_points_lie_in_their_templates_and_in_the_span(system: System) -> None:
    accounts = system.lift(system.attacker[:5], "accounts")
    points = best_known_points(system.templates, accounts, seed=0)
    rows = np.concatenate([accounts.feet, accounts.bases.reshape(-1, N)])
    span = np.linalg.qr(rows.T)[0]
    reached = np.linalg.norm(points @ span, axis=1)
    rng = np.random.default_rng(0)
    for index in range(3):
        template = system.templates[index]
        assert template.contains(points[index : index + 1].astype(np.float32), tol=1e-4).all()
        inside = unit(rng.normal(size=(5000, template.m))) @ template.basis
        drawn = template.foot + template.radius * inside
        assert np.linalg.norm(drawn @ span, axis=1).max() <= reached[index] + 1e-4


def test_no_number_of_accounts_opens_victims_with_rotations_of_their_own(system: System) -> None:
    *rows, few, common, opened = chosen_enrollment(system, accounts=(1, 20, 10_000))
    assert [each.details["accounts"] for each in (*rows, few, common)] == [1, 20] * 3
    assert ["holders' keys kept" in each.variant for each in rows] == [False] * 2 + [True] * 2
    for row in rows:
        control = few if row.details["accounts"] == 1 else common
        assert row.judged == control.succeeds
        assert (row.leaked, row.knowledge) == (Leaked.MASTER_KEY, Knowledge.TEMPLATES)
        assert row.breaks is Property.IMPERSONATION
        assert abs(float(str(row.details["alignment"]))) < 0.15
        assert row.measured.value <= 2 / 40  # chance is 1 in 100 or less
    # The controls: the attack is one where all have one rotation, and the key gives all of them.
    assert float(str(common.details["alignment"])) > 0.999
    assert common.measured.value == opened.measured.value == 1.0
    assert opened.leaked is Leaked.HOLDER_KEYS
    assert {each.unjudged for each in (few, common, opened)} == {CONTROL}
    assert rows == chosen_enrollment(system, accounts=(1, 20))[:4]


def test_an_attacker_without_faces_is_refused(system: System) -> None:
    with pytest.raises(AuditError, match="faces"):
        chosen_enrollment(replace(system, attacker=system.attacker[:0]))
