"""Each attack succeeds where it must, and on nobody's photos by chance only."""

from dataclasses import replace

import numpy as np
import pytest

from attacks.attack import Attack
from attacks.bed import Pairs, Testbed
from attacks.outcomes import AttackOutcome, KnowledgeLevel, Leaked
from attacks.runner import run_attack
from attacks.stored.foot_point import foot_point, foot_points
from attacks.stored.known_pool import known_pool, pool_owner
from attacks.stored.linkage import foot_lengths
from attacks.stored.nearest_neighbour import nearest_neighbour, oracle
from attacks.stored.second_moments import second_moments
from attacks.stored.several_templates import mean_of_likeliest, nearest_to_all
from attacks.stored.stolen_template import renewed_template, stolen_template
from attacks.stored.wolves import lifted_wolf, wolf_embedding
from tests.attacks.beds import (
    VICTIMS,
    M,
    bed_of,
    counts,
    is_within_null,
    noise,
    rows_of,
    weak_bed,
)
from tests.verify.synthetic import unit

SAME = "the same photos under two lift secrets, 2 templates"


def strangers(bed: Testbed) -> Testbed:
    """The fresh photos are of nobody."""
    fresh = noise(len(bed.victims), bed.source.k, seed=9)
    return replace(bed, victims=Pairs(bed.victims.enrolled, fresh))


@pytest.mark.parametrize(
    ("attack", "decoys", "variant", "least"),
    [
        (foot_point, None, "", 1.0),
        (second_moments, None, "2,456 faces, photos, 0 of decoys' moments", 0.4),
        (known_pool, "pool", "", 0.95),
        (nearest_neighbour, None, "", 0.9),
        (oracle, "generator", "projected", 0.9),
        (nearest_to_all, "generator", SAME, 0.9),
        (mean_of_likeliest, None, SAME, 0.5),
    ],
    ids=lambda value: value.name if isinstance(value, Attack) else None,
)
def test_a_guess_is_right_where_it_must_be_and_of_nobody_by_chance(
    attack: Attack, decoys: str | None, variant: str, least: float
) -> None:
    bed = weak_bed() if decoys is None else bed_of(decoys)
    rows = rows_of(attack, bed)
    assert rows[variant].measured.value >= least
    kept = [row for row in rows.values() if row.leaked is Leaked.MASTER_KEY]
    assert all(counts(row)[0] <= 1 for row in kept)
    assert bool(kept) == (attack is not oracle)
    nobody = {row.variant: row for row in run_attack(attack, strangers(bed))}
    assert counts(nobody[variant])[0] <= 2


def test_the_cosine_of_the_foot_point_is_its_norm() -> None:
    bed = bed_of()
    found = foot_points(bed.templates)
    norms = bed.templates.foot_norms
    cosines = np.einsum("ij,ij->i", found, bed.victims.enrolled)
    np.testing.assert_allclose(cosines, norms, atol=1e-3)
    assert np.linalg.norm(found, axis=1) == pytest.approx(1)
    # Six decoys beside the embedding, nearly orthogonal: ‖p‖² ≈ 1/7.
    assert norms.mean() == pytest.approx(7**-0.5, abs=0.05)


def test_a_known_pool_gives_every_decoy_and_its_people_are_accepted() -> None:
    known = rows_of(known_pool, bed_of("pool"))[""]
    assert known.details["decoys_found_mean"] == M
    assert known.knowledge is KnowledgeLevel.DECOYS
    (owner,) = rows_of(pool_owner, bed_of("pool")).values()
    assert owner.measured.value > 0.8
    assert owner.leaked is Leaked.DATABASE
    assert rows_of(known_pool, bed_of()) == rows_of(pool_owner, bed_of()) == {}


def test_a_template_is_recognised_with_another_photo_and_the_oracle_comes_nearer_with_k() -> None:
    row = rows_of(nearest_neighbour, bed_of())[""]
    recognised = row.details["victims_recognised_in_a_gallery"]
    assert isinstance(recognised, dict)
    assert int(str(recognised["errors"])) > 0.9 * VICTIMS
    for row in rows_of(oracle, bed_of()).values():
        assert row.unjudged == "no attacker has an oracle"
        curve = row.details["curve"]
        assert isinstance(curve, list)
        distances = [point["distance_to_truth_mean"] for point in curve]  # type: ignore[call-overload, index]
        assert distances == sorted(distances, reverse=True)


def test_more_templates_lead_nearer_to_the_person_and_few_people_are_not_judged() -> None:
    bed = bed_of()
    rng = np.random.default_rng(6)
    centres = unit(rng.normal(size=(80, 1, bed.source.n)))
    photos = unit(centres + 0.4 * unit(rng.normal(size=(80, 6, bed.source.n))))
    albums = tuple(photos.astype(np.float32))
    rows = {row.variant: row for row in run_attack(nearest_to_all, replace(bed, albums=albums))}
    two, five, overlap = (
        rows[name]
        for name in (
            "different photos, 2 templates",
            "different photos, 5 templates",
            "two of three photos the same, 2 templates",
        )
    )

    def nearness(row: AttackOutcome) -> float:
        return float(str(row.details["cosine_to_truth_mean"]))

    assert nearness(two) < nearness(five)
    assert nearness(two) < nearness(overlap)
    assert five.measured.value > 0.5
    assert (five.judged, five.knowledge) == (True, KnowledgeLevel.TEMPLATES)
    kept = rows["different photos, 5 templates, holder's key kept"]
    assert (kept.judged, counts(kept)[0] <= 2) == (True, True)
    assert rows[SAME].unjudged == "fewer than 75 people have the photos"


def test_a_stolen_template_is_a_credential_with_its_key_only() -> None:
    rows = rows_of(stolen_template, bed_of())
    for what in ("a point of it", "a part of it as a lifted probe"):
        assert counts(rows[f"{what}, with the key"]) == (VICTIMS, VICTIMS)
        assert rows[f"{what}, with the key"].details["refused_by_the_input_checks"] == 0
        assert counts(rows[f"{what}, without the key"])[0] <= 1
        assert rows[f"{what}, without the key"].judged


def test_of_templates_that_hide_nothing_the_old_one_opens_the_new_with_its_key_only() -> None:
    rows = rows_of(renewed_template, weak_bed())
    for what in ("its foot point", "a point of it", "a part of it as a lifted probe"):
        assert rows[f"{what}, with the key"].measured.value > 0.9
        assert counts(rows[f"{what}, without the key"])[0] <= 1
    assert rows_of(renewed_template, bed_of())["a point of it, with the key"].measured.value < 0.5


def test_wolves_open_few() -> None:
    wolves = rows_of(wolf_embedding, bed_of()) | rows_of(lifted_wolf, bed_of())
    assert all(row.measured.value < 0.1 for row in wolves.values())
    assert all(row.leaked is Leaked.DATABASE for row in wolves.values())
    assert len(wolves) == 2


def test_templates_do_not_link_in_secret_rotations() -> None:
    rows = rows_of(foot_lengths, bed_of())
    for setting in ("secret rotations", "one tenant", "holder's key kept"):
        assert rows[setting].judged
        assert is_within_null(rows[setting]), setting
    # Lengths tell one set in two rotations.
    assert float(str(rows["one set for both"].details["identified_at_rank_1"])) > 0.9
