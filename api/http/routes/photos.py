"""Photos of nobody who is enrolled: would one do, and do two show one person? Nothing is kept."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

from fastapi import APIRouter

from api.http.auth import Call, EnrollsOrVerifies, Verifies
from api.http.bodies import read_form
from api.http.errors import plain_details
from api.http.openapi import body_of
from api.http.requests import CompareForm, PhotoCheckForm
from api.http.routes.verification import answer_of
from api.http.schemas import PhotoCheckAnswer, VerifyAnswer
from api.service.metrics import step
from models.errors import FaceError, PhotoRejected
from templates.store.audit_log import Entry
from verify import Decision, probe_of_photos

router = APIRouter(prefix="/v1", tags=["Enroll and verify"])


@router.post(
    "/photos/check",
    openapi_extra=body_of(form=PhotoCheckForm),
    summary="Would this photo do?",
)
async def check_photo(call: EnrollsOrVerifies) -> PhotoCheckAnswer:
    """Right: `enroll` or `verify`. For guidance before a camera: finds the face, measures it.

    The same detector and the same limits as enrollment, and no embedding: nothing is compared,
    and nothing is kept. A photo that would be refused for its face is answered with 200 and
    `usable` false.
    """
    runtime = call.runtime
    async with call.place():
        pack = runtime.required_pack()
        with step("body"):
            sent = await read_form(call.request, PhotoCheckForm, photos="image", most=1)

        def work() -> PhotoCheckAnswer:
            try:
                with step("check"):
                    taken = pack.crop_photo(sent.image[0], policy=sent.face)
            except FaceError as refusal:
                code: Any = refusal.code
                details = plain_details(refusal.details)
                return PhotoCheckAnswer(
                    usable=False, code=code, message=str(refusal), details=details
                )
            message = "one face, large and clear enough"
            if taken.box is None:
                message = "an aligned crop of a face, clear enough"
            return PhotoCheckAnswer(
                usable=True,
                message=message,
                box=None if taken.box is None else [round(side, 1) for side in taken.box],
                quality=asdict(taken.quality),
            )

        return await call.compute(work)


@router.post(
    "/compare",
    openapi_extra=body_of(form=CompareForm),
    summary="Do two photos show one person?",
)
async def compare(call: Verifies) -> VerifyAnswer:
    """Right: `verify`. The first photo stands for an enrollment, and the second for the probe.

    The first is lifted to a template in memory, and the second is decided against it as by a
    verification, at a level of the contract. Nothing is stored, nobody is enrolled, and no attempt
    is counted on anybody; the audit log has a line without a subject.

    The deployment's liveness policy holds for the second photo. A challenge cannot be answered
    here, so the call is `forbidden` where the policy asks for one. The distance is returned only to
    keys with `scores` and `enroll`.
    """
    runtime = call.runtime
    async with call.place():
        runtime.required_pack()
        with step("body"):
            sent = await read_form(call.request, CompareForm, photos="images", most=2)
        level = runtime.levels.in_force(sent.level, lowest_of_key=call.key.lowest_level)
        runtime.liveness.require(photos=True, challenge=False)
        decision = await call.compute(lambda: _decide(call, sent, level))
    return answer_of(call, decision, probe="comparison")


def _decide(call: Call, sent: CompareForm, level: str) -> Decision:
    """Enroll the first photo in memory, decide the second by it, and write the audit log's line."""
    runtime, pack = call.runtime, call.runtime.required_pack()
    passive, epoch = runtime.liveness.policy.passive, runtime.current_epoch(call.tenant)
    first, second = sent.images
    with step("photo"):
        with _position(0):
            template = epoch.enroller.from_photos(pack, [first], policy=sent.face)
        with _position(1):
            probe = probe_of_photos(
                pack,
                runtime.contract,
                [second],
                passive=passive,
                policy=sent.face,
            )
    with step("decide"):
        decision = epoch.verifier.decide_embedding(probe.embedding, template, level=level)
    if passive:
        decision = decision.with_liveness(probe.failure)
    outcome = "accept" if decision.accepted else "reject"
    call.store.audit_log.record(Entry("compare", outcome, call.by, call.tenant, detail=level))
    return decision.with_advice(clear=probe.clear)


@contextmanager
def _position(index: int) -> Iterator[None]:
    """Name a refused photo by its position in the request."""
    try:
        yield
    except PhotoRejected as error:
        raise PhotoRejected(index, error.cause, count=2) from error
