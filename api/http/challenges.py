"""Challenges: sealed, self-contained ids, so that any worker knows one and nothing is stored of it.

It is used up by the decision, in the decision's transaction.
"""

import secrets

from api.http.errors import ApiError
from api.http.tokens import Sealed, SubjectToken, ends_in, opened
from templates.keys.sealing import MasterKeyring
from templates.store.audit_log import token_digest
from verify import Movement, draw_movements

LIFETIME_S = 60
_PURPOSE = "challenge"


class Challenge(Sealed):
    """What was asked, and what keeps it from a second use.

    Attributes
    ----------
    subject
        The only one that it can be answered for; None for any.
    movements
        What the person is asked to do.
    digest
        What the decision uses up: the token's own, where a token asked for the challenge.
    is_of_token
        Whether one did.
    """

    subject: str | None
    movements: tuple[Movement, ...]
    digest: str
    is_of_token: bool


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
    expires, digest = ends_in(LIFETIME_S), token_digest(key_prefix, secrets.token_urlsafe(18))
    if token is not None:
        expires, digest = min(expires, token.expires_at), token.digest
    challenge = Challenge(
        expires_at=expires,
        subject=subject,
        movements=draw_movements(),
        digest=digest,
        is_of_token=token is not None,
    )
    return challenge.sealed(keyring, _PURPOSE, [tenant]), challenge


def opened_challenge(
    keyring: MasterKeyring,
    challenge_id: str,
    *,
    tenant: str,
    subject: str,
    token: SubjectToken | None,
) -> Challenge:
    """Open the id of a challenge that frames answer.

    Parameters
    ----------
    token
        That the frames come with. A challenge that was asked for with a token comes with it: a
        decision under an API key, at whatever level it asks for, must not be taken for the token's.

    Raises
    ------
    ApiError
        ``validation_failed`` where it was made elsewhere, or for another tenant, subject or
        token.
    Replayed
        Where it has expired.
    """
    challenge = opened(Challenge, challenge_id, keyring, _PURPOSE, [tenant])
    if challenge is None or challenge.subject not in (None, subject):
        raise ApiError(
            "validation_failed",
            "the challenge_id is not one that this service gave out for this tenant and subject",
            {"field": "challenge_id"},
        )
    challenge.require_in_time()
    own = None if token is None else token.digest
    if own != (challenge.digest if challenge.is_of_token else None):
        raise ApiError(
            "validation_failed",
            "a challenge is answered with the token that it was asked for with, and one of an API "
            "key with an API key: ask for one with what you send",
            {"field": "challenge_id"},
        )
    return challenge
