"""What is expected of a point, in closed form, against templates that were not fitted."""

import tracemalloc
from collections.abc import Iterator

import numpy as np
import pytest

from templates.contract.expectation import PointExpectation
from templates.contract.levels import Level
from templates.decoys import DecoyGenerator
from templates.distances import Metric, pairwise_distances, similarity
from templates.errors import ContractError
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift
from tests.verify.population import M, N, decoys, enrolled, photos_of, templates_of, unit
from verify.cohort import people_like
from verify.expectation import Array64, ExpectationFit, _Fit, _kept, draw_wolves, fit_expectation
from verify.metrics import rate
from verify.point_ascent import ascend_points

TEMPLATES = 1500


def fit_of(strategy: Strategy, metric: Metric, m: int = M) -> ExpectationFit:
    source = decoys()
    with Keystream.seeded("fit") as stream:
        return fit_expectation(
            source,
            people_like(source, enrolled(400, seed=2)),
            strategy=strategy,
            m=m,
            metric=metric,
            stream=stream,
        )


def fitted(strategy: Strategy, metric: Metric, m: int = M) -> PointExpectation:
    return fit_of(strategy, metric, m).expectation


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


def test_the_fit_tells_how_far_others_climb(monkeypatch: pytest.MonkeyPatch) -> None:
    """Probes that are in no fit gain less by an ascent where others of the same kind are fitted."""
    level = Level("fmr-1e-2", 1e-2, 2.3, rate(1, 100), rate(1, 100))
    accepted = []
    for climbs in (0, 2):
        with monkeypatch.context() as patch:
            patch.setattr("verify.expectation.CLIMBS", climbs)
            fit = fit_of(Strategy.ADVERSARIAL, Metric.SPHERICAL)
        assert fit.climbs == climbs
        found = fit.climbers_at(level)
        assert found is not None
        assert (found.probes, found.templates) == (24, 1_000)
        assert found.fitted == (climbs == 2)
        assert found.accepted <= found.most
        accepted.append(found.accepted)
    assert accepted[1] < accepted[0]
    assert fit_of(Strategy.ADVERSARIAL, Metric.EUCLIDEAN).climbers_at(level) is None


def test_a_fit_that_cannot_follow_climbers_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("verify.expectation.CLIMB_WEIGHT", 1e9)
    fit = fit_of(Strategy.ADVERSARIAL, Metric.SPHERICAL)
    found = fit.climbers_at(Level("fmr-1e-2", 1e-2, 2.3, rate(1, 100), rate(1, 100)))
    assert found is not None
    assert not found.fitted


def test_a_weight_counts_as_so_many_probes() -> None:
    templates = templates_of(enrolled(80, seed=5), seed=5)
    projector = np.einsum("tmi,tmj->ij", templates.bases, templates.bases) / len(templates)
    foot = templates.feet.mean(axis=0)
    drawn, climbed = photos_of(40, 1, seed=6)[:, 0], photos_of(6, 1, seed=7)[:, 0]
    weighted, repeated = (
        _Fit(Metric.SPHERICAL, (projector + projector.T) / 2, foot, templates) for _ in range(2)
    )
    weighted.add(drawn, np.ones(40))
    weighted.add(climbed, np.full(6, 3.0))
    repeated.add(np.concatenate([drawn, *[climbed] * 3]), np.ones(58))
    first, second = weighted.expectation(), repeated.expectation()
    np.testing.assert_allclose(
        np.stack(first.statistics(drawn)), np.stack(second.statistics(drawn)), rtol=1e-6
    )


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


def test_templates_that_are_kept_are_held_once() -> None:
    tile, count, m, n = 10, 200, 8, 256
    drawn = np.random.default_rng(0).standard_normal((count + 20, m + 1, n))

    def tiles() -> Iterator[tuple[Array64, Array64]]:
        for first in range(0, len(drawn), tile):
            yield drawn[first : first + tile, 0], drawn[first : first + tile, 1:]

    tracemalloc.start()
    kept = _kept(tiles(), count, m=m, n=n)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_array_equal(kept.feet, drawn[:count, 0].astype(np.float32))
    np.testing.assert_array_equal(kept.bases, drawn[:count, 1:].astype(np.float32))
    assert peak < 1.6 * (kept.feet.nbytes + kept.bases.nbytes)
