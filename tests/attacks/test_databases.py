from dataclasses import replace

import numpy as np
import pytest

from attacks.chosen_enrollment import Sides, estimate_from_sets, product_pairs
from attacks.databases import (
    FEW_DECOYS,
    Moments,
    _judged_by,
    estimate_rotation,
    link_databases,
    whitened_cosines,
)
from attacks.errors import AuditError
from attacks.outcomes import (
    CONTROL,
    GENERATED,
    AttackOutcome,
    Estimate,
    Knowledge,
    Leaked,
    Property,
    Scheme,
)
from attacks.system import System
from attacks.verdict import judge
from templates.decoys import DecoyGenerator
from templates.keys.randomness import Keystream
from templates.space.subspace import SubspaceBatch
from tests.attacks.test_linkage import is_within_null
from tests.verify.synthetic import random_rotation, unit

N, M = 16, 2


def templates(spread: np.ndarray, count: int, *, seed: int) -> SubspaceBatch:
    """Lift people who are spread like this, with decoys that are too."""
    rng = np.random.default_rng(seed)
    people = unit(rng.normal(size=(count, N)) * spread + 0.3 * spread)
    decoys = unit(rng.normal(size=(count, M, N)) * spread + 0.3 * spread)
    with Keystream.seeded("test", seed) as stream:
        return SubspaceBatch.through(people, decoys - people[:, None], stream=stream)


def alignment(estimate: np.ndarray, rotation: np.ndarray) -> float:
    return float(np.trace(estimate.T @ rotation) / N)


def test_a_database_of_uneven_axes_gives_its_rotation_away() -> None:
    spread = np.geomspace(1.0, 0.1, N)
    rotation = random_rotation(N)
    stolen, lifted = (templates(spread, 3000, seed=seed) for seed in (1, 2))
    estimate = estimate_rotation(Moments.of(stolen.rotated(rotation)), Moments.of(lifted))
    np.testing.assert_allclose(estimate @ estimate.T, np.eye(N), atol=1e-9)
    assert alignment(estimate, rotation) > 0.9


def test_few_accounts_and_the_moments_together_tell_more_than_either() -> None:
    """Four accounts span 12 of 16 numbers."""
    spread = np.geomspace(1.0, 0.3, N)
    rotation = random_rotation(N)
    others, sent, lifted = (
        templates(spread, count, seed=seed) for count, seed in ((800, 1), (4, 2), (800, 3))
    )
    with Keystream.seeded("bases of the service") as stream:
        stored = SubspaceBatch.through(sent.feet, sent.bases, stream=stream).rotated(rotation)
    stolen = Moments.of(SubspaceBatch.of([*others.rotated(rotation), *stored]))
    accounts = Sides(sent, stored)
    together = estimate_rotation(stolen, Moments.of(lifted), product_pairs(accounts))
    np.testing.assert_allclose(together @ together.T, np.eye(N), atol=1e-9)
    alone = (estimate_from_sets(accounts), estimate_rotation(stolen, Moments.of(lifted)))
    least = max(alignment(estimate, rotation) for estimate in alone)
    assert alignment(together, rotation) > least + 0.1


def test_even_axes_and_no_accounts_give_nothing_away() -> None:
    def noise(seed: int) -> SubspaceBatch:
        with Keystream.seeded("noise", seed) as stream:
            draws = np.random.default_rng(seed).normal(size=(500, M + 1, N))
            return SubspaceBatch.through(unit(draws[:, 0]), draws[:, 1:], stream=stream)

    aligned = [
        alignment(
            estimate_rotation(
                Moments.of(noise(seed).rotated(random_rotation(N, seed))),
                Moments.of(noise(seed + 100)),
            ),
            random_rotation(N, seed),
        )
        for seed in range(6)
    ]
    assert abs(np.mean(aligned)) < 0.2


def test_the_true_rotation_links_by_whitened_feet() -> None:
    spread = np.geomspace(1.0, 0.1, N)
    batch, lifted = templates(spread, 60, seed=1), templates(spread, 500, seed=2)
    scores = whitened_cosines(batch, batch, Moments.of(lifted))
    assert (scores.argmax(axis=1) == np.arange(60)).all()


