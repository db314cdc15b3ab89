from dataclasses import replace

import numpy as np
import pytest

from attacks.databases import (
    Moments,
    _Tenant,
    estimate_rotation,
    link_databases,
    signature_cosines,
    whitened_cosines,
)
from attacks.errors import AuditError
from attacks.linkage import foot_lengths, nearest_similarities
from attacks.system import System
from templates.decoys import DecoyGenerator
from templates.keys.randomness import Keystream
from templates.space.subspace import SubspaceBatch
from tests.attacks.test_linkage import is_within_null
from tests.verify.synthetic import random_rotation, unit

N, M = 16, 2


def templates(spread: np.ndarray, count: int, *, seed: int) -> tuple[SubspaceBatch, np.ndarray]:
    """Lift people who are spread like this, with decoys that are too."""
    rng = np.random.default_rng(seed)
    people = unit(rng.normal(size=(count, N)) * spread + 0.3 * spread)
    decoys = unit(rng.normal(size=(count, M, N)) * spread + 0.3 * spread)
    with Keystream.seeded("test", seed) as stream:
        batch = SubspaceBatch.through(people, decoys - people[:, None], stream=stream)
    return batch, people


def alignment(estimate: np.ndarray, rotation: np.ndarray) -> float:
    return float(np.trace(estimate.T @ rotation) / N)


def test_a_database_of_uneven_axes_gives_its_rotation_away() -> None:
    spread = np.geomspace(1.0, 0.1, N)
    rotation = random_rotation(N)
    stolen, people = templates(spread, 3000, seed=1)
    lifted, _ = templates(spread, 3000, seed=2)
    turned = stolen.rotated(rotation)
    estimate = estimate_rotation(
        Moments.of(turned), Moments.of(lifted), turned.feet[:100], people[:100]
    )
    np.testing.assert_allclose(estimate @ estimate.T, np.eye(N), atol=1e-9)
    assert alignment(estimate, rotation) > 0.9


def test_even_axes_and_no_accounts_give_nothing_away() -> None:
    rng = np.random.default_rng(0)
    feet = rng.normal(size=(500, N))

    def noise(seed: int) -> SubspaceBatch:
        with Keystream.seeded("noise", seed) as stream:
            draws = np.random.default_rng(seed).normal(size=(500, M + 1, N))
            return SubspaceBatch.through(unit(draws[:, 0]), draws[:, 1:], stream=stream)

    none = feet[:0]
    aligned = [
        alignment(
            estimate_rotation(
                Moments.of(noise(seed).rotated(random_rotation(N, seed))),
                Moments.of(noise(seed + 100)),
                none,
                none,
            ),
            random_rotation(N, seed),
        )
        for seed in range(6)
    ]
    assert abs(np.mean(aligned)) < 0.2


def test_the_true_rotation_links_by_whitened_feet() -> None:
    spread = np.geomspace(1.0, 0.1, N)
    batch, _ = templates(spread, 60, seed=1)
    lifted, _ = templates(spread, 500, seed=2)
    scores = whitened_cosines(batch, batch, Moments.of(lifted))
    assert (scores.argmax(axis=1) == np.arange(60)).all()


def test_signatures_are_invariant_and_link_where_nothing_is_hidden() -> None:
    spread = np.ones(N)
    batch, _ = templates(spread, 80, seed=1)
    turned = batch.rotated(random_rotation(N))
    same = signature_cosines(batch[:50], turned[:50], batch[50:], turned[50:])
    assert (same.argmax(axis=1) == np.arange(50)).all()
    other, _ = templates(spread, 80, seed=2)
    apart = signature_cosines(batch[:50], other[:50], batch[50:], other[50:])
    assert (apart.argmax(axis=1) == np.arange(50)).mean() < 0.15


