"""Who calls, and what they may do: API keys with a tenant and rights."""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Annotated

from fastapi import Depends, Request, Security
from fastapi.security import APIKeyHeader, HTTPAuthorizationCredentials, HTTPBearer

from api.http.errors import ApiError
from api.limits.admission import Gate
from api.limits.rates import RateLimits
from api.process.runtime import Runtime
from templates.contract.liveness_policy import LivenessPolicy
from templates.keys.api_token import is_token, probe_key

_bearer = HTTPBearer(
    auto_error=False, scheme_name="bearer", description="`Authorization: Bearer vf_…`"
)
_header = APIKeyHeader(
    name="X-API-Key", auto_error=False, scheme_name="apiKey", description="`X-API-Key: vf_…`"
)


@dataclass(frozen=True)
class Caller:
    """An API key that was recognised."""

    prefix: str
    tenant: str
    rights: frozenset[str]
    token: str = field(repr=False, compare=False)
    lowest_level: str | None = None
    liveness: LivenessPolicy | None = None

    @property
    def probe_key(self) -> bytes:
        """The key that its probes are signed with."""
        return probe_key(self.token)

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
        ``overloaded``; ``rate_limited``.
    """
    runtime: Runtime = request.app.state.runtime
    gate: Gate = request.app.state.gate
    token = bearer.credentials if bearer is not None else header
    refused = ApiError(
        "unauthorized",
        "send a valid API key: Authorization: Bearer vf_… or X-API-Key",
        {},
        {"WWW-Authenticate": "Bearer"},
    )
    # What is no token costs no query.
    if token is None or not is_token(token):
        raise refused
    api_key = await gate.query(lambda: runtime.store.api_keys.verify(token))
    if api_key is None:
        raise refused
    request.state.log.update(tenant=api_key.tenant, key_id=api_key.prefix)
    rate_limits: RateLimits = request.app.state.rate_limits
    await rate_limits.count_key(api_key.prefix)
    return Caller(
        prefix=api_key.prefix,
        tenant=api_key.tenant,
        rights=frozenset(map(str, api_key.rights)),
        token=token,
        lowest_level=api_key.lowest_level,
        liveness=api_key.liveness,
    )


CallerDep = Annotated[Caller, Depends(caller)]


def holding(*rights: str) -> Callable[[Caller], Awaitable[Caller]]:
    """Make a dependency that demands rights before anything of the body is read."""

    async def holder(caller: CallerDep) -> Caller:
        caller.require(*rights)
        return caller

    return holder
