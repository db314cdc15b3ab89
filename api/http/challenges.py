"""Challenges: sealed, self-contained ids, so that any worker knows one and nothing is stored of it.

It is used up by the decision, in the decision's transaction.
"""

import base64
import binascii
import json
import secrets
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from api.http.bodies import parse_json
from api.http.errors import ApiError
from api.http.tokens import SubjectToken
from api.http.values import in_time
from templates.errors import SealError
from templates.keys.sealing import MasterKeyring
from templates.store.audit_log import token_digest
from templates.store.lockout import Replayed
from verify import Movement, draw_movements

FIELD = "challenge_id"
MAX_ID = 1024
LIFETIME = timedelta(seconds=60)
_PURPOSE = "challenge"


@dataclass(frozen=True)
class Challenge:
    """What was asked, and what keeps it from a second use.

    Attributes
    ----------
    movements
        What the person is asked to do.
    digest
        What the decision uses up: the token's own, where a token asked for the challenge.
    is_of_token
        Whether one did.
    expires_at
        When its frames come too late.
    """

    movements: tuple[Movement, ...]
    digest: str
    is_of_token: bool
    expires_at: datetime


def new_challenge(
    keyring: MasterKeyring,
    *,
    tenant: str,
    key_prefix: str,
    subject: str | None,
    token: SubjectToken | None = None,
) -> tuple[str, Challenge]:
    """Draw a challenge; return its id and what it asks.

    Parameters
    ----------
    tenant
        The only one whose keys can answer it.
    key_prefix
        Of the key that asks for it.
    subject
        The only one that it can be answered for; None for any.
    token
        That it is asked for with: one decision uses up both. The challenge ends no later than it.
    """
    expires = datetime.now(UTC).replace(microsecond=0) + LIFETIME
    digest = token_digest(key_prefix, secrets.token_urlsafe(18))
    if token is not None:
        expires, digest = min(expires, token.expires_at), token.digest
    challenge = Challenge(draw_movements(), digest, token is not None, expires)
    body = {
        "movements": [str(movement) for movement in challenge.movements],
        "digest": digest,
        "token": challenge.is_of_token,
        "expires": int(expires.timestamp()),
        "subject": subject,
    }
    sealed = keyring.seal(json.dumps(body).encode(), purpose=_PURPOSE, bound_to=[tenant])
    return base64.urlsafe_b64encode(sealed).rstrip(b"=").decode("ascii"), challenge


def opened_challenge(
    keyring: MasterKeyring, challenge_id: str, *, tenant: str, subject: str
) -> Challenge:
    """Open the id of a challenge that frames answer.

    Raises
    ------
    ApiError
        ``validation_failed`` where it is none of this service, tenant and subject.
    Replayed
        Where it has expired.
    """
    unknown = ApiError(
        "validation_failed",
        "the challenge_id is not one that this service gave out for this tenant and subject",
        {"field": FIELD},
    )
    try:
        padded = challenge_id.encode("ascii") + b"=" * (-len(challenge_id) % 4)
        sealed = base64.b64decode(padded, altchars=b"-_", validate=True)
        body = parse_json(keyring.open(sealed, purpose=_PURPOSE, bound_to=[tenant]))
    except (SealError, binascii.Error, ValueError):
        raise unknown from None
    if body["subject"] not in (None, subject):
        raise unknown
    expires = datetime.fromtimestamp(body["expires"], UTC)
    if not in_time(expires, LIFETIME):
        raise Replayed(
            "the challenge has expired, or the service's clock was set back: its frames must "
            f"arrive within {LIFETIME.seconds} s; ask for another one"
        )
    movements = tuple(Movement(movement) for movement in body["movements"])
    return Challenge(movements, body["digest"], body["token"], expires)
