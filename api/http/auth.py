"""Who calls, and what they may do: API keys with a tenant and rights, and tokens under them."""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Annotated

from fastapi import Depends, Request, Security
from fastapi.security import APIKeyHeader, HTTPAuthorizationCredentials, HTTPBearer

from api.http.errors import ApiError
from api.http.tokens import USES, SubjectToken, opened_token, prefix_of
from api.limits.admission import Gate
from api.limits.rates import RateLimits
from api.service.runtime import Runtime
from templates.keys.api_token import is_token
from templates.store.api_keys import ApiKey

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

    @property
    def name(self) -> str:
        """What it is counted by."""
        token = self.subject_token
        return self.prefix if token is None else f"{self.prefix}:{token.token_id}"

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
    def sees_enrollment(self) -> bool:
        """Whether the key may learn that a subject does not exist."""
        return bool(self.rights & {"enroll", "admin"})


async def caller(
    request: Request,
    bearer: Annotated[HTTPAuthorizationCredentials | None, Security(_bearer)] = None,
    header: Annotated[str | None, Security(_header)] = None,
) -> Caller:
    """Recognise the API key of a request.

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
    token = bearer.credentials if bearer is not None else header
    refused = ApiError(
        "unauthorized",
        "send a valid API key or token: Authorization: Bearer vf_… or X-API-Key",
        {},
        {"WWW-Authenticate": "Bearer"},
    )
    if token is None:
        raise refused
    api_key, subject_token = await _recognised(runtime, gate, token)
    if api_key is None:
        raise refused
    rights = frozenset(map(str, api_key.rights))
    if subject_token is not None:
        rights &= {subject_token.action, "embeddings"}
    known = Caller(
        prefix=api_key.prefix,
        tenant=api_key.tenant,
        key_id=api_key.id,
        rights=rights,
        lowest_level=api_key.lowest_level,
        subject_token=subject_token,
    )
    request.state.log.update(tenant=known.tenant, key_id=known.prefix)
    rate_limits: RateLimits = request.app.state.rate_limits
    await rate_limits.count_key(known.prefix)
    if subject_token is not None:
        await _require_token(request, runtime, gate, known, subject_token)
    return known


async def _recognised(
    runtime: Runtime, gate: Gate, token: str
) -> tuple[ApiKey | None, SubjectToken | None]:
    """Look up an API key, or that of a token; what is neither costs no query."""
    if is_token(token):
        return await gate.query(lambda: runtime.store.api_keys.verify(token)), None
    prefix = prefix_of(token)
    if prefix is None:
        return None, None
    return await gate.query(lambda: _of_token(runtime, token, prefix))


def _of_token(
    runtime: Runtime, token: str, prefix: str
) -> tuple[ApiKey, SubjectToken] | tuple[None, None]:
    """Open a token; the use of its key is noted for no other text under the key's prefix."""
    api_keys = runtime.store.api_keys
    api_key = api_keys.valid(prefix)
    if api_key is None:
        return None, None
    subject_token = opened_token(runtime.keyring, token, key_id=api_key.id)
    if subject_token is None:
        return None, None
    if not subject_token.late:
        api_keys.note_use(api_key)
    return api_key, subject_token


async def _require_token(
    request: Request, runtime: Runtime, gate: Gate, caller: Caller, token: SubjectToken
) -> None:
    """Refuse a call that a token is not for, or that comes too late for it."""
    request.state.log["token_id"] = token.token_id
    pseudonym = runtime.store.signer.pseudonym(caller.tenant, token.subject)
    note_subject(request, pseudonym)
    token.require_in_time()
    route = request.scope["route"].name
    token.require(route, request.path_params.get("subject_id"))
    if route not in USES:
        # Those look for themselves, in the transaction that uses it up too.
        await gate.query(lambda: runtime.store.audit_log.require_unused(token.digest))


def note_subject(request: Request, pseudonym: str) -> None:
    """Keep the subject's pseudonym for the audit log, and its beginning for the request's line."""
    request.state.pseudonym = pseudonym
    request.state.log["subject"] = pseudonym[:16]


CallerDep = Annotated[Caller, Depends(caller)]


def holding(*rights: str) -> Callable[[Caller], Awaitable[Caller]]:
    """Make a dependency that demands rights before anything of the body is read."""

    async def holder(caller: CallerDep) -> Caller:
        caller.require(*rights)
        return caller

    return holder
