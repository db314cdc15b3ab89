"""Decisions against brute force, hostile probes, and subjects that do not exist."""

import dataclasses
import hashlib
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numpy.typing import NDArray

from enroll import Enroller
from templates.contract import wire
from templates.contract.document import Contract
from templates.decoys import DecoyGenerator
from templates.errors import ContractMismatch, InvalidEmbedding, InvalidTemplate, Uncalibrated
from templates.space.lifting import lift
from templates.space.subspace import AffineSubspace
from tests.verify.synthetic import (
    M,
    N,
    draw_people,
    make_generator,
    random_rotation,
    rounded,
    unit,
)
from verify import Calibrated, Decision, StandIn, Verifier, lift_stand_in

NEW = draw_people(12, photos=(4,), seed=55)
ROTATION = random_rotation()


@pytest.fixture(scope="module")
def contract(calibrated: Calibrated) -> Contract:
    return dataclasses.replace(calibrated.contract, photo_consistency=-1.0)


@pytest.fixture(scope="module")
def verifier(contract: Contract) -> Verifier:
    return Verifier(contract, rotation=ROTATION)


@pytest.fixture(scope="module")
def stored(contract: Contract) -> list[bytes]:
    enroller = Enroller(contract, make_generator(), rotation=ROTATION)
    return [
        enroller.from_embeddings(NEW.descriptors[4 * person : 4 * person + 3]).wire
        for person in range(12)
    ]


def lifted(
    contract: Contract, descriptor: NDArray[np.float32], *, m: int = 2, contract_id: str = ""
) -> bytes:
    template = lift(
        descriptor[None], strategy=contract.binding.strategy, m=m, source=make_generator()
    )[0]
    return wire.encode(template, contract_id=contract_id or contract.contract_id)


def nobody(contract: Contract, number: int) -> StandIn:
    """The stand-in of one unknown subject."""
    digest = hashlib.sha256(f"unknown {number}".encode()).digest()
    plain = wire.encode(contract.cohort[0], contract_id=contract.contract_id, dtype="float16")
    return StandIn(plain, lift_stand_in(contract, digest))


def spherical(probe: NDArray[np.floating], template: AffineSubspace) -> float:
    foot, basis = template.foot.astype(np.float64), template.basis.astype(np.float64)
    e = probe.astype(np.float64)
    return float(e @ foot + np.sqrt(1 - foot @ foot) * np.linalg.norm(basis @ e))


@pytest.mark.parametrize("person", [0, 1])
@pytest.mark.parametrize("level", ["fmr-1e-2", "fmr-1e-3", None])
def test_decision_agrees_with_brute_force(
    contract: Contract, verifier: Verifier, stored: list[bytes], person: int, level: str | None
) -> None:
    probe = NEW.descriptors[3]
    decision = verifier.decide_embedding(probe, stored[person], level=level)
    turned = unit((ROTATION @ probe.astype(np.float64))[None])[0]
    similarity = spherical(turned, wire.decode(stored[person]).subspace)

    def score(cohort: Iterable[AffineSubspace]) -> float:
        crowd = [spherical(probe, template) for template in cohort]
        return float((similarity - np.mean(crowd)) / np.std(crowd, ddof=1))

    z = score(map(rounded, contract.cohort))
    assert decision.similarity == pytest.approx(similarity, abs=1e-5)
    assert decision.distance == pytest.approx(np.sqrt(2 - 2 * similarity), abs=1e-4)
    assert decision.cohort_score == pytest.approx(z, abs=1e-3)
    # A score counts standard deviations; a stranger's may be near 0, where a share is nothing.
    assert z == pytest.approx(score(contract.cohort), rel=3e-3, abs=3e-3)
    calibration = contract.calibration("p2s")
    rule = calibration.level(level or "fmr-1e-3")
    assert decision.accepted == (
        similarity >= rule.similarity_threshold and z >= rule.cohort_threshold
    )
    assert decision.reason == ("match" if decision.accepted else "no_match")
    assert (decision.level, decision.fmr) == (rule.name, rule.target_fmr)
    assert decision.contract_id == contract.contract_id
    assert decision.calibration_id == calibration.calibration_id


@pytest.mark.parametrize("failing", ["similarity_threshold", "cohort_threshold"])
def test_either_test_alone_rejects(contract: Contract, stored: list[bytes], failing: str) -> None:
    point = contract.calibration("p2s")
    levels = tuple(dataclasses.replace(level, **{failing: 1e6}) for level in point.levels)
    harder = dataclasses.replace(
        contract,
        calibrations=(dataclasses.replace(point, levels=levels, calibration_id=""),),
    )
    decision = Verifier(harder, rotation=ROTATION).decide_embedding(NEW.descriptors[3], stored[0])
    assert not decision.accepted