def test_outcomes_name_the_accounts_and_leave_out_those_beyond_the_faces(system: System) -> None:
    outcomes = link_databases(system, accounts=(0, 5, 10_000), strangers=150, permutations=200)
    assert [each.details["accounts"] for each in outcomes] == [0] * 3 + [5] * 16
    assert all(0 <= each.measured.value <= 1 for each in outcomes)
    assert [each.judged for each in outcomes] == [True] * 15 + [False] * 4
    kept = [each for each in outcomes if "holders' keys kept" in each.variant]
    assert outcomes[7:15] == kept
    assert ["two halves of one tenant" in each.variant for each in kept] == [False] * 4 + [True] * 4
    assert all("keys that people keep" in each.assumption for each in kept)
    assert all("one rotation a tenant" in each.variant for each in outcomes[15:])


def test_moments_of_two_halves_are_those_of_the_whole() -> None:
    batch, _ = templates(np.geomspace(1.0, 0.1, N), 200, seed=1)
    both = Moments.of_both(Moments.of(batch[:100]), Moments.of(batch[100:]))
    whole = Moments.of(batch)
    np.testing.assert_allclose(both.mean, whole.mean, atol=1e-6)
    np.testing.assert_allclose(both.variances, whole.variances, atol=1e-6)
    assert both.templates == whole.templates
    assert abs(both.power - whole.power) < 1e-6


def test_people_who_gave_both_tenants_one_set_are_linked_by_its_length(system: System) -> None:
    """No rotation hides it, and so photos are lifted anew for each tenant (the control)."""
    tenants = [_Tenant(name, system.templates, len(system.templates), 0) for name in ("a", "b")]
    anew = _Tenant("b", system.lift(system.victims.enrolled, "again"), len(system.templates), 0)
    first, second, other = (
        each.stolen(each.holders_rotations(system)).victims for each in (*tenants, anew)
    )
    linked, apart = (
        (foot_lengths(first, side).argmax(axis=1) == np.arange(len(first))).mean()
        for side in (second, other)
    )
    assert linked > 0.9
    assert apart < 0.2
    assert np.diagonal(nearest_similarities(first, second)).mean() < 0.9


def of_axes(system: System, spread: np.ndarray, seed: int) -> System:
    """The system with victims, attacker and decoys that are spread like this along the axes."""
    n = system.templates.n
    rng = np.random.default_rng(seed)

    def draw(count: int) -> np.ndarray:
        return unit(rng.normal(size=(count, n)) * spread)

    enrolled, source = draw(40), DecoyGenerator.fit(draw(2000))
    return replace(
        system,
        lifter=replace(system.lifter, source=source),
        source=source,
        attacker=draw(300),
        victims=replace(
            system.victims,
            enrolled=enrolled,
            fresh=unit(enrolled + 0.3 * draw(40)),
        ),
    )


@pytest.mark.long
def test_two_databases_of_uneven_axes_are_linked_only_where_a_tenant_has_one_rotation(
    system: System,
) -> None:
    people = of_axes(system, np.geomspace(1.0, 0.05, system.templates.n), seed=1)
    rows = link_databases(people, accounts=(300,), strangers=1000, permutations=200)
    # Which signatures tell apart has a test of its own above.
    *judged, feet, nearest, _lengths, _signatures = rows
    for row in judged:
        if "signatures" not in row.variant:
            assert is_within_null(row), row.variant
    assert nearest.variant == (
        "300 accounts, one rotation a tenant, estimated rotations, nearest points"
    )
    assert nearest.measured.value > 0.5
    assert not is_within_null(feet)


@pytest.mark.long
def test_databases_of_even_axes_without_accounts_are_not_linked(system: System) -> None:
    noise = of_axes(system, np.ones(system.templates.n), seed=2)
    nobody = replace(noise, victims=replace(noise.victims, fresh=noise.victims.enrolled[::-1]))
    for people, accounts in ((noise, (0,)), (nobody, (0, 300))):
        rows = link_databases(people, accounts=accounts, strangers=500, permutations=200)
        for row in rows:
            assert is_within_null(row), row.variant


def test_no_strangers_are_refused(system: System) -> None:
    with pytest.raises(AuditError, match="strangers"):
        link_databases(replace(system), strangers=0)
