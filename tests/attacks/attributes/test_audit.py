"""Which attacker is quoted, what is judged, and what is refused before a face is embedded."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from attacks.attributes.audit import ATTACK, attribute_outcomes, run_attribute_audit
from attacks.attributes.plan import AttributePlan
from attacks.attributes.rows import AttributeRow, measure
from attacks.outcomes import RAW_SCHEME, AttackOutcome, AuditError, KnowledgeLevel, Property, Scheme
from attacks.verdict import judge
from tests.attacks.attributes.people import faces
from verify.metrics import wilson

SERVICE = Scheme("adversarial", "generator", 32)
POOL = Scheme("adversarial", "pool", 32)
FACES = 200


def plan(strategy: str, m: int) -> AttributePlan:
    """An audit of a scheme with a pool, of 110 lifting faces and 120 of the attacker's."""
    return AttributePlan(
        schemes=(RAW_SCHEME, Scheme(strategy, "pool", m)),
        lifting=110,
        attack=120,
        attacked=30,
    )


def row(
    scheme: Scheme,
    attacker: str,
    right: int,
    *,
    held_out: float,
    knowledge: KnowledgeLevel = KnowledgeLevel.ALGORITHM,
    attribute: str = "gender",
) -> AttributeRow:
    """``right`` of 200 faces, half of each class, are told; the others are mistaken."""
    truth = np.arange(FACES) % 2
    predicted = np.where(np.arange(FACES) < right, truth, 1 - truth)
    made = measure(
        predicted,
        truth,
        scheme=scheme,
        attribute=attribute,
        attacker=attacker,
        metric=None,
        knowledge=knowledge,
        classes=("Male", "Female"),
        seed=0,
    )
    return replace(made, held_out=held_out)


def raw(attribute: str = "gender") -> AttributeRow:
    """Raw embeddings tell 180 of 200: a gain of 0.4 over the larger class."""
    return row(RAW_SCHEME, "logistic", 180, held_out=0.4, attribute=attribute)


def only(rows: list[AttributeRow]) -> AttackOutcome:
    of_raw = raw(rows[0].attribute)
    outcomes = attribute_outcomes([of_raw, *rows], audited=SERVICE)
    (outcome,) = [one for one in outcomes if one.scheme == SERVICE]
    return outcome


def test_the_attacker_who_was_strongest_at_home_is_quoted_and_not_the_luckiest() -> None:
    outcome = only(
        [
            row(SERVICE, "knn", 110, held_out=0.02),
            row(SERVICE, "logistic", 120, held_out=0.2),
            row(SERVICE, "logistic", 150, held_out=0.1),
        ]
    )
    assert (outcome.attack, outcome.variant) == (ATTACK, "gender by logistic")
    assert (outcome.measured.value, outcome.chance) == (0.6, 0.5)
    assert (outcome.measured.ci_low, outcome.measured.ci_high) == wilson(120, FACES)
    assert outcome.measured.trials == FACES
    assert outcome.breaks is Property.CONFIDENTIALITY
    assert outcome.level is None
    assert "success is the right gender" in outcome.assumption


def test_who_holds_the_pool_is_quoted_apart_and_says_so() -> None:
    outcomes = attribute_outcomes(
        [
            raw(),
            row(POOL, "knn", 100, held_out=0.0),
            row(POOL, "strip", 180, held_out=0.4, knowledge=KnowledgeLevel.DECOYS),
        ],
        audited=SERVICE,
    )
    by_knowledge = {one.knowledge: one for one in outcomes if one.scheme == POOL}
    assert by_knowledge[KnowledgeLevel.ALGORITHM].measured.value == 0.5
    assert by_knowledge[KnowledgeLevel.DECOYS].measured.value == 0.9
    assert (
        "the pool that the decoys were drawn from" in by_knowledge[KnowledgeLevel.DECOYS].assumption
    )
    assert "pool" not in by_knowledge[KnowledgeLevel.ALGORITHM].assumption


def test_only_the_audited_scheme_is_judged() -> None:
    outcomes = attribute_outcomes(
        [
            row(scheme, "knn", 190, held_out=0.4, attribute=attribute)
            for scheme in (RAW_SCHEME, POOL, SERVICE)
            for attribute in ("gender", "race")
        ],
        audited=SERVICE,
    )
    assert len(outcomes) == 6
    assert {outcome.scheme for outcome in outcomes if outcome.judged} == {SERVICE}
    (verdict,) = judge(outcomes)
    assert verdict.scheme == SERVICE
    assert not verdict.passed


@pytest.mark.parametrize(
    ("right", "passed"), [(40, False), (100, True), (119, True), (125, False), (160, False)]
)
def test_more_than_a_quarter_of_what_raw_embeddings_gain_fails(right: int, passed: bool) -> None:
    """On either side of chance."""
    (verdict,) = judge([only([row(SERVICE, "knn", right, held_out=0.3)])])
    assert verdict.passed is passed


def test_what_raw_embeddings_do_not_tell_is_not_judged_and_without_them_nothing_is() -> None:
    nothing = row(RAW_SCHEME, "logistic", 100, held_out=0.0)
    outcomes = attribute_outcomes(
        [nothing, row(SERVICE, "logistic", 150, held_out=0.1)], audited=SERVICE
    )
    assert outcomes[1].unjudged == "raw embeddings do not tell it either"
    with pytest.raises(AuditError, match="add `raw`"):
        attribute_outcomes([row(SERVICE, "logistic", 150, held_out=0.1)], audited=SERVICE)


def test_an_audit_reports_its_progress_and_the_sizes_of_its_parts() -> None:
    shares: list[float] = []
    some = replace(
        plan("adversarial", 4),
        schemes=(*plan("adversarial", 4).schemes, Scheme("adversarial", "generator", 4, 40)),
        axes=40,
    )
    rows, parts = run_attribute_audit(
        some, faces(230, seed=1), faces(40, seed=2), progress=shares.append
    )
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0, 1)
    assert {row.scheme for row in rows} == set(some.schemes)
    assert (len(parts.lifting), len(parts.attack), len(parts.attacked)) == (110, 120, 30)


@pytest.mark.parametrize(("strategy", "most"), [("adversarial", 15), ("hybrid", 31)])
def test_no_more_decoys_are_asked_of_a_pool_than_it_gives(strategy: str, most: int) -> None:
    """The attacker's folds have 30 faces, which are lifted with one another."""
    assert plan(strategy, most).attacker_faces(240) == 120
    run_attribute_audit(plan(strategy, most), faces(230, seed=1), faces(40, seed=2))
    with pytest.raises(AuditError, match="takes more decoys than 15"):
        plan(strategy, most + 1).attacker_faces(240)


@pytest.mark.parametrize(
    ("training", "changes", "said"),
    [
        (120, {}, "10 faces leave 7 in the gallery of a fold, and 50"),
        (240, {"training_most": 8}, "a fold of 2 faces is too small to hold some of them"),
        (110, {}, "110 lifting faces and 120 for the attacker cannot be taken from 110"),
        (110, {"attack": None}, "110 lifting faces and the others for the attacker cannot be"),
        (240, {"gallery_most": 9}, "leave 9 in the gallery of a fold"),
    ],
)
def test_too_few_faces_are_refused_before_they_are_embedded(
    training: int, changes: dict[str, Any], said: str
) -> None:
    with pytest.raises(AuditError, match=said):
        replace(plan("hybrid", 4), **changes).attacker_faces(training)
    generated = replace(plan("hybrid", 4), schemes=(replace(SERVICE, dim=63),))
    assert generated.attacker_faces(240) == 120  # these need no pool
