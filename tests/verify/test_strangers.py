"""Templates of clients are held against strangers; stand-ins are spread as templates of people."""

import hashlib

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import norm, t

from attacks.stored.wolves import canonical
from templates.decoys import DecoyGenerator
from templates.space.subspace import AffineSubspace, SubspaceBatch
from tests.verify.population import M, N, contract, decoys, enrolled, photos_of, templates_of, unit
from verify.stand_ins import lift_stand_in
from verify.strangers import honest_score, strangers_like

PEOPLE = 600


def score(template: AffineSubspace) -> float:
    return contract().nobody.score(template, contract().expectation)


def wolf() -> AffineSubspace:
    """The leading axes of faces, with a foot point along their mean, as honest templates have."""
    faces = photos_of(1500, 1, seed=7)[:, 0]
    axes = np.linalg.svd(faces - faces.mean(axis=0), full_matrices=False)[2][:M]
    through = canonical(faces.mean(axis=0).astype(np.float64), axes.astype(np.float64))
    low, high = contract().template_foot_point_norm
    foot = through.foot * ((low + high) / 2 / through.foot_norm)
    return AffineSubspace(foot.astype(np.float32), through.basis)


def accepted_share(template: AffineSubspace) -> float:
    """Share of strangers whom the service would accept as the template's owner."""
    strangers = photos_of(1500, 1, seed=8)[:, 0]
    level = contract().calibration("p2s").level("fmr-1e-3")
    near = similarities(strangers, SubspaceBatch.of([template]))[:, 0]
    means, spreads = contract().expectation.statistics(strangers)
    return float(np.mean((near - means) / spreads >= level.threshold))


def similarities(points: NDArray[np.float32], batch: SubspaceBatch) -> NDArray[np.float64]:
    inside = (points @ batch.bases.reshape(-1, batch.n).T).reshape(len(points), len(batch), -1)
    return points @ batch.feet.T + batch.radii * np.linalg.norm(inside, axis=2)


def test_honest_templates_pass_and_a_wolf_does_not() -> None:
    limit = contract().template_stranger_score
    honest = templates_of(enrolled(PEOPLE, seed=5), seed=5)
    scores = np.array([score(template) for template in honest])
    assert (scores <= limit).all()
    assert accepted_share(wolf()) > 0.02
    assert score(wolf()) > limit


def test_few_people_set_a_wider_limit() -> None:
    nobody = contract().nobody
    templates = templates_of(enrolled(100, seed=6), seed=6)
    wide, narrow = (
        honest_score(nobody, contract().expectation, templates[:count]) for count in (4, 100)
    )
    spread = np.std([score(each) for each in templates], ddof=1)
    assert wide > narrow + 3 * spread


def test_strangers_lie_where_the_people_do() -> None:
    people = enrolled(2 * PEOPLE, seed=9).mean(axis=0)
    strangers = contract().nobody.people.mean(axis=0)
    assert np.linalg.norm(strangers - people) < 0.25 * np.linalg.norm(people)


def test_several_distances_do_not_tell_unknown_subjects() -> None:
    """Mirrored members of the cohort, as stand-ins once were, differ by up to 14 deviations."""
    faces = photos_of(1500, 1, seed=7)[:, 0]
    axes = np.linalg.svd(faces - faces.mean(axis=0), full_matrices=False)[2][:6]
    probes = unit(np.concatenate([faces.mean(axis=0)[None], axes]))
    digests = (hashlib.sha256(f"unknown {i}".encode()).digest() for i in range(PEOPLE))
    unknown = SubspaceBatch.of([lift_stand_in(contract(), digest) for digest in digests])
    real = templates_of(enrolled(PEOPLE, seed=21), seed=21)

    def features(batch: SubspaceBatch) -> NDArray[np.float64]:
        """What a point and its opposite tell: the foot point, and the part of the point inside."""
        ahead, behind = similarities(probes, batch), similarities(-probes, batch)
        return np.concatenate([ahead + behind, ahead - behind, batch.foot_norms[None]])

    a, b = features(real), features(unknown)
    deviation = np.sqrt(a.var(axis=1) / PEOPLE + b.var(axis=1) / PEOPLE)
    assert np.abs((a.mean(axis=1) - b.mean(axis=1)) / deviation).max() < 5
    assert np.abs(np.log(a.var(axis=1) / b.var(axis=1))).max() < 0.6


def test_strangers_are_fitted_to_photos_where_people_are_few() -> None:
    photos = photos_of(60, 4, seed=3).reshape(-1, N)
    owners = np.repeat(np.arange(60), 4)
    even, odd = strangers_like(decoys(), decoys(), photos, owners)
    assert isinstance(even, DecoyGenerator)
    assert even.source_id == DecoyGenerator.fit(photos[owners % 2 == 0]).source_id
    assert odd.source_id == DecoyGenerator.fit(photos[owners % 2 == 1]).source_id
    assert strangers_like(decoys(), even, photos, owners) == (even,)
    assert strangers_like(decoys(), decoys(), photos[:190], owners[:190]) == (decoys(),)
    flat = np.repeat(photos[:1], 240, axis=0)
    assert strangers_like(decoys(), decoys(), flat, owners) == (decoys(),)


def test_a_template_is_held_against_strangers_that_its_person_had_no_part_in() -> None:
    nobody, middle = contract().nobody, len(contract().nobody.people) // 2
    templates = templates_of(enrolled(40, seed=6), seed=6)
    scores = np.array(
        [
            nobody.scores(
                templates[number : number + 1],
                contract().expectation,
                rows=slice(middle, None) if number % 2 == 0 else slice(middle),
            )[0]
            for number in range(len(templates))
        ]
    )
    limit = honest_score(nobody, contract().expectation, templates, people=np.arange(40))
    reach = t.isf(norm.sf(6), 39) * np.sqrt(1 + 1 / 40)
    assert limit == pytest.approx(scores.mean() + reach * scores.std(ddof=1), rel=1e-6)
