"""Enrollment: what is stored, what is refused, and what never shows."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from enroll import Enroller, Enrollment, Holder
from models.errors import NoFace, PhotoRejected
from models.pack import ModelPack
from templates.contract import wire
from templates.contract.document import Contract
from templates.decoys import Attributes, DecoyGenerator, DecoyPool
from templates.errors import ContractMismatch, InvalidEmbedding, InvalidTemplate, VeilfaceError
from templates.keys.rotation import TenantRotation, holder_rotation
from templates.space.agreement import InconsistentImages
from templates.space.lifting import Strategy, lift
from templates.space.subspace import SubspaceBatch
from tests.verify.synthetic import (
    LIFT_SECRET,
    K,
    M,
    N,
    calibrate_people,
    draw_people,
    make_binding,
    make_generator,
    projected,
    tenant_rotation,
    unit,
)
from verify import CalibrationOptions, calibrate

ROTATION = tenant_rotation()
PHOTOS = draw_people(4, photos=(4,), noise=0.4, seed=55).descriptors
POINTS = make_generator().project(PHOTOS)


@pytest.fixture(scope="module")
def contract() -> Contract:
    options = CalibrationOptions(targets=(1e-1, 1e-2))
    return calibrate_people(draw_people(60), options=options).contract


@pytest.fixture(scope="module")
def enroller(contract: Contract) -> Enroller:
    return Enroller(contract, make_generator(), rotation=ROTATION, lift_secret=LIFT_SECRET)


def stored_template(enrollment: Enrollment, rotation: TenantRotation = ROTATION) -> SubspaceBatch:
    """Un-rotated, as the decoys are."""
    return wire.decode(enrollment.wire).subspace.turned_by(
        rotation.of(enrollment.template_id).turned_back
    )


def test_the_template_holds_the_mean_of_the_photos_and_is_rotated(
    contract: Contract, enroller: Enroller
) -> None:
    enrollment = enroller.from_embeddings(PHOTOS[:3])
    mean = projected(unit(PHOTOS[:3].mean(axis=0)))[None]
    template = stored_template(enrollment)
    assert (template.n, template.m) == (K, M)
    assert template.contains(mean, tol=2e-3).all()
    assert not template.contains(POINTS[:3], tol=0.05).any()
    rotated = wire.decode(enrollment.wire)
    assert not rotated.subspace.contains(mean, tol=0.3).any()
    assert rotated.contract_id == enrollment.contract_id == contract.contract_id
    assert rotated.dtype == "float16"
    text = repr(enrollment)
    assert "wire" not in text
    assert len(text) < 400


def largest_angle(first: SubspaceBatch, second: SubspaceBatch) -> float:
    """Sine of the largest angle between the linear spans of two templates: 0 if they are one."""
    rows, others = (
        np.linalg.qr(np.vstack([template.foot, template.basis]).astype(np.float64).T)[0].T
        for template in (first, second)
    )
    return float(np.linalg.norm(rows - rows @ others.T @ others, ord=2))


def test_the_same_photos_give_the_same_set_again_in_another_rotation(enroller: Enroller) -> None:
    first, again = enroller.from_embeddings(PHOTOS[:3]), enroller.from_embeddings(PHOTOS[2::-1])
    assert first.template_id != again.template_id
    assert len(first.template_id) == 32
    # To the half precision of what is stored.
    assert largest_angle(stored_template(first), stored_template(again)) < 1e-2
    stored = [wire.decode(entry.wire).subspace for entry in (first, again)]
    assert largest_angle(*stored) > 0.9


@pytest.mark.parametrize("rows", [[0, 0], [0, 0, 1]])
def test_a_photo_given_twice_is_as_if_it_were_given_once(
    enroller: Enroller, rows: list[int]
) -> None:
    once = enroller.from_embeddings(PHOTOS[sorted(set(rows))])
    twice = enroller.from_embeddings(PHOTOS[rows])
    assert largest_angle(stored_template(once), stored_template(twice)) < 1e-2
    assert twice.photos == len(set(rows))


def test_other_photos_another_deployment_and_another_contract_give_other_decoys(
    contract: Contract, enroller: Enroller
) -> None:
    first = stored_template(enroller.from_embeddings(PHOTOS[:3]))
    elsewhere = Enroller(contract, make_generator(), rotation=ROTATION, lift_secret=bytes(32))
    other = dataclasses.replace(
        contract,
        binding=dataclasses.replace(contract.binding, preprocessing={"size": 112}),
        calibrations=tuple(
            dataclasses.replace(calibration, calibration_id="")
            for calibration in contract.calibrations
        ),
    )
    renamed = Enroller(other, make_generator(), rotation=ROTATION, lift_secret=LIFT_SECRET)
    for enrollment in (
        enroller.from_embeddings(PHOTOS[:2]),
        elsewhere.from_embeddings(PHOTOS[:3]),
        renamed.from_embeddings(PHOTOS[:3]),
    ):
        second = stored_template(enrollment)
        shared = first.basis.astype(np.float64) @ second.basis.T
        # Shared decoys would give principal angles of 0; generic 6-spaces of 60 numbers do not.
        assert np.linalg.svd(shared, compute_uv=False).max() < 0.99


def without_key(enrollment: Enrollment, key: bytes) -> SubspaceBatch:
    """Un-rotated, as the descriptors are: what opens it has the holder's key as well."""
    assert enrollment.holder_salt is not None
    rotation = holder_rotation(key, enrollment.holder_salt, K)
    return stored_template(enrollment).turned_by(rotation.turned_back)