def test_rows_are_of_few_decoys_and_of_the_scheme_s_own(system: System) -> None:
    rows = link_databases(system, accounts=(0, 5, 20, 10_000), strangers=150, permutations=200)
    # Two scores of each setting. 20 accounts fix a rotation of R^64 at m = 4 and at m = 6.
    few = [row for row in rows if row.details["m"] == 4]
    own = [row for row in rows if row.details["m"] == 6]
    assert [row.details["accounts"] for row in few[:6]] == [20, 20, 5, 5, 0, 0]  # the controls
    assert [row.details["accounts"] for row in few[6:]] == [20] * 6 + [5, 5, 0, 0]
    assert [row.details["accounts"] for row in own] == [20] * 8
    assert [row.unjudged == CONTROL for row in few] == [True] * 6 + [False] * 10
    assert [row.unjudged == CONTROL for row in own] == [True] * 2 + [False] * 6
    # Of few decoys none fills a cell of the scheme's, whatever its control shows.
    assert not any(row.judged for row in few)
    assert {FEW_DECOYS} < {row.unjudged for row in few}
    # Others are enrolled where moments are estimated.
    assert {row.details["strangers"] for row in few} == {150}
    assert {row.details["strangers"] for row in own} == {0}
    for row in rows:
        assert ("one rotation a tenant" in row.variant) == (row.unjudged == CONTROL)
        assert row.variant.startswith(f"m = {row.details['m']}, ")
    kept = [row for row in rows if "holders' keys kept" in row.variant]
    assert len(kept) == 8
    assert all("keys that people keep" in row.assumption for row in kept)
    assert sum("two halves of one tenant" in row.variant for row in kept) == 4


@pytest.mark.parametrize(("links", "judged"), [(0.9, True), (0.02, False)])
def test_few_decoys_are_judged_only_where_they_link(links: float, judged: bool) -> None:
    def row(d_sys: float) -> AttackOutcome:
        return AttackOutcome(
            attack="database-linkage",
            breaks=Property.UNLINKABILITY,
            leaked=Leaked.MASTER_KEY,
            knowledge=Knowledge.TEMPLATES,
            assumption="",
            scheme=Scheme("adversarial", GENERATED, 160),
            measured=Estimate(d_sys, d_sys - 0.02, d_sys + 0.02, 100, "bootstrap"),
            chance=0.05,
            details={"null_95_percent": 0.08},
        )

    few = _judged_by(row(0.97), row(links), of_scheme=False)
    assert few.judged == judged
    (verdict,) = judge([few, replace(row(0.97), unjudged=CONTROL)])
    assert verdict.passed is (False if judged else None)


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
def test_two_databases_are_linked_only_where_a_tenant_has_one_rotation(system: System) -> None:
    people = of_axes(system, np.geomspace(1.0, 0.05, system.templates.n), seed=1)
    rows = link_databases(people, accounts=(0, 20), strangers=1000, permutations=200)
    for row in rows:
        if "one rotation" not in row.variant:
            assert is_within_null(row), row.variant
    control = next(row for row in rows if row.variant.endswith("a tenant, nearest points"))
    assert control.variant == "m = 4, 20 accounts, one rotation a tenant, nearest points"
    assert control.measured.value > 0.8
    proven = [row for row in rows if row.unjudged == FEW_DECOYS]
    assert {"m = 4, 20 accounts, nearest points"} <= {row.variant for row in proven}


@pytest.mark.long
def test_a_row_whose_control_links_nobody_proves_nothing(system: System) -> None:
    noise = of_axes(system, np.ones(system.templates.n), seed=2)
    others = of_axes(system, np.ones(system.templates.n), seed=3).victims.enrolled
    nobody = replace(noise, victims=replace(noise.victims, fresh=others))
    rows = link_databases(nobody, accounts=(0, 20), strangers=500, permutations=200)
    control_of = {
        (row.details["m"], row.details["accounts"], row.variant.split(", ")[-1]): row
        for row in rows
        if row.unjudged == CONTROL
    }
    for row in rows:
        assert is_within_null(row), row.variant
        if row.unjudged != CONTROL:
            name = row.variant.split(", ")[-1]
            control = control_of[row.details["m"], row.details["accounts"], name]
            assert control.measured.ci_low <= float(str(control.details["null_95_percent"]))
            assert str(row.unjudged).startswith("it proves nothing")


def test_without_accounts_there_are_no_two_halves(system: System) -> None:
    rows = link_databases(system, accounts=(0,), strangers=100, permutations=200)
    assert {row.details["accounts"] for row in rows} == {0}
    assert any("holders' keys kept" in row.variant for row in rows)
    assert not any("two halves" in row.variant for row in rows)


@pytest.mark.parametrize(
    ("asked", "message"),
    [({"strangers": 0}, "strangers"), ({"accounts": (10_000,)}, "accounts")],
)
def test_what_tells_nothing_is_refused(
    system: System, asked: dict[str, object], message: str
) -> None:
    with pytest.raises(AuditError, match=message):
        link_databases(system, **asked)  # type: ignore[arg-type]
