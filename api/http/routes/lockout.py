"""The lockout of one subject, for operators' desks: look at it, and lift it."""

from fastapi import APIRouter

from api.http.auth import Administers
from api.http.deps import SubjectDep
from api.http.errors import ApiError
from api.http.schemas import LockoutAnswer, UnlockAnswer

router = APIRouter(prefix="/v1/subjects", tags=["People"])


@router.get("/{subject_id}/lockout", summary="Failed attempts on a subject")
async def get_lockout(call: Administers, subject: SubjectDep) -> LockoutAnswer:
    """Right: `admin`. A subject that does not exist is counted like one that does.

    `not_found` where no verification failed since the last accept or reset.
    """
    status = await call.query(lambda: call.store.attempts.status(call.tenant, subject))
    if status is None or (status.consecutive == 0 and status.disabled_at is None):
        raise ApiError("not_found", "this subject has no failed attempts")
    return LockoutAnswer(
        **call.common,
        consecutive_failures=status.consecutive,
        last_failed_at=status.last_failed_at,
        locked_until=status.locked_until,
        disabled_at=status.disabled_at,
    )


@router.delete("/{subject_id}/lockout", summary="Lift the lockout of a subject")
async def unlock_subject(call: Administers, subject: SubjectDep) -> UnlockAnswer:
    """Right: `admin`. Forgets the failed attempts, and enables a subject that was disabled.

    Make sure first that it was the subject who failed: after this, an attacker may try again too.
    """
    lifted = await call.query(lambda: call.store.attempts.reset(call.tenant, subject, by=call.by))
    return UnlockAnswer(**call.common, lifted=lifted)
