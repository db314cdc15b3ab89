"""What is expected of a point, in closed form, against templates that were not fitted."""

import numpy as np
import pytest

from templates.contract.expectation import PointExpectation
from templates.decoys import DecoyGenerator
from templates.distances import Metric, pairwise_distances, similarity
from templates.errors import ContractError
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift
from tests.verify.population import M, N, decoys, enrolled, photos_of, templates_of, unit
from verify.cohort import people_like
from verify.expectation import draw_wolves, fit_expectation
from verify.point_ascent import ascend_points

TEMPLATES = 1500


def fitted(
    strategy: Strategy, metric: Metric, m: int = M, *, source: DecoyGenerator | None = None
) -> PointExpectation:
    source = source or decoys()
    with Keystream.seeded("fit") as stream:
        return fit_expectation(
            source,
            people_like(source, enrolled(400, seed=2)),
            strategy=strategy,
            m=m,
            metric=metric,
            stream=stream,
        ).expectation


@pytest.mark.parametrize("metric", Metric)
@pytest.mark.parametrize(
    ("strategy", "m"),
    [
        (Strategy.ADVERSARIAL, 4),
        (Strategy.ADVERSARIAL, 16),
        (Strategy.ADVERSARIAL, 40),
        (Strategy.HYBRID, M),
        (Strategy.RANDOM, M),
    ],
)
def test_it_holds_for_templates_and_probes_that_were_not_fitted(
    strategy: Strategy, m: int, metric: Metric
) -> None:
    expectation = fitted(strategy, metric, m)
    people = photos_of(300, 1, seed=8)[:, 0]
    faces = photos_of(1500, 1, seed=9)[:, 0].astype(np.float64)
    with Keystream.seeded("test") as stream:
        wolves = draw_wolves(faces, 200, stream=stream).astype(np.float32)
        templates = lift(
            enrolled(TEMPLATES, seed=10), strategy=strategy, m=m, source=decoys(), stream=stream
        )
    for probes, most_off, most_uneven in ((people, 0.15, 0.35), (wolves, 0.35, 0.6)):
        close = np.asarray(similarity(pairwise_distances(probes, templates, metric=metric)))
        means, spreads = expectation.statistics(probes)
        off = (means - close.mean(axis=1)) / close.std(axis=1)
        assert np.sqrt(np.mean(off**2)) < most_off
        assert np.sqrt(np.mean((spreads / close.std(axis=1) - 1) ** 2)) < most_uneven


def test_one_probe_is_expected_what_many_are() -> None:
    expectation = fitted(Strategy.ADVERSARIAL, Metric.SPHERICAL)
    probes = photos_of(50, 1, seed=8)[:, 0]
    together = np.stack(expectation.statistics(probes))
    alone = np.concatenate([np.stack(expectation.statistics(probe[None])) for probe in probes], 1)
    np.testing.assert_allclose(alone, together, rtol=1e-5)
    # The spherical metric sees directions only, and nothing is expected of none.
    np.testing.assert_allclose(np.stack(expectation.statistics(3 * probes)), together, rtol=1e-5)
    assert np.isfinite(expectation.statistics(np.zeros((1, N), dtype=np.float32))).all()


def test_the_euclidean_mean_is_exact_for_any_length() -> None:
    expectation = fitted(Strategy.ADVERSARIAL, Metric.EUCLIDEAN)
    probes = photos_of(50, 1, seed=8)[:, 0] * np.linspace(0, 2, 50, dtype=np.float32)[:, None]
    with Keystream.seeded("test") as stream:
        templates = lift(
            enrolled(TEMPLATES, seed=10),
            strategy=Strategy.ADVERSARIAL,
            m=M,
            source=decoys(),
            stream=stream,
        )
    distances = pairwise_distances(probes, templates, metric=Metric.EUCLIDEAN)
    close = np.asarray(similarity(distances), dtype=np.float64)
    means, _ = expectation.statistics(probes)
    error = close.std(axis=1) / np.sqrt(TEMPLATES) + 1e-3
    assert (np.abs(means - close.mean(axis=1)) < 6 * error).all()


def test_templates_that_follow_no_closed_form_are_refused() -> None:
    """Templates of two worlds: a probe of both is near to all, and H tells it from no other."""

    class TwoWorlds(DecoyGenerator):
        """All of one template's decoys are of one world, which is another in every template."""

        def draw(self, rows: int, k: int, *, stream: Keystream, **_: object) -> np.ndarray:
            drawn = super().draw(rows, k, stream=stream)
            world = stream.uniform((rows,)) < 0.5
            half = np.arange(self.n) < self.n // 2
            drawn[world] *= np.where(half, 1.0, 1e-3).astype(np.float32)
            drawn[~world] *= np.where(half, 1e-3, 1.0).astype(np.float32)
            return unit(drawn)

    worlds = TwoWorlds(decoys().statistics)
    with (
        pytest.raises(ContractError, match="does not follow its closed form"),
        Keystream.seeded("fit") as stream,
    ):
        fit_expectation(
            worlds,
            worlds,
            strategy=Strategy.ADVERSARIAL,
            m=24,
            metric=Metric.SPHERICAL,
            stream=stream,
        )


def test_people_are_drawn_as_they_are_spread() -> None:
    people = unit(photos_of(600, 1, seed=4)[:, 0] + np.eye(N, dtype=np.float32)[5])
    with Keystream.seeded("like") as stream:
        like = people_like(decoys(), people).draw(500, 1, stream=stream)[:, 0]
    assert np.linalg.norm(like.mean(axis=0) - people.mean(axis=0)) < 0.1
    # Too few to fit to: the decoys serve.
    same = decoys().source_id
    assert people_like(decoys(), people[: N - 1]).source_id == same
    assert people_like(decoys(), None).source_id == same


def test_probes_that_climb_are_fitted_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where ascents end, their scores vary as those of people do, and nearly with deviation 1."""
    climbed, others = (templates_of(enrolled(300, seed=seed), seed=seed) for seed in (21, 22))
    starts = photos_of(30, 1, seed=23)[:, 0]
    off = []
    for climbs in (0, 2):
        monkeypatch.setattr("verify.expectation.CLIMBS", climbs)
        expectation = fitted(Strategy.ADVERSARIAL, Metric.SPHERICAL)
        ends = ascend_points(starts, climbed, expectation, threshold=2.0)
        close = np.asarray(similarity(pairwise_distances(ends, others, metric=Metric.SPHERICAL)))
        spreads = expectation.statistics(ends)[1]
        off.append(float(np.mean(close.std(axis=1) / spreads)) - 1)
    assert abs(off[1]) < off[0] / 2