def test_unknown_subject_is_rejected_by_the_same_work(
    contract: Contract, verifier: Verifier, stored: list[bytes]
) -> None:
    probe = NEW.descriptors[3]
    real = verifier.decide_embedding(probe, stored[0])
    stand_in = nobody(contract, 0)
    unknown = verifier.decide_embedding(probe, stand_in)
    assert (unknown.accepted, unknown.reason) == (False, "no_match")
    assert len(stand_in.wire) == len(stored[0])
    changed = {
        field.name
        for field in dataclasses.fields(Decision)
        if getattr(real, field.name) != getattr(unknown, field.name)
    }
    assert changed == {"accepted", "reason", "similarity", "distance", "cohort_score"}
    # Even a probe that lies in the stand-in is rejected.
    template = stand_in.lifted
    assert template is not None
    template.validate(1e-3)
    inside = unit((template.foot + template.radius * template.basis[0])[None])[0]
    caught = verifier.decide_embedding(inside, stand_in)
    assert caught.similarity > 0.99
    assert not caught.accepted


def test_unknown_subjects_keep_their_distances_and_differ(
    contract: Contract, verifier: Verifier, stored: list[bytes]
) -> None:
    probe = NEW.descriptors[3]
    more = 400
    distances = [
        verifier.decide_embedding(probe, nobody(contract, i)).distance for i in range(more)
    ]
    again = [verifier.decide_embedding(probe, nobody(contract, i)).distance for i in range(5)]
    assert again == distances[:5]
    # Two of so many float32 numbers of one range may be equal by chance.
    assert len(set(distances)) >= more - 2
    digest = hashlib.sha256(b"unknown 7").digest()
    assert verifier.decide_embedding(probe, nobody(contract, 7)).similarity == pytest.approx(
        spherical(probe, lift_stand_in(contract, digest)), abs=1e-5
    )
    # Where no distance is told, the template that was opened does.
    unscored = verifier.decide_embedding(probe, StandIn(nobody(contract, 7).wire))
    assert unscored.similarity == pytest.approx(
        spherical(probe, wire.decode(nobody(contract, 7).wire).subspace), abs=1e-5
    )
    assert not unscored.accepted


def test_distances_to_unknown_subjects_are_those_of_impostors(
    contract: Contract, verifier: Verifier, stored: list[bytes]
) -> None:
    impostor, unknown = [], []
    for i in range(12):
        probe = NEW.descriptors[4 * i + 3]
        impostor += [
            verifier.decide_embedding(probe, stored[j]).distance for j in range(12) if j != i
        ]
        unknown += [
            verifier.decide_embedding(probe, nobody(contract, 100 * i + j)).distance
            for j in range(11)
        ]
    spread = np.std(impostor)
    assert abs(np.mean(unknown) - np.mean(impostor)) < 0.5 * spread
    assert 0.6 < np.std(unknown) / spread < 1.6


@pytest.mark.parametrize(
    ("name", "probe"),
    [
        ("zero", np.zeros(N)),
        ("long", np.full(N, 1.1 / np.sqrt(N))),
        ("nan", np.full(N, np.nan)),
        ("infinite", np.full(N, np.inf)),
        ("huge", np.full(N, 1e300)),
        ("short vector", np.ones(1)),
        ("long vector", unit(np.ones((1, N + 1)))[0]),
        ("matrix", np.eye(N)[:2]),
        ("text", np.array(["1.0"] * N)),
        ("complex", np.ones(N, dtype=complex) / np.sqrt(N)),
        ("cube", np.zeros((1, 1, N))),
        ("empty", np.empty(0)),
    ],
)
def test_malformed_embeddings_are_refused(
    verifier: Verifier, stored: list[bytes], name: str, probe: NDArray[np.generic]
) -> None:
    with pytest.raises(InvalidEmbedding):
        verifier.decide_embedding(probe, stored[0])


def test_a_norm_within_the_tolerance_is_taken_as_unit(
    verifier: Verifier, stored: list[bytes]
) -> None:
    probe = NEW.descriptors[3]
    plain = verifier.decide_embedding(probe, stored[0])
    longer = verifier.decide_embedding(probe * np.float32(1.0009), stored[0])
    assert longer.similarity == pytest.approx(plain.similarity, abs=1e-6)


