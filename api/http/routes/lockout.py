"""The lockout of one subject, for operators' desks: look at it, and lift it."""

from fastapi import APIRouter, Request

from api.http.audit import by
from api.http.deps import Administers, Common, GateDep, RuntimeDep, SubjectDep
from api.http.errors import ApiError
from api.http.openapi import EVERY_CALL, error_responses
from api.http.schemas import LockoutAnswer, UnlockAnswer

router = APIRouter(prefix="/v1/subjects", tags=["People"])


@router.get(
    "/{subject_id}/lockout",
    responses=error_responses(*EVERY_CALL, "forbidden", "not_found", "validation_failed"),
    summary="Failed attempts on a subject",
)
async def get_lockout(
    caller: Administers, subject: SubjectDep, runtime: RuntimeDep, gate: GateDep, common: Common
) -> LockoutAnswer:
    """Right: `admin`. A subject that does not exist is counted like one that does.

    `not_found` where no verification failed since the last accept or reset.
    """
    status = await gate.query(lambda: runtime.store.attempts.status(caller.tenant, subject))
    if status is None or (status.consecutive == 0 and status.disabled_at is None):
        raise ApiError("not_found", "this subject has no failed attempts")
    return LockoutAnswer(
        **common,
        consecutive_failures=status.consecutive,
        last_failed_at=status.last_failed_at,
        locked_until=status.locked_until,
        disabled_at=status.disabled_at,
    )


@router.delete(
    "/{subject_id}/lockout",
    responses=error_responses(*EVERY_CALL, "forbidden", "validation_failed"),
    summary="Lift the lockout of a subject",
)
async def unlock_subject(
    request: Request,
    caller: Administers,
    subject: SubjectDep,
    runtime: RuntimeDep,
    gate: GateDep,
    common: Common,
) -> UnlockAnswer:
    """Right: `admin`. Forgets the failed attempts, and enables a subject that was disabled.

    Make sure first that it was the subject who failed: after this, an attacker may try again too.
    """
    lifted = await gate.query(
        lambda: runtime.store.attempts.reset(caller.tenant, subject, by=by(request))
    )
    return UnlockAnswer(**common, lifted=lifted)
