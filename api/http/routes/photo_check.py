"""Would this photo do? The detector and the limits of enrollment, and nothing after them."""

from typing import Any

from fastapi import APIRouter

from api.http.auth import EnrollsOrVerifies
from api.http.bodies import read_form
from api.http.errors import plain_details
from api.http.openapi import body_of
from api.http.requests import PhotoCheckForm
from api.http.schemas import PhotoCheckAnswer
from api.service.metrics import step
from models.errors import FaceError

router = APIRouter(prefix="/v1/photos", tags=["Enroll and verify"])


@router.post(
    "/check",
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
            limits = runtime.image_limits
            try:
                with step("check"):
                    taken = pack.crop_photo(sent.image[0], policy=sent.face, limits=limits)
            except FaceError as refusal:
                code: Any = refusal.code
                return PhotoCheckAnswer(
                    **call.common,
                    usable=False,
                    code=code,
                    message=str(refusal),
                    details=plain_details(refusal.details),
                    box=None,
                    quality={},
                )
            message = "one face, large and clear enough"
            if taken.face is None:
                message = "an aligned crop of a face, clear enough"
            return PhotoCheckAnswer(
                **call.common,
                usable=True,
                code=None,
                message=message,
                details={},
                box=None if taken.box is None else [round(side, 1) for side in taken.box],
                quality=taken.quality.as_dict(),
            )

        return await call.compute(work)
