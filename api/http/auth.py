"""Who calls, and what they may do: API keys with a tenant and rights, and tokens under them."""

from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeVar

from fastapi import Depends, Request, Security
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from api.http.errors import ApiError
from api.http.schemas import REQUEST_ID
from api.http.tokens import TOKEN_PURPOSE, SubjectToken, opened
from api.limits.admission import Gate
from api.limits.rates import RateLimits
from api.service.runtime import Runtime
from templates.keys.api_token import SUBJECT_TOKEN, is_token
from templates.store import TemplateStore
from templates.store.api_keys import ApiKey
from templates.store.audit_log import By

_bearer = HTTPBearer(
    auto_error=False, scheme_name="bearer", description="`Authorization: Bearer vf_…`, or `vft_…`"
)

T = TypeVar("T")
BearerDep = Annotated[HTTPAuthorizationCredentials | None, Security(_bearer)]


@dataclass(frozen=True)
class Call:
    """A call whose API key was recognised, and what answers it.

    ``key`` is the API key, or the one that made the ``token``, where the call came with one.
    """

    request: Request = field(repr=False)
    key: ApiKey
    token: SubjectToken | None = None

    @property
    def runtime(self) -> Runtime:
        """What the process opened at its start."""
        runtime: Runtime = self.request.app.state.runtime
        return runtime

    @property
    def store(self) -> TemplateStore:
        """The database."""
        return self.runtime.store

    @property
    def tenant(self) -> str:
        """The only tenant that the call sees."""
        return self.key.tenant

    @property
    def rights(self) -> frozenset[str]:
        """Rights of the key. With a token: what it is for, and ``embeddings`` if the key has it."""
        rights = frozenset(map(str, self.key.rights))
        return rights if self.token is None else rights & {self.token.action, "embeddings"}

    @property
    def sees_scores(self) -> bool:
        """Whether the caller may see distances, and why liveness failed."""
        return {"scores", "enroll"} <= self.rights

    @property
    def sees_enrollment(self) -> bool:
        """Whether the caller may learn that a subject does not exist."""
        return bool(self.rights & {"enroll", "admin"})

    @property
    def by(self) -> By:
        """Who asks, for the audit log."""
        return By(f"key:{self.key.prefix}", REQUEST_ID.get())

    def require(self, *rights: str) -> None:
        """Refuse unless the caller has one of these rights."""
        if not self.rights & {*rights}:
            named = " or ".join(rights)
            raise ApiError(
                "forbidden", f"this API key lacks the right {named}", {"missing": [*rights]}
            )

    def note_subject(self, subject: str) -> str:
        """Keep the subject's pseudonym for the logs; return it."""
        pseudonym = self.store.signer.pseudonym(self.tenant, subject)
        self.request.state.pseudonym = pseudonym
        self.request.state.log["subject"] = pseudonym[:16]
        return pseudonym

    def place(self) -> AbstractAsyncContextManager[None]:
        """Take a place for a body, from before it is read until the answer is known."""
        return self._gate.admitted(self.key.prefix)

    async def query(self, work: Callable[[], T]) -> T:
        """Run work that asks the database, in a thread."""
        return await self._gate.query(work)

    async def compute(self, work: Callable[[], T]) -> T:
        """Run work in a thread, once it is this key's turn to compute."""
        return await self._gate.compute(work, key=self.key.prefix)

    @property
    def _gate(self) -> Gate:
        gate: Gate = self.request.app.state.gate
        return gate


async def call_of(request: Request, bearer: BearerDep = None) -> Call:
    """Recognise the API key of a request, or a token, which counts for the key that made it.

    An absent, an unknown and a revoked key are ``unauthorized`` in the same words.
    """
    runtime: Runtime = request.app.state.runtime
    gate: Gate = request.app.state.gate
    text = "" if bearer is None else bearer.credentials
    # What is neither a key nor a token costs no query.
    if not (is_token(text) or SUBJECT_TOKEN.fullmatch(text)):
        raise _unauthorized()
    key, token = await gate.query(lambda: _recognised(runtime, text))
    if key is None:
        raise _unauthorized()
    call = Call(request, key, token)
    request.state.log.update(tenant=key.tenant, key_id=key.prefix)
    if token is not None:
        request.state.log["token_id"] = token.token_id
        call.note_subject(token.subject)
        # Before it counts: who finds an old token shall not use up the rate of its key.
        token.require_in_time()
    rate_limits: RateLimits = request.app.state.rate_limits
    await rate_limits.count_key(key.prefix)
    if token is not None:
        token.require(request.scope["route"].name, request.path_params.get("subject_id"))
        await gate.query(lambda: runtime.store.audit_log.require_unused(token.digest))
    return call


def _unauthorized() -> ApiError:
    return ApiError(
        "unauthorized",
        "send a valid API key or token: Authorization: Bearer vf_…",
        {},
        {"WWW-Authenticate": "Bearer"},
    )


def _recognised(runtime: Runtime, text: str) -> tuple[ApiKey | None, SubjectToken | None]:
    """Look up an API key, or a token with the key that made it."""
    keys, token = runtime.store.api_keys, SUBJECT_TOKEN.fullmatch(text)
    if token is None:
        return keys.verify(text), None
    prefix, sealed = token.groups()
    key = keys.valid(prefix)
    if key is None:
        return None, None
    found = opened(SubjectToken, sealed, runtime.keyring, TOKEN_PURPOSE, [key.id])
    return (None, None) if found is None else (key, found)


AnyCall = Annotated[Call, Depends(call_of)]


def _holding(*rights: str) -> Any:
    """A dependency that demands one of some rights, before anything of the body is read."""

    async def holding(call: AnyCall) -> Call:
        call.require(*rights)
        return call

    return Depends(holding)


Enrolls = Annotated[Call, _holding("enroll")]
Verifies = Annotated[Call, _holding("verify")]
EnrollsOrVerifies = Annotated[Call, _holding("enroll", "verify")]
Erases = Annotated[Call, _holding("erase")]
Exports = Annotated[Call, _holding("export")]
Administers = Annotated[Call, _holding("admin")]
Lifts = Annotated[Call, _holding("embeddings")]
