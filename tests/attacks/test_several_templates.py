import numpy as np
import pytest

from attacks.likelihood import likeliest_guess
from attacks.outcomes import AttackOutcome, Knowledge, Leaked
from attacks.several_templates import enrolled, several_templates
from attacks.system import System
from tests.verify.synthetic import unit

PEOPLE = 24


@pytest.fixture(scope="module")
def albums(system: System) -> list[np.ndarray]:
    """Four photos each of further people."""
    rng = np.random.default_rng(6)
    n = system.templates.n
    centres = unit(rng.normal(size=(PEOPLE, 1, n)))
    return list(unit(centres + 0.4 * unit(rng.normal(size=(PEOPLE, 4, n)))))


def rows_of(system: System, albums: list[np.ndarray]) -> dict[str, AttackOutcome]:
    found = several_templates(system, albums, likeliest_guess(system))
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


def test_the_same_photos_twice_give_no_more_than_once(
    system: System, rows: dict[str, AttackOutcome]
) -> None:
    """Two copies differ by the rounding of float16, which moves a guess across the threshold."""
    once = rows[f"the same photos, 1 templates, {LIKELIEST}, {STOLEN}"]
    twice, nearest = (
        rows[f"the same photos, 2 templates, {name}, {STOLEN}"] for name in (LIKELIEST, NEAREST)
    )
    assert twice.measured.value <= once.measured.value + 1 / 40
    assert abs(nearness(twice) - nearness(once)) < 0.02
    # They meet in all of the template, of which no point is nearer than another.
    assert nearness(nearest) < float(system.templates.foot_norms.mean()) + 0.05


def test_two_secrets_give_two_lifts_which_meet_in_the_person(
    system: System, rows: dict[str, AttackOutcome]
) -> None:
    """The same attack as in the row above, where a secret drew other decoys."""
    one, other = (
        rows[f"the same photos{secrets}, 2 templates, {NEAREST}, {STOLEN}"]
        for secrets in ("", " under two lift secrets")
    )
    assert one.judged
    assert other.judged  # two tenants have it of who keeps a key
    assert nearness(other) > nearness(one) + 0.3
    assert other.measured.value > one.measured.value + 0.3
    first, again = (enrolled(system, "a secret") for _ in range(2))
    np.testing.assert_allclose(first.foot_norms, again.foot_norms, atol=1e-3)
    moved = np.abs(first.foot_norms - enrolled(system, "another").foot_norms)
    assert np.median(moved) > 0.01


def test_photos_that_overlap_give_two_lifts_of_nearly_one_descriptor(
    rows: dict[str, AttackOutcome],
) -> None:
    """Nearer to the person than two templates of different photos."""
    different = nearness(rows[f"different photos, 2 templates, {NEAREST}, {STOLEN}"])
    assert nearness(rows[f"one photo more, 2 templates, {NEAREST}, {STOLEN}"]) > different
    assert not any("two of three" in variant for variant in rows)  # nobody has a fifth photo
    kept = rows[f"one photo more, 2 templates, {NEAREST}, {KEPT}"]
    assert kept.measured.value <= 1 / PEOPLE


def test_more_photos_lead_to_the_person(rows: dict[str, AttackOutcome]) -> None:
    """The nearest point to several templates is nearer to the person, photo by photo."""
    two, three = (
        rows[f"different photos, {count} templates, {NEAREST}, {STOLEN}"] for count in (2, 3)
    )
    assert nearness(two) < nearness(three)
    assert three.measured.value > 0.5
    assert not any("4 templates" in variant for variant in rows)


def test_without_the_holders_key_no_number_of_templates_tells_anything(
    rows: dict[str, AttackOutcome],
) -> None:
    for photos, count in (("the same photos", 2), ("different photos", 3)):
        for name in (LIKELIEST, NEAREST):
            row = rows[f"{photos}, {count} templates, {name}, {KEPT}"]
            assert row.measured.value <= 1 / PEOPLE
            assert abs(nearness(row)) < 0.15
            assert (row.leaked, row.knowledge) == (Leaked.MASTER_KEY, Knowledge.TEMPLATES)
            assert row.judged


def test_the_last_photo_alone_decides(system: System, albums: list[np.ndarray]) -> None:
    """Where it is of nobody, the same guesses match nobody; few people are not judged."""
    noise = unit(np.random.default_rng(7).normal(size=(19, system.templates.n)))
    replaced = [np.stack([*a[:3], z]) for a, z in zip(albums, noise, strict=False)]
    row = rows_of(system, replaced)[f"different photos, 3 templates, {NEAREST}, {STOLEN}"]
    assert row.measured.value <= 1 / 19
    assert row.details["people"] == 19
    assert not row.judged
    assert row.unjudged == "fewer than 20 people have the photos"
