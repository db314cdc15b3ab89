"""A template that needs its holder's key: what it accepts, and that the work is always the same."""

import dataclasses
import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

import verify.verifier
from enroll import Enroller, Enrollment, Holder
from templates.contract import wire
from templates.contract.document import Contract
from templates.distances import Metric
from templates.keys.rotation import Rotation, holder_rotation
from templates.space.lifting import lift
from templates.space.subspace import SubspaceBatch
from tests.verify.synthetic import (
    K,
    draw_people,
    embeddings_of,
    make_generator,
    projected,
    spherical,
    tenant_rotation,
    unit,
)
from verify import Calibrated, Decision, StandIn, Verifier

KEY, OTHER = bytes(range(32)), bytes(range(1, 33))
HOLDER = Holder(KEY, "default", "ada")
PEOPLE = draw_people(2, photos=(3,), seed=56).descriptors
ROTATION = tenant_rotation()


@pytest.fixture(scope="module")
def contract(calibrated: Calibrated) -> Contract:
    """One that a random direction passes with a probability below 1e-9, and the enrolled not."""
    made = calibrated.contract
    strict = tuple(
        dataclasses.replace(
            entry,
            levels=tuple(dataclasses.replace(level, threshold=6.5) for level in entry.levels),
            calibration_id="",
        )
        for entry in made.calibrations
    )
    return dataclasses.replace(
        made, calibrations=strict, photo_consistency=-1.0, template_stranger_similarity=99.0
    )


@pytest.fixture(scope="module")
def enroller(contract: Contract) -> Enroller:
    return Enroller(contract, make_generator(), rotation=ROTATION, lift_secret=bytes(32))


@pytest.fixture(scope="module")
def verifier(contract: Contract) -> Verifier:
    return Verifier(contract, make_generator(), rotation=ROTATION)


@pytest.fixture(scope="module")
def keyed(enroller: Enroller) -> Enrollment:
    return enroller.from_embeddings(PEOPLE[:1], holder=HOLDER)


def lifted_by_a_client(contract: Contract, descriptor: NDArray[np.float32], m: int) -> bytes:
    source = make_generator()
    points = source.project(descriptor[None])
    template = lift(points, strategy=contract.binding.strategy, m=m, source=source)
    return wire.encode(template[0], contract_id=contract.contract_id)


def without_tenant(enrollment: Enrollment) -> SubspaceBatch:
    rotation = ROTATION.of(enrollment.template_id)
    return wire.decode(enrollment.wire).subspace.turned_by(rotation.turned_back)


def without_both(enrollment: Enrollment, key: bytes) -> SubspaceBatch:
    assert enrollment.holder_salt is not None
    rotation = holder_rotation(key, enrollment.holder_salt, K)
    return without_tenant(enrollment).turned_by(rotation.turned_back)


def test_the_tenants_key_alone_does_not_turn_a_template_back(keyed: Enrollment) -> None:
    face = projected(PEOPLE[0])[None].astype(np.float64)
    assert not without_tenant(keyed).contains(face, tol=0.3).any()
    assert not without_both(keyed, OTHER).contains(face, tol=0.3).any()
    assert without_both(keyed, KEY).contains(face, tol=3e-3).all()


def test_the_key_accepts_and_another_or_none_does_not(
    contract: Contract, verifier: Verifier, keyed: Enrollment
) -> None:
    probe = PEOPLE[0]
    right = verifier.decide_embedding(probe, keyed, holder_key=bytearray(KEY))
    assert (right.accepted, right.reason) == (True, "match")
    # Against the definition: the template turned back, and what is expected of the probe as it is.
    similarity = spherical(projected(probe), without_both(keyed, KEY))
    nobody = contract.nobody(make_generator())
    means, spreads = nobody.statistics(projected(probe)[None], Metric.SPHERICAL)
    assert right.similarity == pytest.approx(similarity, abs=1e-4)
    assert right.score == pytest.approx((similarity - means[0]) / spreads[0], abs=1e-2)
    for key in (OTHER, None):
        wrong = verifier.decide_embedding(probe, keyed, holder_key=key)
        assert (wrong.accepted, wrong.reason) == (False, "no_match")
    impostor = verifier.decide_embedding(PEOPLE[3], keyed, holder_key=KEY)
    assert not impostor.accepted


def test_without_the_key_no_score_is_enough(verifier: Verifier, keyed: Enrollment) -> None:
    """Not even that of a probe made to lie in the template as it is turned without a key."""
    template = without_tenant(keyed)
    inside = unit((template.foot + template.radii[0] * template.basis[0])[None])[0]
    unturned = verify.verifier.holder_rotation(verifier._nobodys_key, str(keyed.holder_salt), K)
    probe = embeddings_of(unit(unturned.turned_back(inside[None].astype(np.float64))))[0]
    decision = verifier.decide_embedding(probe, keyed)
    assert decision.similarity > 0.99
    assert (decision.accepted, decision.reason) == (False, "no_match")


def test_a_thief_who_may_send_embeddings_chooses_a_key(
    verifier: Verifier, keyed: Enrollment
) -> None:
    """What the key does not protect from: template and rotation key were stolen."""
    template, salt = without_tenant(keyed), str(keyed.holder_salt)
    inside = unit((template.foot + template.radii[0] * template.basis[0])[None])
    probe = embeddings_of(holder_rotation(OTHER, salt, K).turned_back(inside.astype(np.float64)))[0]
    assert verifier.decide_embedding(probe, keyed, holder_key=OTHER).accepted


def test_a_template_that_needs_no_key_ignores_one(verifier: Verifier, enroller: Enroller) -> None:
    plain = enroller.from_embeddings(PEOPLE[:1])
    assert plain.holder_salt is None
    decisions = [
        verifier.decide_embedding(PEOPLE[0], plain, holder_key=key) for key in (None, KEY, OTHER)
    ]
    assert decisions[0].accepted
    assert decisions[1:] == decisions[:1] * 2


class CountedRotation:
    """The holder's rotation, and how many points it turned."""

    def __init__(self, made: Rotation, counts: list[int]) -> None:
        self._made, self._counts = made, counts

    def turned(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        self._counts.append(len(points))
        return self._made.turned(points)


def test_the_holders_rotation_is_derived_and_applied_always(
    contract: Contract,
    verifier: Verifier,
    enroller: Enroller,
    keyed: Enrollment,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    counts: list[int] = []

    def counted(key: bytes, salt: str, n: int) -> CountedRotation:
        assert (len(key), len(salt)) == (32, 32)
        return CountedRotation(holder_rotation(key, salt, n), counts)

    monkeypatch.setattr(verify.verifier, "holder_rotation", counted)
    probe = lifted_by_a_client(contract, PEOPLE[0], 2)
    nobody = StandIn(keyed.wire)
    answers: set[tuple[bool, str]] = set()

    def note(decision: Decision) -> None:
        answers.add((decision.accepted, decision.reason))

    cases = list(
        itertools.product((keyed, enroller.from_embeddings(PEOPLE[:1]), nobody), (KEY, OTHER, None))
    )
    for stored, key in cases:
        note(verifier.decide_embedding(PEOPLE[0], stored, holder_key=key))
    assert counts == [1] * len(cases)
    counts.clear()
    for stored, key in cases:
        note(verifier.decide_template(probe, stored, holder_key=key))
    assert counts == [2, 1] * len(cases)  # the basis, then the foot point
    assert answers == {(True, "match"), (False, "no_match")}
