import dataclasses
from typing import Any

import numpy as np
import pytest

from templates.decoys import Attributes, DecoyGenerator, DecoyPool
from templates.distances import Metric, similarity
from templates.errors import TemplateError
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift
from tests.verify.evaluation.materials import N, material, pool
from verify.evaluation.material import Material
from verify.evaluation.scoring import score_unit, split_pool, unit_layout
from verify.evaluation.units import LiftUnit, Mode, RawUnit

BOTH = (Mode.POINT, Mode.SUBSPACE)


def unit(strategy: Strategy = Strategy.ADVERSARIAL, **changes: object) -> LiftUnit:
    given = {
        "strategy": strategy,
        "m": 4,
        "source": None if strategy is Strategy.RANDOM else 0,
        "shared": True,
        "modes": BOTH,
        "metrics": tuple(Metric),
        "steps": 50,
        "seed": 3,
    }
    return LiftUnit(**{**given, **changes})  # type: ignore[arg-type]


def residual(point: np.ndarray, foot: np.ndarray, rows: np.ndarray) -> float:
    """Distance of a point to foot + span(rows), by least squares."""
    found, *_ = np.linalg.lstsq(rows.T, point - foot, rcond=None)
    return float(np.linalg.norm(point - foot - rows.T @ found))


def test_raw_similarities_are_cosines() -> None:
    known = material()
    (found,) = score_unit(known, RawUnit(flip=False))
    one = known.descriptors[known.first].astype(float)
    two = known.descriptors[known.second].astype(float)
    cosines = (one * two).sum(axis=1)
    cosines /= np.linalg.norm(one, axis=1) * np.linalg.norm(two, axis=1)
    np.testing.assert_allclose(found.similarities, cosines, atol=1e-12)
    assert (found.cell.dim, found.cell.mode, found.lifted) == (0, Mode.RAW, None)


def test_each_side_is_lifted_and_the_other_compared_with_it() -> None:
    known = material(pairs=40)
    found = {
        (s.cell.mode, s.cell.metric, s.lifted): s.similarities for s in score_unit(known, unit())
    }
    assert set(found) == {
        (Mode.POINT, metric, side) for metric in Metric for side in ("first", "second")
    } | {(Mode.SUBSPACE, metric, "both") for metric in Metric}
    # Lift the sides again, from the streams of the unit, and measure by least squares.
    sides = []
    for name, photos in (("first", known.first), ("second", known.second)):
        with Keystream.seeded("evaluation", name, Strategy.ADVERSARIAL, 4, 3) as stream:
            sides.append(
                lift(
                    known.descriptors[photos],
                    strategy="adversarial",
                    m=4,
                    source=known.sources[0],
                    stream=stream,
                )
            )
    for row in range(40):
        a, b = known.descriptors[known.first[row]], known.descriptors[known.second[row]]
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
    known = material(people=60, pairs=30)
    source = DecoyGenerator.fit(known.descriptors).reduced(N - 6)
    known = dataclasses.replace(known, sources=(source,))
    (found,) = score_unit(known, unit(modes=(Mode.POINT,), metrics=(Metric.EUCLIDEAN,)))[:1]
    probes, enrolled = (
        source.project(known.descriptors[photos]) for photos in (known.second, known.first)
    )
    with Keystream.seeded("evaluation", "first", Strategy.ADVERSARIAL, 4, 3) as stream:
        lifted = lift(enrolled, strategy="adversarial", m=4, source=source, stream=stream)
    for row in range(30):
        distance = residual(probes[row], lifted[row].foot, lifted[row].basis)
        assert found.similarities[row] == pytest.approx(similarity(distance), abs=1e-5)


def test_a_device_gives_the_similarities_of_the_processor() -> None:
    pytest.importorskip("torch", reason="torch is an optional extra")
    known = material(pairs=30)
    here, there = (score_unit(known, unit(device=device)) for device in (None, "cpu"))
    assert [scores.cell for scores in here] == [scores.cell for scores in there]
    for one, other in zip(here, there, strict=True):
        np.testing.assert_allclose(one.similarities, other.similarities, atol=5e-6)
    with pytest.raises(TemplateError, match="torch cannot use the device nowhere"):
        score_unit(known, unit(device="nowhere"))


def test_seeds_change_lifts_and_one_seed_repeats_them() -> None:
    known = material(pairs=20)
    one, again, other = (score_unit(known, unit(seed=seed)) for seed in (1, 1, 2))
    for left, right, different in zip(one, again, other, strict=True):
        np.testing.assert_array_equal(left.similarities, right.similarities)
        assert (left.similarities != different.similarities).any()


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
    few = Material(**{**vars(material(pairs=60)), "sources": (pool(12),)})
    shared = score_unit(few, unit(modes=(Mode.SUBSPACE,), metrics=(Metric.EUCLIDEAN,)))[0]
    apart = score_unit(
        few, unit(modes=(Mode.SUBSPACE,), metrics=(Metric.EUCLIDEAN,), shared=False)
    )[0]
    assert shared.cell.shared_decoys is True
    assert apart.cell.shared_decoys is False
    strangers = ~few.same
    met = similarity(1e-3)
    assert np.mean(shared.similarities[strangers] > met) > 0.7
    assert not (apart.similarities[strangers] > met).any()


def test_random_lifting_needs_no_decoys_and_generated_ones_are_not_halved() -> None:
    generator = np.random.default_rng(0)
    rows = generator.normal(size=(400, N))
    made = DecoyGenerator.fit((rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype("f4"))
    known = Material(**{**vars(material(pairs=20)), "sources": (made,)})
    for cell, _ in unit_layout(unit(), known.sources):
        assert (cell.decoys, cell.shared_decoys) == ("generator", None)
    for cell, _ in unit_layout(unit(Strategy.RANDOM), known.sources):
        assert (cell.decoys, cell.shared_decoys) == (None, None)
    assert len(score_unit(known, unit(Strategy.RANDOM))) == 6


def test_hybrid_plus_takes_the_attributes_of_each_photo(monkeypatch: pytest.MonkeyPatch) -> None:
    known = material(pairs=30)
    asked: list[list[Attributes]] = []
    plain = DecoyPool.draw

    def watched(self: DecoyPool, rows: int, k: int, **given: Any) -> Any:
        asked.append(list(given["unlike"]))
        return plain(self, rows, k, **given)

    monkeypatch.setattr(DecoyPool, "draw", watched)
    score_unit(
        known, unit(Strategy.HYBRID_PLUS, modes=(Mode.SUBSPACE,), metrics=(Metric.SPHERICAL,))
    )
    assert known.attributes is not None
    # The decoys of each photo are unlike its own attributes, those of the first side first.
    assert asked == [
        [known.attributes[photo] for photo in side] for side in (known.first, known.second)
    ]
    without = Material(**{**vars(known), "attributes": None})
    with pytest.raises(ValueError, match="attributes"):
        score_unit(without, unit(Strategy.HYBRID_PLUS))