def test_of_a_holder_the_same_photos_give_the_same_set_for_one_subject_only(
    enroller: Enroller,
) -> None:
    """Whatever key they have; to others of the same photos not even the length is alike."""
    keys = [bytes(range(32)), bytes(range(1, 33))]
    mine = [
        without_key(enroller.from_embeddings(rows, holder=Holder(key, "bank", "ada")), key)
        for key, rows in zip(keys, (PHOTOS[:3], PHOTOS[2::-1]), strict=True)
    ]
    assert largest_angle(*mine) < 1e-2
    assert abs(mine[0].foot_norm - mine[1].foot_norm) < 1e-3
    plain = stored_template(enroller.from_embeddings(PHOTOS[:3]))
    others = [plain] + [
        without_key(enroller.from_embeddings(PHOTOS[:3], holder=Holder(keys[0], *whose)), keys[0])
        for whose in (("shop", "ada"), ("bank", "eve"), ("banka", "da"))
    ]
    for other in others:
        assert largest_angle(mine[0], other) > 0.5
        assert abs(mine[0].foot_norm - other.foot_norm) > 2e-3
    assert len({round(other.foot_norm, 3) for other in others}) == 4


def test_a_stranger_among_the_photos_is_named_without_numbers_of_them(enroller: Enroller) -> None:
    mixed = np.stack([PHOTOS[0], PHOTOS[4], PHOTOS[1]])
    with pytest.raises(InconsistentImages) as caught:
        enroller.from_embeddings(mixed)
    assert caught.value.photos == (1,)
    assert isinstance(caught.value, VeilfaceError)
    assert "photo 2 does not look like the person on photos 1 and 3;" in str(caught.value)
    assert "0." not in str(caught.value)


@pytest.mark.parametrize(
    "rows",
    [np.zeros((0, N)), np.repeat(PHOTOS[:1], 11, axis=0), 2 * PHOTOS[:1], PHOTOS[:1, :5]],
    ids=["none", "eleven", "norm", "short"],
)
def test_malformed_embeddings_are_refused(enroller: Enroller, rows: NDArray[np.float32]) -> None:
    with pytest.raises(InvalidEmbedding):
        enroller.from_embeddings(rows)


class FakePack(ModelPack):
    """Stands for a model pack: the photo's byte is the row of ``PHOTOS``; 255 has no face."""

    def __init__(self) -> None: ...

    def embed_photo(self, photo: bytes, **_: object) -> Any:
        if photo == b"\xff":
            raise NoFace("no face was found")
        # The second byte stands for what a file has beside its pixels.
        facts = {"embedding": PHOTOS[photo[0]], "quality": "good", "picture": photo[:1]}
        return type("Sample", (), facts)


def test_photos_are_embedded_and_enrolled(enroller: Enroller) -> None:
    enrollment = enroller.from_photos(FakePack(), [b"\x00", b"\x01"])
    assert enrollment.qualities == ("good", "good")
    mean = projected(unit(PHOTOS[0] + PHOTOS[1]))[None]
    assert stored_template(enrollment).contains(mean, tol=2e-3).all()


