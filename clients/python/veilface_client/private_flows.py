"""Flows of the clients that never send a face: lift here, send templates."""

from collections.abc import Iterable
from functools import partial
from typing import TypeVar

from veilface_client import calls, results
from veilface_client.calls import Call, Face
from veilface_client.errors import ContractMismatch, UnexpectedAnswer, VeilfaceError
from veilface_client.flows import Flow, Work, send
from veilface_client.lifting import Lifter, LiftInputs
from veilface_client.lifts import Enrollable, Probe
from veilface_client.photos import Photo, read_photos
from veilface_client.retries import Retries

T = TypeVar("T")

_LOOKS = 3


def inputs_of(lifter: Lifter, retries: Retries, *, fresh: bool = False) -> Flow[LiftInputs]:
    """Return the inputs of the contract; fetch it where there is none, or a fresh one is wanted."""
    current = lifter.inputs
    if current is not None and not fresh:
        return current
    for _ in range(_LOOKS):
        contract = yield from send(calls.contract(), retries)
        generator = yield from send(calls.generator(), retries)
        # The contract may have changed between the two answers, or between two workers.
        if generator.source_id == contract.binding.get("decoy_source_id"):
            inputs: LiftInputs = yield Work(partial(lifter.keep, contract, generator))
            return inputs
    raise UnexpectedAnswer("the generator of the service is not that of its contract")


def lift_probe(
    photos: Photo | Iterable[Photo], lifter: Lifter, retries: Retries, *, face: Face | None
) -> Flow[Probe]:
    """Lift a probe; nothing is sent of it."""
    pictures: list[bytes] = yield Work(lambda: read_photos(photos))
    inputs = yield from inputs_of(lifter, retries)
    return (yield from _probe(pictures, lifter, inputs, face))


def lift_enrollment(
    photos: Photo | Iterable[Photo], lifter: Lifter, retries: Retries, *, face: Face | None
) -> Flow[Enrollable]:
    """Lift a template that enrolls; nothing is sent of it."""
    pictures: list[bytes] = yield Work(lambda: read_photos(photos))
    inputs = yield from inputs_of(lifter, retries)
    return (yield from _enrollable(pictures, lifter, inputs, face))


def enroll(
    subject: str,
    photos: Photo | Iterable[Photo] | Enrollable,
    lifter: Lifter,
    retries: Retries,
    *,
    face: Face | None,
    holder_key: bytes | None,
    replace: bool | str,
) -> Flow[results.Enrollment]:
    """Enroll by photos that are lifted here, or by a template that was lifted before."""
    calls.subject_path(subject)
    if isinstance(photos, Enrollable):
        return (yield from _enroll(subject, photos, retries, holder_key, replace))
    pictures: list[bytes] = yield Work(lambda: read_photos(photos))
    lift = yield from lift_enrollment(pictures, lifter, retries, face=face)
    try:
        return (yield from _enroll(subject, lift, retries, holder_key, replace))
    except ContractMismatch:
        renewed = yield from inputs_of(lifter, retries, fresh=True)
        if renewed.contract_id == lift.contract_id:
            raise
    lift = yield from _enrollable(pictures, lifter, renewed, face)
    return (yield from _enroll(subject, lift, retries, holder_key, replace))


def verify(
    subject: str,
    photos: Photo | Iterable[Photo] | Probe,
    lifter: Lifter,
    retries: Retries,
    *,
    level: str | None,
    face: Face | None,
    holder_key: bytes | None,
) -> Flow[results.Decision]:
    """Verify photos that are lifted here, or a probe that was lifted before."""
    calls.subject_path(subject)
    if isinstance(photos, Probe):
        return (yield from _verify(subject, photos, retries, level, holder_key))
    pictures: list[bytes] = yield Work(lambda: read_photos(photos))
    probe = yield from lift_probe(pictures, lifter, retries, face=face)
    try:
        return (yield from _verify(subject, probe, retries, level, holder_key))
    except ContractMismatch:
        renewed = yield from inputs_of(lifter, retries, fresh=True)
        if renewed.contract_id == probe.contract_id:
            # It is the subject's stored template that is of another contract.
            raise
    probe = yield from _probe(pictures, lifter, renewed, face)
    return (yield from _verify(subject, probe, retries, level, holder_key))


def _probe(
    pictures: list[bytes], lifter: Lifter, inputs: LiftInputs, face: Face | None
) -> Flow[Probe]:
    probe: Probe = yield Work(partial(lifter.probe, inputs, pictures, face=face))
    return probe


def _enrollable(
    pictures: list[bytes], lifter: Lifter, inputs: LiftInputs, face: Face | None
) -> Flow[Enrollable]:
    enrollable: Enrollable = yield Work(partial(lifter.enrollment, inputs, pictures, face=face))
    return enrollable


def _enroll(
    subject: str,
    lift: Enrollable,
    retries: Retries,
    holder_key: bytes | None,
    replace: bool | str,
) -> Flow[results.Enrollment]:
    call = calls.enroll_template(
        subject,
        lift.template,
        holder_key=holder_key,
        replace=replace,
    )
    return (yield from _send(call, lift, retries))


def _verify(
    subject: str,
    lift: Probe,
    retries: Retries,
    level: str | None,
    holder_key: bytes | None,
) -> Flow[results.Decision]:
    call = calls.verify_template(
        subject,
        lift.template,
        level=level,
        holder_key=holder_key,
    )
    return (yield from _send(call, lift, retries))


def _send(call: Call[T], lift: Enrollable | Probe, retries: Retries) -> Flow[T]:
    """Send a lift. A resend repeats it; the error that ends it has it, so that callers can."""
    try:
        return (yield from send(call, retries))
    except ContractMismatch:
        raise
    except VeilfaceError as error:
        error.lift = lift
        error.add_note(
            "The service may have this lift: repeat the call with the error's `lift`, never with "
            "the photo. Two lifts of one photo give the embedding away."
        )
        raise
