import numpy as np
import pytest
from scipy.stats import binom

from attacks.outcomes import AttackOutcome, Knowledge, Leaked
from attacks.several_templates import meeting_point, nearest_common_points, several_templates
from attacks.stored.second_moments import Guesser
from attacks.system import System
from tests.verify.synthetic import unit

PEOPLE = 80


@pytest.fixture(scope="module")
def albums(system: System) -> list[np.ndarray]:
    """Six photos each of further people."""
    rng = np.random.default_rng(6)
    n = system.source.n
    centres = unit(rng.normal(size=(PEOPLE, 1, n)))
    return list(unit(centres + 0.4 * unit(rng.normal(size=(PEOPLE, 6, n)))).astype(np.float32))


def rows_of(system: System, albums: list[np.ndarray]) -> dict[str, AttackOutcome]:
    found = several_templates(system, albums, Guesser(system))
    rows = {each.variant: each for each in found}
    assert len(rows) == len(found)
    return rows


@pytest.fixture(scope="module")
def rows(system: System, albums: list[np.ndarray]) -> dict[str, AttackOutcome]:
    return rows_of(system, albums)


LIKELIEST, NEAREST = "mean of the likeliest", "nearest to all"
KEPT, STOLEN = "holder's key kept", "holder's key stolen"


def nearness(row: AttackOutcome) -> float:
    return float(str(row.details["cosine_to_truth_mean"]))


def test_two_secrets_give_two_lifts_which_meet_in_the_person(
    system: System, rows: dict[str, AttackOutcome]
) -> None:
    row = rows[f"the same photos under two lift secrets, 2 templates, {NEAREST}, {STOLEN}"]
    assert row.unjudged == "fewer than 75 people have the photos"
    assert row.measured.value > 0.9
    first, second = (system.lift(system.victims.enrolled, name) for name in ("one", "two"))
    met = nearest_common_points([first, second])
    assert np.einsum("ij,ij->i", met, system.victims.enrolled).min() > 0.99


def test_the_meeting_point_solves_the_normal_equations(system: System) -> None:
    batches = [system.lift(system.victims.enrolled[:1], str(number)) for number in range(3)]
    feet, bases = (
        np.stack([getattr(batch, part)[0] for batch in batches]).astype(float)
        for part in ("feet", "bases")
    )
    point = meeting_point(feet, bases)
    gaps = (point - feet) - np.einsum("tmn,tm->tn", bases, np.einsum("tmn,n->tm", bases, point))
    np.testing.assert_allclose(gaps.sum(axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose(point, system.victims.enrolled[0], atol=0.02)


def test_photos_that_overlap_give_two_lifts_of_nearly_one_embedding(
    rows: dict[str, AttackOutcome],
) -> None:
    """Nearer to the person than two templates of different photos."""
    different = nearness(rows[f"different photos, 2 templates, {NEAREST}, {STOLEN}"])
    overlap = "two of three photos the same"
    assert nearness(rows[f"{overlap}, 2 templates, {NEAREST}, {STOLEN}"]) > different
    assert rows[f"{overlap}, 2 templates, {NEAREST}, {KEPT}"].measured.value <= 1 / PEOPLE


def test_more_photos_lead_to_the_person(rows: dict[str, AttackOutcome]) -> None:
    two, five = (
        rows[f"different photos, {count} templates, {NEAREST}, {STOLEN}"] for count in (2, 5)
    )
    assert nearness(two) < nearness(five)
    assert five.measured.value > 0.5


def test_without_the_holders_key_no_number_of_templates_tells_anything(
    rows: dict[str, AttackOutcome],
) -> None:
    for name in (LIKELIEST, NEAREST):
        row = rows[f"different photos, 5 templates, {name}, {KEPT}"]
        assert row.measured.errors <= binom.ppf(0.999, PEOPLE, row.chance)
        assert abs(nearness(row)) < 0.15
        assert (row.leaked, row.knowledge) == (Leaked.MASTER_KEY, Knowledge.TEMPLATES)
        assert row.judged


def test_the_last_photo_alone_decides(system: System, albums: list[np.ndarray]) -> None:
    """Where it is of nobody, the same guesses match nobody; few people are not judged."""
    noise = unit(np.random.default_rng(7).normal(size=(19, system.source.n)))
    replaced = [
        np.stack([*a[:5], z]).astype(np.float32) for a, z in zip(albums, noise, strict=False)
    ]
    row = rows_of(system, replaced)[f"different photos, 5 templates, {NEAREST}, {STOLEN}"]
    assert row.measured.value <= 1 / 19
    assert row.details["people"] == 19
    assert not row.judged
    assert row.unjudged == "fewer than 75 people have the photos"