def test_files_of_the_same_pixels_give_the_same_set(enroller: Enroller) -> None:
    first, again, other = (
        stored_template(enroller.from_photos(FakePack(), photos))
        for photos in ([b"\x00a", b"\x01a"], [b"\x00b", b"\x01a"], [b"\x00a", b"\x02a"])
    )
    assert largest_angle(first, again) < 1e-2
    assert largest_angle(first, other) > 0.9


def test_one_unusable_photo_refuses_the_set(enroller: Enroller) -> None:
    with pytest.raises(PhotoRejected, match="photo 2 of 2: no face") as caught:
        enroller.from_photos(FakePack(), [b"\x00", b"\xff"])
    assert caught.value.index == 1
    assert isinstance(caught.value.cause, NoFace)


def test_another_source_is_refused(contract: Contract) -> None:
    people = draw_people(400, photos=(1,), seed=102).descriptors
    other = DecoyGenerator.fit(people).reduced(K)
    with pytest.raises(ContractMismatch, match=other.source_id[:16]):
        Enroller(contract, other, rotation=ROTATION, lift_secret=LIFT_SECRET)


def client_template(contract: Contract, *, m: int = M) -> SubspaceBatch:
    return lift(POINTS[:1], strategy=contract.binding.strategy, m=m, source=make_generator())[0]


def test_a_clients_basis_is_replaced_by_a_random_one_of_the_same_set(
    contract: Contract, enroller: Enroller
) -> None:
    sent = client_template(contract)
    data = wire.encode(sent, contract_id=contract.contract_id)
    first, second = (stored_template(enroller.from_template(data)) for _ in range(2))
    own = sent.basis.astype(np.float64)
    for template in (first, second):
        seen = template.basis.astype(np.float64)
        np.testing.assert_allclose(seen.T @ seen, own.T @ own, atol=2e-3)
        np.testing.assert_allclose(template.foot, sent.foot, atol=1e-3)
        assert template.contains(POINTS[:1], tol=3e-3).all()
        # Haar-distributed rows: that all lie near the client's has probability below 1e-9.
        assert np.abs(seen @ own.T - np.eye(M)).max() > 0.1
    assert np.abs(first.basis - second.basis).max() > 0.05


def test_clients_templates_that_break_the_contract_are_refused(
    contract: Contract, enroller: Enroller
) -> None:
    contract_id = contract.contract_id
    good = client_template(contract)
    with pytest.raises(ContractMismatch, match="the template belongs to the contract dddd"):
        enroller.from_template(wire.encode(good, contract_id="d" * 64))
    with pytest.raises(InvalidTemplate, match="60 numbers and m = 6, not 60 and m = 5"):
        enroller.from_template(wire.encode(client_template(contract, m=5), contract_id=contract_id))
    central = SubspaceBatch(np.zeros(K, dtype=np.float32), good.basis)
    with pytest.raises(InvalidTemplate, match="foot point is outside the range"):
        enroller.from_template(wire.encode(central, contract_id=contract_id))
    with pytest.raises(InvalidTemplate):
        enroller.from_template(b"")


def test_hybrid_plus_takes_attributes_and_does_without() -> None:
    people = draw_people(60, seed=3)
    labels = [Attributes("Male", "White"), Attributes("Female", "Black")]
    pool = DecoyPool(
        draw_people(200, photos=(1,), seed=101).descriptors,
        labels=[labels[i % 2] for i in range(200)],
    )
    result = calibrate(
        people.descriptors,
        people.names,
        binding=make_binding(pool.source_id, strategy=Strategy.HYBRID_PLUS, axes=N),
        source=pool,
        options=CalibrationOptions(targets=(1e-1,)),
    )
    contract = dataclasses.replace(result.contract, photo_consistency=-1.0)
    rotation = tenant_rotation(N)
    enroller = Enroller(contract, pool, rotation=rotation, lift_secret=LIFT_SECRET)
    entries = draw_people(200, photos=(1,), seed=101).descriptors

    def decoys(photo: int, attributes: Attributes | None) -> list[Attributes]:
        enrollment = enroller.from_embeddings(PHOTOS[photo, None], attributes=attributes)
        template = stored_template(enrollment, rotation)
        inside = np.flatnonzero(template.contains(entries, tol=5e-3))
        assert len(inside) == M // 2  # the decoys; the other directions are random
        return [labels[i % 2] for i in inside.tolist()]

    for photo in range(8):  # ignored attributes would pass once in 2 ** 24
        assert set(decoys(photo, labels[0])) == {labels[1]}
    assert {label for photo in range(8) for label in decoys(photo, None)} == set(labels)