def test_lifted_probes_are_decided(
    contract: Contract, verifier: Verifier, stored: list[bytes]
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
    unknown = verifier.decide_template(lifted(contract, NEW.descriptors[3]), nobody(contract, 1))
    assert not unknown.accepted


def test_lifted_probes_that_are_not_honest_are_refused(
    contract: Contract, verifier: Verifier, stored: list[bytes]
) -> None:
    central = AffineSubspace(np.zeros(N, dtype=np.float32), np.eye(N, dtype=np.float32)[:2])
    data = wire.encode(central, contract_id=contract.contract_id)
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
    with pytest.raises(InvalidTemplate, match="n = 64, not 32"):
        verifier.decide_template(wire.encode(other, contract_id=contract.contract_id), stored[0])
    for cut in (0, 1, 40, len(data) - 1):
        with pytest.raises(InvalidTemplate):
            verifier.decide_template(data[:cut], stored[0])


def test_stored_templates_of_another_contract_are_refused(
    contract: Contract, verifier: Verifier, stored: list[bytes]
) -> None:
    template = wire.decode(stored[0]).subspace
    foreign = wire.encode(template, contract_id="e" * 64)
    with pytest.raises(ContractMismatch, match="the stored template belongs to the contract eeee"):
        verifier.decide_embedding(NEW.descriptors[0], foreign)
    thin = wire.encode(
        AffineSubspace(template.foot, template.basis[: M - 1]), contract_id=contract.contract_id
    )
    with pytest.raises(InvalidTemplate, match="dimensions"):
        verifier.decide_embedding(NEW.descriptors[0], thin)


def test_unknown_levels_and_metrics_are_refused(verifier: Verifier, stored: list[bytes]) -> None:
    from templates.distances import Metric

    with pytest.raises(Uncalibrated, match="calibrated are: fmr-1e-2, fmr-1e-3"):
        verifier.decide_embedding(NEW.descriptors[0], stored[0], level="fmr-1e-9")
    with pytest.raises(Uncalibrated, match="no calibration for p2s euclidean"):
        verifier.decide_embedding(NEW.descriptors[0], stored[0], metric=Metric.EUCLIDEAN)


def test_a_rotation_of_another_dimension_is_refused(contract: Contract) -> None:
    with pytest.raises(ContractMismatch, match="turns 8"):
        Verifier(contract, rotation=np.eye(8))


def test_another_tenants_rotation_matches_nobody(contract: Contract, stored: list[bytes]) -> None:
    other = Verifier(contract, rotation=random_rotation(seed=6))
    accepted = [
        other.decide_embedding(NEW.descriptors[4 * i + 3], stored[i]).accepted for i in range(12)
    ]
    assert sum(accepted) <= 1


def test_threads_share_a_verifier(verifier: Verifier, stored: list[bytes]) -> None:
    def decide(i: int) -> Decision:
        return verifier.decide_embedding(NEW.descriptors[4 * (i % 12) + 3], stored[i % 12])

    alone = [decide(i) for i in range(12)]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(decide, range(120)))
    assert together == alone * 10


def test_scores_stay_out_of_the_repr(verifier: Verifier, stored: list[bytes]) -> None:
    decision = verifier.decide_embedding(NEW.descriptors[3], stored[0])
    text = repr(decision)
    assert "similarity" not in text
    assert str(decision.distance) not in text


def test_wolves_are_stopped_by_the_cohort(contract: Contract) -> None:
    """A common mean makes wolves (docs/method.md §4.7); the cohort test must stop them."""
    rng = np.random.default_rng(0)
    # Face descriptors are not centred: a few axes carry most of their spread.
    spread = np.concatenate([np.full(4, 3.0), np.ones(N - 4)])
    centres = unit(rng.normal(size=(200, N)) * spread)
    photos = unit(np.repeat(centres, 3, axis=0) + 0.3 * unit(rng.normal(size=(600, N))))
    names = [f"p{i // 3:03d}" for i in range(600)]
    source = DecoyGenerator.fit(unit(rng.normal(size=(500, N)) * spread))
    from tests.verify.synthetic import make_binding
    from verify import CalibrationOptions, calibrate

    wolves_contract = calibrate(
        photos,
        names,
        binding=make_binding(source.source_id),
        source=source,
        options=CalibrationOptions(
            probe_dims=(0, 4), lifted_probes=200, lifted_impostor_pairs=20_000, steps=20
        ),
    ).contract
    rotation = np.eye(N)
    enroller = Enroller(wolves_contract, source, rotation=rotation)
    verifier = Verifier(wolves_contract, rotation=rotation)
    calibration = wolves_contract.calibration("s2s", None, 4)
    assert calibration.foot_point_norm is not None
    # A wolf with a plausible foot point, spanned by the leading axes.
    foot = np.zeros(N, dtype=np.float32)
    foot[4] = np.mean(calibration.foot_point_norm)
    wolf = wire.encode(
        AffineSubspace(foot, np.eye(N, dtype=np.float32)[:4]),
        contract_id=wolves_contract.contract_id,
    )
    people = unit(rng.normal(size=(150, N)) * spread)
    decisions = [
        verifier.decide_template(wolf, enroller.from_embeddings(row).wire, level="fmr-1e-2")
        for row in people
    ]
    threshold = calibration.level("fmr-1e-2").similarity_threshold
    assert np.mean([d.similarity >= threshold for d in decisions]) > 0.3
    assert np.mean([d.accepted for d in decisions]) < 0.05
