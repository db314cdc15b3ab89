"""The runner: how results are scored, which controls are made, and what is judged by them."""

from collections.abc import Iterator

import numpy as np
import pytest
from sklearn.metrics import roc_auc_score

from attacks.attack import Guesses, LinkScores, Probes, attack
from attacks.bed import Testbed
from attacks.outcomes import CONTROL, Knowledge, KnowledgeLevel, Leaked, Property, Scheme
from attacks.presented import passes_checks
from attacks.recovery import area_under_curve, recoveries
from attacks.runner import run_attack
from attacks.stored import attacks_on_templates
from attacks.verdict import Status, judge
from templates.space.subspace import SubspaceBatch
from tests.attacks.beds import VICTIMS, bed_of, counts, noise, rows_of
from tests.verify.synthetic import unit


@attack(breaks=Property.IRREVERSIBILITY, needs=Knowledge(generator=True, faces=True))
def knows_the_truth(bed: Testbed) -> Iterator[Guesses]:
    """What was enrolled, if these are the victims' templates.

    This is no part of the assumption.
    """
    near = np.abs(bed.templates.feet - bed_of().templates.feet).max() < 0.01
    yield Guesses(bed.victims.enrolled if near else bed.templates.feet, "the truth")
    yield Guesses(noise(len(bed.victims), seed=5), "noise")


@attack(breaks=Property.IRREVERSIBILITY, needs=Knowledge())
def knows_few_decoys(bed: Testbed) -> Iterator[Guesses]:
    """Nothing, unless the template has few decoys."""
    yield Guesses(bed.victims.enrolled if bed.m == 4 else noise(len(bed.victims), seed=6))


def test_an_attack_is_named_by_its_function_and_assumes_what_its_docstring_says() -> None:
    rows = rows_of(knows_the_truth, bed_of())
    first = rows["the truth"]
    assert first.attack == "knows-the-truth"
    assert first.assumption == "What was enrolled, if these are the victims' templates."
    assert (first.breaks, first.knowledge) == (Property.IRREVERSIBILITY, KnowledgeLevel.ALGORITHM)
    assert counts(first) == (VICTIMS, VICTIMS)
    assert "it takes 100 victims" in str(first.details["too_few"])


def test_the_strongest_variant_has_its_controls() -> None:
    rows = rows_of(knows_the_truth, bed_of())
    assert list(rows) == [
        "the truth", "noise", "the truth, photos of other people", "the truth, holder's key kept",
    ]  # fmt: skip
    others, kept = list(rows.values())[2:]
    assert (others.unjudged, counts(others)[0] <= 1) == (CONTROL, True)
    assert (kept.unjudged, kept.leaked, counts(kept)[0] <= 1) == (None, Leaked.MASTER_KEY, True)


def test_what_fails_with_the_key_proves_nothing_without_and_is_tried_on_few_decoys() -> None:
    rows = rows_of(knows_few_decoys, bed_of())
    kept, few = rows["holder's key kept"], rows["m = 4"]
    assert str(kept.unjudged).startswith("it proves nothing, for its control, the same with the")
    assert (few.unjudged, few.scheme, few.measured.value) == (CONTROL, bed_of().scheme, 1.0)


def test_the_area_under_the_curve_is_that_of_scikit_learn() -> None:
    scores = np.round(np.random.default_rng(0).normal(size=(30, 30)) + np.eye(30), 1)
    expected = roc_auc_score(np.eye(30).ravel(), scores.ravel())
    assert area_under_curve(scores) == pytest.approx(expected)
    assert area_under_curve(np.ones((1, 1))) == 0.5


def test_a_guess_that_crosses_no_threshold_may_still_leak() -> None:
    bed = bed_of()

    @attack(breaks=Property.IRREVERSIBILITY, needs=Knowledge())
    def blurred(bed: Testbed) -> Iterator[Guesses]:
        """The truth, far away."""
        yield Guesses(unit(bed.victims.enrolled + 6 * noise(VICTIMS, seed=3)))

    (found,) = recoveries(blurred, bed)
    assert found.matched.value < 0.1
    assert found.auc > 0.7


