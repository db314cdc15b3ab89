"""Decisions against brute force, hostile probes, and subjects that do not exist."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from enroll import Enroller, Enrollment
from templates.contract import wire
from templates.contract.document import Contract
from templates.decoys import DecoyGenerator
from templates.distances import Metric
from templates.errors import ContractMismatch, InvalidTemplate, Uncalibrated
from templates.keys.randomness import Keystream
from templates.keys.rotation import Rotation, TenantRotation
from templates.space.agreement import InconsistentImages
from templates.space.lifting import lift
from templates.space.subspace import SubspaceBatch
from tests.verify.synthetic import (
    LIFT_SECRET,
    K,
    M,
    N,
    draw_people,
    embeddings_of,
    make_binding,
    make_generator,
    projected,
    spherical,
    tenant_rotation,
    unit,
)
from verify import (
    Calibrated,
    CalibrationOptions,
    Decision,
    StandIn,
    Verifier,
    calibrate,
    probe_of_embeddings,
)

NEW = draw_people(12, photos=(4,), seed=55)
ROTATION = tenant_rotation()


def verifier_of(contract: Contract) -> Verifier:
    return Verifier(contract, make_generator(), rotation=ROTATION)


@pytest.fixture(scope="module")
def contract(calibrated: Calibrated) -> Contract:
    return dataclasses.replace(calibrated.contract, photo_consistency=-1.0)


@pytest.fixture(scope="module")
def verifier(contract: Contract) -> Verifier:
    return verifier_of(contract)


@pytest.fixture(scope="module")
def stored(contract: Contract) -> list[Enrollment]:
    enroller = Enroller(contract, make_generator(), rotation=ROTATION, lift_secret=LIFT_SECRET)
    return [
        enroller.from_embeddings(NEW.descriptors[4 * person : 4 * person + 3])
        for person in range(12)
    ]


def lifted(
    contract: Contract,
    descriptor: NDArray[np.float32],
    *,
    m: int = 2,
    contract_id: str = "",
    source: DecoyGenerator | None = None,
) -> bytes:
    source = source or make_generator()
    points = source.project(descriptor[None])
    template = lift(points, strategy=contract.binding.strategy, m=m, source=source)[0]
    return wire.encode(template, contract_id=contract_id or contract.contract_id)


def nobody(contract: Contract) -> StandIn:
    """What an unknown subject is decided against."""
    stream = Keystream.seeded("nobody")
    template = contract.nobody(make_generator()).lift(stream)
    return StandIn(wire.encode(template, contract_id=contract.contract_id, dtype="float16"))


@pytest.mark.parametrize("person", [0, 1])
@pytest.mark.parametrize("level", ["fmr-1e-2", "fmr-1e-3", None])
def test_decision_agrees_with_brute_force(
    contract: Contract, verifier: Verifier, stored: list[Enrollment], person: int, level: str | None
) -> None:
    probe = NEW.descriptors[3]
    decision = verifier.decide_embedding(probe, stored[person], level=level)
    rotation = ROTATION.of(stored[person].template_id)
    point = projected(probe)
    turned = unit(rotation.turned(point[None].astype(np.float64)))[0]
    similarity = spherical(turned, wire.decode(stored[person].wire).subspace)

    nobody = contract.nobody(make_generator())
    means, spreads = nobody.statistics(point[None], Metric.SPHERICAL)
    z = float((similarity - means[0]) / spreads[0])
    assert decision.similarity == pytest.approx(similarity, abs=5e-7)
    assert decision.distance == pytest.approx(np.sqrt(2 - 2 * similarity), abs=1e-4)
    assert decision.score == pytest.approx(z, abs=1e-3)
    # What is expected is what templates of nobody give, whoever drew them.
    crowd = [spherical(point, template) for template in nobody.cohort]
    error = 4 * np.std(crowd) / np.sqrt(len(crowd)) + 0.15 * np.std(crowd)
    assert means[0] == pytest.approx(np.mean(crowd), abs=error)
    assert spreads[0] == pytest.approx(np.std(crowd, ddof=1), rel=0.3)
    calibration = contract.calibration("p2s")
    rule = calibration.level(level or "fmr-1e-3")
    assert decision.accepted == (z >= rule.threshold)
    assert decision.reason == ("match" if decision.accepted else "no_match")
    assert (decision.level, decision.fmr) == (rule.name, rule.target_fmr)
    assert decision.contract_id == contract.contract_id
    assert decision.calibration_id == calibration.calibration_id


def test_a_score_below_the_threshold_rejects(contract: Contract, stored: list[Enrollment]) -> None:
    point = contract.calibration("p2s")
    probe = NEW.descriptors[3]
    score = verifier_of(contract).decide_embedding(probe, stored[0]).score
    for threshold, accepted in ((score, True), (np.nextafter(score, np.inf), False)):
        levels = tuple(
            dataclasses.replace(level, threshold=float(threshold)) for level in point.levels
        )
        changed = dataclasses.replace(
            contract,
            calibrations=(dataclasses.replace(point, levels=levels, calibration_id=""),),
        )
        decision = verifier_of(changed).decide_embedding(probe, stored[0])
        assert decision.accepted is accepted


def test_the_number_of_photos_picks_the_calibration(
    contract: Contract, stored: list[Enrollment]
) -> None:
    point = contract.calibration("p2s")
    lax = tuple(dataclasses.replace(level, threshold=-99.0) for level in point.levels[:1])
    of_three = dataclasses.replace(point, levels=lax, probe_photos=3, calibration_id="")
    several = dataclasses.replace(contract, calibrations=(*contract.calibrations, of_three))
    verifier = verifier_of(several)
    single, _, three = several.calibrations
    name = lax[0].name
    for photos, expected in ((1, single), (2, single), (3, three), (5, three)):
        decision = verifier.decide_embedding(
            NEW.descriptors[7], stored[0], level=name, photos=photos
        )
        assert decision.calibration_id == expected.calibration_id
        assert decision.accepted is (expected is three)
    # A level that three photos do not resolve is that of one.
    decision = verifier.decide_embedding(NEW.descriptors[7], stored[0], photos=3)
    assert (decision.level, decision.calibration_id) == ("fmr-1e-3", single.calibration_id)


def test_unknown_subject_is_rejected_by_the_same_work(
    contract: Contract, verifier: Verifier, stored: list[Enrollment]
) -> None:
    probe = NEW.descriptors[3]
    real = verifier.decide_embedding(probe, stored[0])
    stand_in = nobody(contract)
    unknown = verifier.decide_embedding(probe, stand_in)
    assert (unknown.accepted, unknown.reason) == (False, "no_match")
    assert len(stand_in.wire) == len(stored[0].wire)
    changed = {
        field.name
        for field in dataclasses.fields(Decision)
        if getattr(real, field.name) != getattr(unknown, field.name)
    }
    assert changed == {"accepted", "reason", "similarity", "distance", "score"}
    # Even a probe that lies in the stand-in is rejected.
    template = wire.decode(stand_in.wire).subspace
    inside = unit((template.foot + template.radii[0] * template.basis[0])[None])
    inside = unit(ROTATION.of(stand_in.template_id).turned_back(inside.astype(np.float64)))
    caught = verifier.decide_embedding(embeddings_of(inside)[0], stand_in)
    assert caught.similarity > 0.99
    assert not caught.accepted


def test_lifted_probes_are_decided(
    contract: Contract, verifier: Verifier, stored: list[Enrollment]
) -> None:
    # One probe may miss; most of twelve genuine ones must match, and few of the impostors.
    genuine = [
        verifier.decide_template(lifted(contract, NEW.descriptors[4 * i + 3]), stored[i])
        for i in range(12)
    ]
    impostor = [
        verifier.decide_template(lifted(contract, NEW.descriptors[4 * i + 3]), stored[i - 1])
        for i in range(12)
    ]
    assert sum(decision.accepted for decision in genuine) >= 6
    assert sum(decision.accepted for decision in impostor) <= 1
    expected = contract.calibration("s2s", None, 2).calibration_id
    assert {decision.calibration_id for decision in genuine} == {expected}
    unknown = verifier.decide_template(lifted(contract, NEW.descriptors[3]), nobody(contract))
    assert not unknown.accepted


def test_lifted_probes_that_are_not_honest_are_refused(
    contract: Contract, verifier: Verifier, stored: list[Enrollment]
) -> None:
    for norm in (0.999, 0.0):
        foot = norm * np.eye(K, dtype=np.float32)[2]
        unlikely = SubspaceBatch(foot, np.eye(K, dtype=np.float32)[:2])
        data = wire.encode(unlikely, contract_id=contract.contract_id)
        with pytest.raises(InvalidTemplate, match="foot point is outside the range"):
            verifier.decide_template(data, stored[0])
    with pytest.raises(Uncalibrated, match="probe m = 3; calibrated are"):
        verifier.decide_template(lifted(contract, NEW.descriptors[0], m=3), stored[0])
    with pytest.raises(ContractMismatch):
        verifier.decide_template(
            lifted(contract, NEW.descriptors[0], contract_id="f" * 64), stored[0]
        )
    small = DecoyGenerator.fit(draw_people(200, photos=(1,), n=32).descriptors)
    other = lift(np.eye(32)[:1], strategy="adversarial", m=2, source=small)[0]
    with pytest.raises(InvalidTemplate, match="60 numbers, not 32"):
        verifier.decide_template(wire.encode(other, contract_id=contract.contract_id), stored[0])
    for cut in (0, 1, 40, len(data) - 1):
        with pytest.raises(InvalidTemplate):
            verifier.decide_template(data[:cut], stored[0])


def test_stored_templates_of_another_contract_are_refused(
    contract: Contract, verifier: Verifier, stored: list[Enrollment]
) -> None:
    template = wire.decode(stored[0].wire).subspace
    foreign = wire.encode(template, contract_id="e" * 64)
    with pytest.raises(ContractMismatch, match="the stored template belongs to the contract eeee"):
        verifier.decide_embedding(NEW.descriptors[0], dataclasses.replace(stored[0], wire=foreign))
    thin = wire.encode(
        SubspaceBatch(template.foot, template.basis[: M - 1]), contract_id=contract.contract_id
    )
    with pytest.raises(InvalidTemplate, match="dimensions"):
        verifier.decide_embedding(NEW.descriptors[0], dataclasses.replace(stored[0], wire=thin))


def test_a_template_in_the_rotation_of_another_matches_nobody(
    contract: Contract, verifier: Verifier, stored: list[Enrollment]
) -> None:
    swapped = [
        dataclasses.replace(stored[i], template_id=stored[i - 1].template_id) for i in range(12)
    ]
    probes = [NEW.descriptors[4 * i + 3] for i in range(12)]
    lifts = [lifted(contract, probe) for probe in probes]

    def accepted(templates: list[Enrollment]) -> tuple[int, int]:
        of_points = map(verifier.decide_embedding, probes, templates)
        of_lifts = map(verifier.decide_template, lifts, templates)
        return sum(each.accepted for each in of_points), sum(each.accepted for each in of_lifts)

    assert accepted(stored)[0] == 12
    assert max(accepted(swapped)) <= 1


def test_a_rotation_is_derived_and_applied_for_nobody_too(
    contract: Contract,
    verifier: Verifier,
    stored: list[Enrollment],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    derive, ids, rows = TenantRotation.of, list[str](), list[tuple[int, ...]]()

    def derived(self: TenantRotation, template_id: str) -> Rotation:
        ids.append(template_id)
        rotation = derive(self, template_id)
        turn = type(rotation).turned

        def turned(points: NDArray[np.floating]) -> NDArray[np.float64]:
            rows.append(points.shape)
            return turn(rotation, points)

        object.__setattr__(rotation, "turned", turned)
        return rotation

    monkeypatch.setattr(TenantRotation, "of", derived)
    probe = NEW.descriptors[3]
    for unknown in (stored[0], nobody(contract)):
        rows.clear()
        verifier.decide_embedding(probe, unknown)
        assert rows == [(1, K)]
        rows.clear()
        verifier.decide_template(lifted(contract, probe), unknown)
        assert sorted(rows) == [(1, K), (2, K)]
    assert {len(each) for each in ids} == {32}  # as much to hash
    assert len(ids) == 4


def test_scores_stay_out_of_the_repr(verifier: Verifier, stored: list[Enrollment]) -> None:
    decision = verifier.decide_embedding(NEW.descriptors[3], stored[0])
    text = repr(decision)
    assert "similarity" not in text
    assert str(decision.distance) not in text


def test_wolves_are_stopped_by_what_is_expected_of_them() -> None:
    """A few axes carry most of the spread of faces: what lies along them is near everybody."""
    rng = np.random.default_rng(0)
    spread = np.concatenate([np.full(4, 3.0), np.ones(N - 4)])
    centres, faces, strangers = (
        unit(rng.normal(size=(count, N)) * spread) for count in (200, 500, 150)
    )
    photos = unit(np.repeat(centres, 3, axis=0) + 0.3 * unit(rng.normal(size=(600, N))))
    source = DecoyGenerator.fit(faces).reduced(K)
    contract = calibrate(
        photos,
        [f"p{i // 3}" for i in range(600)],
        binding=make_binding(source.source_id),
        source=source,
        options=CalibrationOptions(
            probe_dims=(0, 4), lifted_probes=200, lifted_impostor_pairs=20_000, steps=20
        ),
    ).contract
    enroller = Enroller(contract, source, rotation=ROTATION, lift_secret=LIFT_SECRET)
    verifier = Verifier(contract, source, rotation=ROTATION)
    foot = np.zeros(K, dtype=np.float32)
    foot[4] = np.mean(contract.calibration("s2s", None, 4).foot_point_norm or ())
    wolf = SubspaceBatch(foot, np.eye(K, dtype=np.float32)[:4])
    lifted_wolf = wire.encode(wolf, contract_id=contract.contract_id)
    raw_wolf = source.axes[:, 0]
    honest = lifted(contract, strangers[0], m=4, source=source)
    stored = [enroller.from_embeddings(row) for row in strangers[1:]]
    kinds: list[tuple[Any, Any, Any]] = [
        (verifier.decide_template, lifted_wolf, honest),
        (verifier.decide_embedding, raw_wolf, strangers[0]),
    ]
    for decide, wolf_probe, probe in kinds:
        decisions = [decide(wolf_probe, one, level="fmr-1e-2") for one in stored]
        usual = [decide(probe, one).similarity for one in stored]
        assert np.mean([d.similarity for d in decisions]) > np.quantile(usual, 0.7)
        assert np.mean([d.accepted for d in decisions]) < 0.05


def test_photos_of_a_probe_need_to_agree_less_than_those_of_an_enrollment(
    contract: Contract,
) -> None:
    strict = dataclasses.replace(contract, photo_consistency=0.9, probe_consistency=0.5)
    rows = np.zeros((2, N), dtype=np.float32)
    rows[:, 0], rows[0, 1], rows[1, 1] = 0.9, 0.19**0.5, -(0.19**0.5)  # cosine 0.62
    mean = probe_of_embeddings(strict, rows).embedding
    assert mean[0] == pytest.approx(1.0, abs=1e-6)
    enroller = Enroller(strict, make_generator(), rotation=ROTATION, lift_secret=LIFT_SECRET)
    with pytest.raises(InconsistentImages):
        enroller.from_embeddings(rows)
    apart = dataclasses.replace(strict, probe_consistency=0.63)
    with pytest.raises(InconsistentImages):
        probe_of_embeddings(apart, rows)
