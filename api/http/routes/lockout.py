"""The lockout of one subject, for operators' desks: look at it, and lift it."""

from fastapi import APIRouter, Request
from starlette.responses import Response

from api.http.answers import answer
from api.http.audit import by
from api.http.deps import Administers, GateDep, RuntimeDep, SubjectDep
from api.http.errors import ApiError
from api.http.openapi import EVERY_CALL, error_responses
from api.http.schemas import LockoutAnswer, UnlockAnswer
from api.http.values import iso_time

router = APIRouter(prefix="/v1/subjects", tags=["People"])


@router.get(
    "/{subject_id}/lockout",
    response_model=LockoutAnswer,
    responses=error_responses(*EVERY_CALL, "forbidden", "not_found", "validation_failed"),
    summary="Failed attempts on a subject",
)
async def get_lockout(
    request: Request, caller: Administers, subject: SubjectDep, runtime: RuntimeDep, gate: GateDep
) -> Response:
    """Right: `admin`. A subject that does not exist is counted like one that does.

    `not_found` where no verification failed since the last accept or reset.
    """
    status = await gate.query(lambda: runtime.store.attempts.status(caller.tenant, subject))
    if status is None or (status.consecutive == 0 and status.disabled_at is None):
        raise ApiError("not_found", "this subject has no failed attempts")
    return answer(
        request,
        {
            "consecutive_failures": status.consecutive,
            "last_failed_at": iso_time(status.last_failed_at),
            "locked_until": iso_time(status.locked_until),
            "disabled_at": iso_time(status.disabled_at),
        },
    )


@router.delete(
    "/{subject_id}/lockout",
    response_model=UnlockAnswer,
    responses=error_responses(*EVERY_CALL, "forbidden", "validation_failed"),
    summary="Lift the lockout of a subject",
)
async def unlock_subject(
    request: Request,
    caller: Administers,
    subject: SubjectDep,
    runtime: RuntimeDep,
    gate: GateDep,
) -> Response:
    """Right: `admin`. Forgets the failed attempts, and enables a subject that was disabled.

    Make sure first that it was the subject who failed: after this, an attacker may try again too.
    """
    lifted = await gate.query(
        lambda: runtime.store.attempts.reset(caller.tenant, subject, by=by(request))
    )
    return answer(request, {"lifted": lifted})
