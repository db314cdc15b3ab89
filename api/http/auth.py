"""Who calls, and what they may do: API keys with a tenant and rights, and tokens under them."""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Annotated

from fastapi import Depends, Request, Security
from fastapi.security import APIKeyHeader, HTTPAuthorizationCredentials, HTTPBearer

from api.http.errors import ApiError
from api.http.tokens import SubjectToken, opened_token, prefix_of
from api.limits.admission import Gate
from api.limits.rates import RateLimits
from api.service.runtime import Runtime
from templates.keys.api_token import is_token

_bearer = HTTPBearer(
    auto_error=False, scheme_name="bearer", description="`Authorization: Bearer vf_…`, or `vft_…`"
)
_header = APIKeyHeader(
    name="X-API-Key", auto_error=False, scheme_name="apiKey", description="`X-API-Key: vf_…`"
)


@dataclass(frozen=True)
class Caller:
    """An API key that was recognised, or a token that it asked for.

    Attributes
    ----------
    prefix, tenant, lowest_level
        Of the API key.
    key_id
        Its row's id.
    rights
        Of the key. With a token: what it is for, and ``embeddings`` where the key has it.
    subject_token
        What the request's token is good for; None where it came with the API key itself.
    """

    prefix: str
    tenant: str
    key_id: str = field(repr=False)
    rights: frozenset[str]
    lowest_level: str | None = None
    subject_token: SubjectToken | None = None

    def require(self, *rights: str) -> None:
        """Refuse unless the key has all of these rights.

        Raises
        ------
        ApiError
            ``forbidden``; it names the right that is missing.
        """
        missing = [right for right in rights if right not in self.rights]
        if missing:
            raise ApiError(
                "forbidden",
                f"this API key lacks the right {missing[0]}",
                {"missing": missing},
            )

    @property
    def sees_scores(self) -> bool:
        """Whether the key may see distances, and why liveness failed."""
        return {"scores", "enroll"} <= self.rights

    @property
    def sees_enrollment(self) -> bool:
        """Whether the key may learn that a subject does not exist."""
        return bool(self.rights & {"enroll", "admin"})


async def caller(
    request: Request,
    bearer: Annotated[HTTPAuthorizationCredentials | None, Security(_bearer)] = None,
    header: Annotated[str | None, Security(_header)] = None,
) -> Caller:
    """Recognise the API key of a request, or a token, which counts for the key that made it.

    Raises
    ------
    ApiError
        ``unauthorized``, in the same words for an absent, an unknown and a revoked key;
        ``overloaded``; ``rate_limited``; ``forbidden`` for what a token is not for.
    Replayed
        Where a token comes too late, or was used.
    """
    runtime: Runtime = request.app.state.runtime
    gate: Gate = request.app.state.gate
    text = bearer.credentials if bearer is not None else header
    # What is neither a key nor a token costs no query.
    if text is None or not (is_token(text) or prefix_of(text)):
        raise _unauthorized()
    known = await gate.query(lambda: _recognised(runtime, text))
    if known is None:
        raise _unauthorized()
    request.state.log.update(tenant=known.tenant, key_id=known.prefix)
    token = known.subject_token
    if token is not None:
        request.state.log["token_id"] = token.token_id
        note_subject(request, known, token.subject)
        # Before it counts: who finds an old token shall not use up the rate of its key.
        token.require_in_time()
    rate_limits: RateLimits = request.app.state.rate_limits
    await rate_limits.count_key(known.prefix)
    if token is not None:
        token.require(request.scope["route"].name, request.path_params.get("subject_id"))
        await gate.query(lambda: runtime.store.audit_log.require_unused(token.digest))
    return known


def _unauthorized() -> ApiError:
    return ApiError(
        "unauthorized",
        "send a valid API key or token: Authorization: Bearer vf_… or X-API-Key",
        {},
        {"WWW-Authenticate": "Bearer"},
    )


def _recognised(runtime: Runtime, text: str) -> Caller | None:
    """Look up an API key, or that of a token."""
    prefix, token = prefix_of(text), None
    if prefix is None:
        key = runtime.store.api_keys.verify(text)
    else:
        key = runtime.store.api_keys.valid(prefix)
        token = None if key is None else opened_token(runtime.keyring, text, key_id=key.id)
        if key is None or token is None:
            return None
        if not token.late:
            runtime.store.api_keys.note_use(key)
    if key is None:
        return None
    rights = frozenset(map(str, key.rights))
    return Caller(
        prefix=key.prefix,
        tenant=key.tenant,
        key_id=key.id,
        rights=rights if token is None else rights & {token.action, "embeddings"},
        lowest_level=key.lowest_level,
        subject_token=token,
    )


def note_subject(request: Request, caller: Caller, subject: str) -> None:
    """Keep the subject's pseudonym for the audit log, and its beginning for the request's line."""
    runtime: Runtime = request.app.state.runtime
    pseudonym = runtime.store.signer.pseudonym(caller.tenant, subject)
    request.state.pseudonym = pseudonym
    request.state.log["subject"] = pseudonym[:16]


CallerDep = Annotated[Caller, Depends(caller)]


def holding(*rights: str) -> Callable[[Caller], Awaitable[Caller]]:
    """Make a dependency that demands rights before anything of the body is read."""

    async def holder(caller: CallerDep) -> Caller:
        caller.require(*rights)
        return caller

    return holder
