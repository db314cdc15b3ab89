"""Requests that carry an Idempotency-Key: done once, answered as often as asked.

Only successes are kept, in the transaction of the write. A write that was refused changed nothing,
so its key is given back and the client may send a better photo under the same key. Neither is an
answer kept that holds a template for its holder: the store would have it for a day, and the next
request with the same key replaces it.
"""

import contextlib
import hashlib
import json
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from api.http.answers import answer
from api.http.auth import Caller
from api.http.preconditions import etag
from api.process.runtime import Runtime
from templates.errors import StoreError
from templates.keys.holder_key import wipe
from templates.keys.sealing import encode_parts
from templates.store.idempotency import Answer, Claim
from templates.store.subjects import Once, StoredTemplate


@dataclass(frozen=True)
class Outcome:
    """What a request answers; of an enrollment, its template id included.

    It holds no subject id, because it is kept for a day.
    """

    status: int
    body: Mapping[str, Any]
    replayed: bool = False

    def to_keep(self) -> Answer:
        """Return what the store keeps of it."""
        return Answer(self.status, json.dumps(dict(self.body)).encode())


def kept_with(claim: Claim | None, outcome: Callable[[StoredTemplate], Outcome]) -> Once | None:
    """Return what ``Subjects.put`` keeps for a claim: the answer that `outcome` gives."""
    return None if claim is None else Once(claim, lambda stored: outcome(stored).to_keep())


async def once(
    request: Request,
    caller: Caller,
    key: str | None,
    *,
    operation: str,
    asked: Sequence[str | bytes],
    subject: str | None,
    work: Callable[[Claim | None], Outcome],
    run: Callable[[Callable[[], Outcome]], Awaitable[Outcome]],
    holder_key: bytearray | None = None,
) -> Outcome:
    """Do a write; with a key that was used before, return what it answered then.

    Parameters
    ----------
    operation, asked
        What makes two requests the same. A multipart body is compared by its parts, because its
        boundary differs between two sendings.
    subject
        Erasing this subject removes the record.
    work
        The write, which keeps its answer in its own transaction; runs in a thread.
    run
        Which threads: the gate's ``compute`` or ``query``.
    holder_key
        What is forgotten in the end: in the thread, because nobody waits for one whose request was
        cancelled, and where the answer is given again too.

    Raises
    ------
    IdempotencyConflict
        If the key belongs to another request, or its first request still runs.
    """
    runtime: Runtime = request.app.state.runtime

    def guarded() -> Outcome:
        if key is None:
            return work(None)
        records = runtime.store.idempotency
        claim = records.claim(
            caller.tenant,
            actor=caller.name,
            key=key,
            request=hashlib.sha256(encode_parts(operation, *asked)).digest(),
            subject_id=subject,
        )
        if isinstance(claim, Answer):
            return Outcome(claim.status, json.loads(claim.body), replayed=True)
        try:
            return work(claim)
        except BaseException:
            with contextlib.suppress(StoreError):
                records.release(claim)
            raise

    def guarded_and_wiped() -> Outcome:
        try:
            return guarded()
        finally:
            wipe(holder_key)

    return await run(guarded_and_wiped)


def written(
    request: Request, outcome: Outcome, *, add: Mapping[str, Any] | None = None
) -> Response:
    """Answer an enrollment; `add` is what the answer has beside what is kept."""
    headers = {"ETag": etag(outcome.body["template_id"]), **replay_header(outcome)}
    return answer(request, {**outcome.body, **(add or {})}, status=outcome.status, headers=headers)


def replay_header(outcome: Outcome) -> dict[str, str]:
    """Return the header that tells an answer that is given again."""
    return {"Idempotency-Replayed": "true"} if outcome.replayed else {}