@pytest.mark.parametrize(
    ("breaks", "opened_anew"), [(Property.IMPERSONATION, 1.0), (Property.RENEWABILITY, 0.9)]
)
def test_probes_from_a_template_are_sent_with_its_rotation_and_without(
    breaks: Property, opened_anew: float
) -> None:
    @attack(breaks=breaks, needs=Knowledge())
    def truth(bed: Testbed) -> Iterator[Probes]:
        """What was enrolled."""
        yield Probes(bed.victims.enrolled)
        yield Probes(noise(len(bed.victims)), "noise")

    rows = rows_of(truth, bed_of())
    known, secret = rows["with the key"], rows["without the key"]
    assert known.measured.value >= opened_anew
    assert (known.leaked, secret.leaked) == (Leaked.HOLDER_KEYS, Leaked.MASTER_KEY)
    assert (secret.judged, counts(secret)[0] <= 1) == (True, True)
    assert str(rows["noise, without the key"].unjudged).startswith("it proves nothing")


def test_probes_that_need_no_template_are_sent_as_they_are_after_the_checks() -> None:
    @attack(breaks=Property.IMPERSONATION, needs=Knowledge(template=False))
    def too_long(bed: Testbed) -> Iterator[Probes]:
        """The truth, longer than an embedding is, and the first victim's for all."""
        yield Probes(1.01 * bed.victims.enrolled, "long")
        yield Probes(bed.victims.enrolled[:1], "one for all")

    rows = rows_of(too_long, bed_of())
    assert counts(rows["long"]) == (0, VICTIMS)
    assert rows["long"].details["refused_by_the_input_checks"] == VICTIMS
    assert rows["long"].leaked is Leaked.DATABASE
    hits, trials = counts(rows["one for all"])
    assert (1 <= hits <= 3, trials) == (True, VICTIMS)


def test_the_input_checks_are_those_of_the_service() -> None:
    bed = bed_of()
    rows = noise(3) * np.array([[1.0], [1.01], [0.0]], dtype=np.float32)
    assert passes_checks(rows, bed.points).tolist() == [True, False, False]
    assert bed.lifted is not None
    honest = bed.lift(noise(20), "honest", m=bed.lifted.probe_m)
    assert passes_checks(honest, bed.lifted).all()
    zero = SubspaceBatch(0 * honest.feet, honest.bases)
    assert not passes_checks(zero, bed.lifted).any()


def test_templates_are_linked_in_every_setting_and_judged_by_one_set_in_two_rotations() -> None:
    @attack(breaks=Property.UNLINKABILITY, needs=Knowledge())
    def nothing(bed: Testbed) -> Iterator[LinkScores]:
        """Noise."""
        yield LinkScores(np.random.default_rng(1).normal(size=(VICTIMS, VICTIMS)))

    rows = rows_of(nothing, bed_of())
    judged = ["secret rotations", "one tenant", "holder's key kept"]
    assert list(rows) == [*judged, "one set for both"]
    for setting in judged:
        assert rows[setting].leaked is Leaked.MASTER_KEY
        assert "one set in two rotations, does not succeed" in str(rows[setting].unjudged)


@pytest.mark.parametrize(
    ("needs", "level", "of_pool"),
    [
        (Knowledge(), "template", "template"),
        (Knowledge(faces=True), "algorithm", "algorithm"),
        (Knowledge(generator=True, lifting=True), "algorithm", "decoys"),
        (Knowledge(pool=True, faces=True), "decoys", "decoys"),
        (Knowledge(several=True, generator=True), "templates", "templates"),
    ],
)
def test_what_an_attack_needs_is_a_column_of_the_report(
    needs: Knowledge, level: str, of_pool: str
) -> None:
    generated, pooled = (Scheme("adversarial", source, 8) for source in ("generator", "pool"))
    assert (needs.level(generated), needs.level(pooled)) == (level, of_pool)


def test_every_attack_of_the_package_is_found_once() -> None:
    names = [one.name for one in attacks_on_templates()]
    assert sorted(names) == sorted(set(names))
    assert set(names) >= {
        "foot-lengths", "foot-point", "known-pool", "lifted-wolf", "mean-of-likeliest",
        "nearest-neighbour", "nearest-to-all", "oracle", "pool-owner", "renewed-template",
        "second-moments", "stolen-template", "wolf-embedding",
    }  # fmt: skip
    assert all(one.assumption.endswith(".") for one in attacks_on_templates())


def test_the_verdict_has_the_rows_of_the_runner() -> None:
    rows = run_attack(knows_the_truth, bed_of())
    (verdict,) = judge(rows)
    by_limit = {cell.limit: cell for cell in verdict.cells}
    assert by_limit["recovery-success"].status is Status.FAIL
    assert by_limit["success-without-key"].excess <= 1 / VICTIMS
