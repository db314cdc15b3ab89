"""Would this photo do? The detector and the limits of enrollment, and nothing after them."""

from typing import Any

from fastapi import APIRouter, Request
from starlette.responses import Response

from api.http.answers import answer
from api.http.bodies import reject_unknown, sent_form
from api.http.deps import EnrollsOrVerifies, GateDep, RuntimeDep
from api.http.errors import plain_details
from api.http.openapi import BODY, CHECK_BODY, CHECKED_PHOTO, EVERY_CALL, error_responses
from api.http.schemas import PhotoCheckAnswer
from api.http.values import face_policy
from api.service.metrics import step
from models.errors import FaceError

router = APIRouter(prefix="/v1/photos", tags=["Enroll and verify"])


@router.post(
    "/check",
    response_model=PhotoCheckAnswer,
    responses=error_responses(*EVERY_CALL, *BODY, *CHECKED_PHOTO, "forbidden"),
    openapi_extra=CHECK_BODY,
    summary="Would this photo do?",
)
async def check_photo(
    request: Request, caller: EnrollsOrVerifies, runtime: RuntimeDep, gate: GateDep
) -> Response:
    """Right: `enroll` or `verify`. For guidance before a camera: finds the face, measures it.

    The same detector and the same limits as enrollment, and no embedding: nothing is compared,
    and nothing is kept. A photo that would be refused for its face is answered with 200 and
    `usable` false.
    """
    settings = runtime.settings
    async with gate.admitted(caller.prefix):
        pack = runtime.required_pack()
        with step("body"):
            form = await sent_form(request, settings, field="image", max_images=1)
        photo = form.images("image")[0]
        reject_unknown(form.fields, ("face",))
        policy = face_policy(form.fields.get("face"))

        def work() -> dict[str, Any]:
            try:
                with step("check"):
                    taken = pack.crop_photo(photo, policy=policy, limits=runtime.image_limits)
            except FaceError as refusal:
                return {
                    "usable": False,
                    "code": refusal.code,
                    "message": str(refusal),
                    "details": plain_details(refusal.details),
                    "box": None,
                    "quality": {},
                }
            return {
                "usable": True,
                "code": None,
                "message": (
                    "one face, large and clear enough"
                    if taken.face is not None
                    else "an aligned crop of a face, clear enough"
                ),
                "details": {},
                "box": None if taken.box is None else [round(side, 1) for side in taken.box],
                "quality": taken.quality.as_dict(),
            }

        return answer(request, await gate.compute(work, key=caller.prefix))
