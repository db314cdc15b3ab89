import dataclasses
from typing import Any

import numpy as np
import pytest

from templates.decoys import Attributes, DecoyGenerator, DecoyPool
from templates.distances import Metric, similarity
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift
from tests.verify.evaluation.made_trials import N, made_trials, pool
from verify.evaluation.comparison import Trials, compare, split_pool
from verify.evaluation.plan import EvaluationPlan, Mode, Unit

Found = dict[tuple[str, str, str | None], np.ndarray]


def compared(
    trials: Trials, strategy: Strategy = Strategy.ADVERSARIAL, *, seed: int = 3, **changes: Any
) -> Found:
    """Similarities by mode, metric and lifted side, of one unit of m = 4."""
    plan = EvaluationPlan((strategy,), **{"shared_decoys": True, **changes})
    source = None if strategy is Strategy.RANDOM else 0
    return {
        (names["mode"], names["metric"], names["lifted"]): similarities
        for names, similarities in compare(trials, Unit(strategy, 4, source, seed), plan)
    }


def residual(point: np.ndarray, foot: np.ndarray, rows: np.ndarray) -> float:
    """Distance of a point to foot + span(rows), by least squares."""
    found, *_ = np.linalg.lstsq(rows.T, point - foot, rcond=None)
    return float(np.linalg.norm(point - foot - rows.T @ found))


def test_raw_similarities_are_cosines() -> None:
    known = made_trials()
    ((names, found),) = compare(known, Unit("raw"), EvaluationPlan(("raw",)))
    one = known.embeddings[known.first].astype(float)
    two = known.embeddings[known.second].astype(float)
    cosines = (one * two).sum(axis=1)
    cosines /= np.linalg.norm(one, axis=1) * np.linalg.norm(two, axis=1)
    np.testing.assert_allclose(found, cosines, atol=1e-12)
    assert (names["dim"], names["mode"], names["lifted"]) == (0, Mode.RAW, None)


def test_each_side_is_lifted_and_the_other_compared_with_it() -> None:
    known = made_trials(pairs=40)
    found = compared(known)
    assert set(found) == {
        (Mode.POINT, metric, side) for metric in Metric for side in ("first", "second")
    } | {(Mode.SUBSPACE, metric, "both") for metric in Metric}
    # Lift the sides again, from the streams of the unit, and measure by least squares.
    sides = []
    for name, photos in (("first", known.first), ("second", known.second)):
        stream = Keystream.seeded("evaluation", name, Strategy.ADVERSARIAL, 4, 3)
        sides.append(
            lift(
                known.embeddings[photos],
                strategy="adversarial",
                m=4,
                source=known.sources[0],
                stream=stream,
            )
        )
    for row in range(40):
        a, b = known.embeddings[known.first[row]], known.embeddings[known.second[row]]
        first, second = sides[0][row], sides[1][row]
        for probe, template, side in ((b, first, "first"), (a, second, "second")):
            distance = residual(probe, template.foot, template.basis)
            assert found[Mode.POINT, "euclidean", side][row] == pytest.approx(
                similarity(distance), abs=1e-5
            )
        rows = np.concatenate([first.basis, second.basis])
        assert found[Mode.SUBSPACE, "euclidean", "both"][row] == pytest.approx(
            similarity(residual(second.foot, first.foot, rows)), abs=1e-4
        )


def test_both_photos_are_projected_on_the_axes_of_a_generator() -> None:
    known = made_trials(people=60, pairs=30)
    source = DecoyGenerator.fit(known.embeddings).reduced(N - 6)
    known = dataclasses.replace(known, sources=(source,))
    found = compared(known)[Mode.POINT, Metric.EUCLIDEAN, "first"]
    probes, enrolled = (
        source.project(known.embeddings[photos]) for photos in (known.second, known.first)
    )
    stream = Keystream.seeded("evaluation", "first", Strategy.ADVERSARIAL, 4, 3)
    lifted = lift(enrolled, strategy="adversarial", m=4, source=source, stream=stream)
    for row in range(30):
        distance = residual(probes[row], lifted[row].foot, lifted[row].basis)
        assert found[row] == pytest.approx(similarity(distance), abs=1e-5)


def test_halves_are_disjoint_and_cover_the_pool() -> None:
    whole = pool(121)
    one, two = split_pool(whole, seed=7)
    rows = {row.tobytes() for row in whole.entries[0]}
    mine, theirs = ({row.tobytes() for row in half.entries[0]} for half in (one, two))
    assert (len(mine), len(theirs)) == (60, 61)
    assert not mine & theirs
    assert mine | theirs == rows
    assert split_pool(whole, seed=8)[0].source_id != one.source_id


def test_shared_decoys_make_strangers_meet_and_halves_do_not() -> None:
    # 12 entries, 4 decoys on each side: nearly every pair shares one.
    few = dataclasses.replace(made_trials(pairs=60), sources=(pool(12),))
    shared, apart = (
        compared(few, shared_decoys=sharing)[Mode.SUBSPACE, Metric.EUCLIDEAN, "both"]
        for sharing in (True, False)
    )
    met = similarity(1e-3)
    assert np.mean(shared[~few.same] > met) > 0.7
    assert not (apart[~few.same] > met).any()


def test_hybrid_plus_takes_the_attributes_of_each_photo(monkeypatch: pytest.MonkeyPatch) -> None:
    known = made_trials(pairs=30)
    asked: list[list[Attributes]] = []
    plain = DecoyPool.draw

    def watched(self: DecoyPool, rows: int, k: int, **given: Any) -> Any:
        asked.append(list(given["unlike"]))
        return plain(self, rows, k, **given)

    monkeypatch.setattr(DecoyPool, "draw", watched)
    compared(known, Strategy.HYBRID_PLUS)
    assert known.attributes is not None
    # The decoys of each photo are unlike its own attributes, those of the first side first.
    assert asked == [
        [known.attributes[photo] for photo in side] for side in (known.first, known.second)
    ]
    with pytest.raises(ValueError, match="attributes"):
        compared(dataclasses.replace(known, attributes=None), Strategy.HYBRID_PLUS)
