"""Calibration against brute force, and against people that it has not seen."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from enroll import Enroller
from templates.contract.document import Contract
from templates.contract.nobody import Nobody
from templates.decoys import client_source
from templates.distances import DEFAULT_STEPS, Metric, paired_distances, similarity
from templates.errors import ContractError, InvalidEmbedding
from templates.keys.randomness import Keystream
from templates.space.lifting import lift
from templates.space.subspace import SubspaceBatch
from tests.verify.synthetic import (
    LIFT_SECRET,
    People,
    calibrate_people,
    draw_people,
    make_binding,
    make_generator,
    make_pool,
    spherical,
    tenant_rotation,
)
from verify import Calibrated, CalibrationOptions, Verifier, calibrate, calibration_mode
from verify.calibration_mode import ACCURACY_LEVEL
from verify.cohort import Probes
from verify.comparisons import Comparison, Lifter, honest_norms
from verify.tenfold import TenFold, ten_fold
from verify.trials import enrolled_means, plan_trials


@pytest.mark.parametrize(
    ("most_templates", "probe_m", "size"), [(None, 0, None), (9, 0, None), (9, 2, 10)]
)
def test_trials_agree_with_brute_force(
    most_templates: int | None, probe_m: int, size: int | None
) -> None:
    """Raw probes in one group; lifted ones in groups that meet others, and a last short group."""
    people = draw_people(12)
    source = make_generator()
    rng = np.random.default_rng(0)
    plan = plan_trials(
        people.names, photos_per_enrollment=3, rng=rng, most_templates=most_templates
    )
    compared = plan.compared.tolist()
    lifter = Lifter(make_binding(source.source_id).strategy, source, "0" * 64)
    stream = Keystream.seeded("test")
    means = enrolled_means(people.descriptors, plan)[compared]
    templates = lifter.lift(means, m=6, stream=stream)
    nobody = Nobody(source, lifter.strategy, 6, bytes(32))
    points = source.project(people.descriptors)
    probes: Probes = points
    if probe_m:
        probes = lifter.lift(people.descriptors, m=probe_m, stream=stream)
    met = plan.compared[None]
    if size is not None:
        groups = range(0, len(points), size)
        met = np.stack([np.sort(rng.choice(plan.compared, 5, replace=False)) for _ in groups])
        assert 0 < len(points) % size < size < len(points)
    comparison = Comparison(plan, templates, nobody, Metric.SPHERICAL, DEFAULT_STEPS)
    expected = means, spreads = comparison.expected(probes)
    impostors = comparison.impostors(
        probes, expected, plan.person_of, met, size=size or len(points),
        progress=lambda _share: None,
    )  # fmt: skip
    owners = plan.person_of[plan.genuine]
    genuine = comparison.genuine(
        probes[plan.genuine], (means[plan.genuine], spreads[plan.genuine]), owners,
        np.zeros(len(owners), dtype=bool),
    )  # fmt: skip

    def score(photo: int, person: int) -> float:
        template = templates[compared.index(person)]
        close = spherical(points[photo], template)
        if probe_m:
            pair = probes[photo : photo + 1], SubspaceBatch.of([template])
            (close,) = similarity(paired_distances(*pair, metric=Metric.SPHERICAL))
        return float((close - means[photo]) / spreads[photo])

    photos = range(len(people.names))
    trials = {
        (photo, person): score(photo, person)
        for photo in photos
        for person in met[photo // (size or len(points))].tolist()
        if person != plan.person_of[photo]
    }
    seen = [(plan.person_of[photo], person) for photo, person in trials]
    cells = np.flatnonzero(np.isfinite(impostors.scores))
    assert impostors.trials == len(cells) == len(trials)
    np.testing.assert_allclose(
        np.sort(impostors.scores[cells]), np.sort(list(trials.values())), atol=2e-4
    )
    assert sorted(map(tuple, impostors.people_of(cells))) == sorted(seen)
    for cell in cells[::7]:
        owner, person = impostors.people_of(cell[None])[0]
        own = [
            z for (i, other), z in trials.items() if (plan.person_of[i], other) == (owner, person)
        ]
        assert np.abs(np.array(own) - impostors.scores[cell]).min() < 2e-4
    assert impostors.person_pairs == len({frozenset(map(int, pair)) for pair in seen})
    weights = rng.integers(0, 4, 12).astype(float)
    total = sum(weights[a] * weights[b] for a, b in seen)
    assert impostors.weighted_trials(weights) == pytest.approx(total)
    order = np.argsort(genuine.people, kind="stable")
    np.testing.assert_array_equal(genuine.people[order], np.sort(owners))
    for person in np.unique(owners):
        own = [score(photo, person) for photo in plan.genuine[owners == person]]
        np.testing.assert_allclose(
            np.sort(genuine.scores[genuine.people == person]), np.sort(own), atol=2e-4
        )
    np.testing.assert_array_equal(
        genuine.enrolled_photos, [len(plan.enrolled[person]) for person in genuine.people]
    )


def test_probes_of_several_photos_are_calibrated_where_the_people_allow() -> None:
    people = draw_people(80, photos=(6, 3, 5))
    options = CalibrationOptions(targets=(1e-1, 1e-2), least_people=50)
    calibrations = calibrate_people(people, options=options).contract.calibrations
    # 54 people have two photos left over after the enrollment of three, 27 have three.
    assert [entry.probe_photos for entry in calibrations] == [1, 2]
    single, double = calibrations
    assert double.calibrated_on["genuine_trials"] == 27 * 3 + 26
    for entry in calibrations:
        level = entry.level("fmr-1e-2")
        trials = {k: rate.trials for k, rate in level.fnmr_by_photos.items()}
        assert sum(trials.values()) == level.fnmr.trials == entry.calibrated_on["genuine_trials"]
    assert set(single.level("fmr-1e-2").fnmr_by_photos) == {2, 3}
    assert set(double.level("fmr-1e-2").fnmr_by_photos) == {3}
    # Averaging takes off noise of the photos, and nothing else of impostors.
    assert double.level("fmr-1e-2").fnmr.value <= single.level("fmr-1e-2").fnmr.value
    assert double.level("fmr-1e-2").threshold == pytest.approx(
        single.level("fmr-1e-2").threshold, abs=0.3
    )
    none = calibrate_people(people, options=CalibrationOptions(targets=(1e-1,))).contract
    assert [entry.probe_photos for entry in none.calibrations] == [1, 2]


def test_levels_fall_to_the_smallest_that_the_data_resolve(calibrated: Calibrated) -> None:
    point, lifted = calibrated.contract.calibrations
    facts = point.calibrated_on
    # 150 people give 400 photos, and 400 x 149 impostor trials of 150 x 149 / 2 pairs.
    assert (facts["photos"], facts["impostor_trials"]) == (400, 400 * 149)
    assert facts["genuine_trials"] == 50 * (4 - 3) + 50 * (3 - 2)
    assert [level.name for level in point.levels] == ["fmr-1e-2", "fmr-1e-3"]
    assert (lifted.mode, lifted.probe_m) == ("s2s", 2)
    assert any(
        "raw probes of one photo: FMR 0.0001 is not resolved" in s
        for s in calibrated.report.unresolved
    )
    for calibration in (point, lifted):
        for level in calibration.levels:
            assert level.target_fmr is not None
            assert 0.9 * level.target_fmr <= level.fmr.value <= level.target_fmr
            assert level.fmr.ci_low < level.fmr.value < level.fmr.ci_high
        thresholds = [level.threshold for level in calibration.levels]
        assert thresholds == sorted(thresholds)
    assert calibrated.contract.default_level == "fmr-1e-3"


def service_outcomes(
    contract: Contract, people: People, *, level: str
) -> tuple[list[bool], list[bool]]:
    """Enroll and verify as the service does, with a rotation; accepted genuine and impostors."""
    rotation = tenant_rotation()
    enroller = Enroller(contract, make_generator(), rotation=rotation, lift_secret=LIFT_SECRET)
    verifier = Verifier(contract, make_generator(), rotation=rotation)
    names = sorted(set(people.names))
    photos = {n: [i for i, own in enumerate(people.names) if own == n] for n in names}
    stored = {n: enroller.from_embeddings(people.descriptors[photos[n][:3]]) for n in names}
    genuine, impostor = [], []
    for probe_name in names:
        probe = people.descriptors[photos[probe_name][3]]
        for name in names:
            accepted = verifier.decide_embedding(probe, stored[name], level=level).accepted
            (genuine if name == probe_name else impostor).append(accepted)
    return genuine, impostor


def test_thresholds_hold_for_people_that_calibration_has_not_seen(calibrated: Calibrated) -> None:
    relaxed = replace(calibrated.contract, photo_consistency=-1.0)
    genuine, impostor = service_outcomes(
        relaxed, draw_people(40, photos=(4,), seed=77), level="fmr-1e-2"
    )
    # 1,560 attempts at 1e-2: 15.6 expected; 40 is six standard deviations away.
    assert 0 < sum(impostor) <= 40
    assert sum(genuine) >= 38


def test_the_cohort_is_new_every_time_and_the_rest_follows_the_seed() -> None:
    people = draw_people(60)
    options = CalibrationOptions(targets=(1e-1, 1e-2))
    first, second = (calibrate_people(people, options=options).contract for _ in range(2))
    assert first.cohort_seed != second.cohort_seed
    thresholds = [entry.calibrations[0].levels[-1].threshold for entry in (first, second)]
    assert thresholds[0] == pytest.approx(thresholds[1], abs=1e-3)
    assert first.template_foot_point_norm == second.template_foot_point_norm
    assert first.photo_consistency == second.photo_consistency


def test_ten_fold_adds_the_accuracy_level(people: People, monkeypatch: pytest.MonkeyPatch) -> None:
    runs: list[TenFold] = []

    def noted(*pairs: Any) -> TenFold:
        runs.append(ten_fold(*pairs))
        return runs[-1]

    monkeypatch.setattr(calibration_mode, "ten_fold", noted)
    options = CalibrationOptions(protocol="ten-fold", probe_dims=(0,))
    result = calibrate_people(people, options=options)
    calibration = result.contract.calibrations[0]
    level = calibration.level(ACCURACY_LEVEL)
    assert level.target_fmr is None
    (folds,) = runs
    assert calibration.calibrated_on["pairs"] == "random"
    assert level.threshold == pytest.approx(np.mean(folds.thresholds))
    assert calibration.calibrated_on["ten_fold_accuracy"] == pytest.approx(folds.accuracy_mean)
    assert folds.accuracy_mean > 0.95
    other = calibration.level("fmr-1e-2")
    assert (level.fmr.value < other.fmr.value) == (level.threshold > other.threshold)


def test_a_pool_contract_calibrates_and_its_clients_get_a_generator() -> None:
    pool = make_pool()
    generator = client_source(pool)
    assert generator.source_id == client_source(pool).source_id
    assert generator.source_id != pool.source_id
    decoys = generator.draw(1, 50, stream=Keystream.seeded("x"))[0]
    entries = pool.draw(1, len(pool), stream=Keystream.seeded("y"))[0]
    assert (decoys @ entries.T).max() < 0.95  # none of the pool's people is among them
    people = draw_people(30)
    from templates.space.lifting import Strategy

    contract = calibrate(
        people.descriptors,
        people.names,
        binding=make_binding(pool.source_id, strategy=Strategy.SUB_HYBRID),
        source=pool,
        options=CalibrationOptions(
            targets=(1e-1,), probe_dims=(0, 2), lifted_probes=40, lifted_impostor_pairs=800, steps=5
        ),
    ).contract
    assert [entry.mode for entry in contract.calibrations] == ["p2s", "s2s"]


def test_honest_norms_widen_the_observed_range_and_stay_positive() -> None:
    low, high = honest_norms(np.array([0.3, 0.35, 0.4]))
    assert (low, high) == pytest.approx((0.25, 0.45))
    low, high = honest_norms(np.array([0.01, 0.99]))
    assert (low, high) == pytest.approx((0.005, 1.0))


def test_what_does_not_fit_is_refused(people: People) -> None:
    source = make_generator()
    binding = make_binding(source.source_id)
    with pytest.raises(ContractError, match="two people"):
        calibrate(people.descriptors, ["one"] * len(people.names), binding=binding, source=source)
    with pytest.raises(ContractError, match="resolve no level"):
        calibrate(people.descriptors[:8], people.names[:8], binding=binding, source=source)
    with pytest.raises(InvalidEmbedding):
        calibrate(2 * people.descriptors, people.names, binding=binding, source=source)


def test_lifted_probes_have_recorded_foot_point_norms(calibrated: Calibrated) -> None:
    _, lifted = calibrated.contract.calibrations
    assert lifted.foot_point_norm is not None
    low, high = lifted.foot_point_norm
    source = make_generator()
    probes: SubspaceBatch = lift(
        source.project(draw_people(200, photos=(1,), seed=31).descriptors),
        strategy=calibrated.contract.binding.strategy,
        m=2,
        source=source,
        stream=Keystream.seeded("norms"),
    )
    assert ((probes.foot_norms > low) & (probes.foot_norms < high)).all()
