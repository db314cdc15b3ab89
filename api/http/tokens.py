"""Subject tokens: what a browser holds in place of an API key, for one call of one subject.

A token is sealed under the master key and bound to the row of the API key that asked for it, so
that any worker knows it and nothing is stored of it. It is used up with what it is for, in
the same transaction.
"""

import base64
import binascii
import secrets
import unicodedata
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import Literal, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from api.http.errors import ApiError
from templates.errors import SealError
from templates.keys.api_token import SUBJECT_TOKEN
from templates.keys.sealing import MasterKeyring
from templates.store.audit_log import token_digest
from templates.store.lockout import Replayed
from templates.store.subjects import Precondition

Action = Literal["verify", "enroll"]
_PURPOSE = "subject-token"

CALLS: dict[str, frozenset[Action]] = {
    "enroll": frozenset({"enroll"}),
    "verify": frozenset({"verify"}),
    "create_challenge": frozenset({"verify"}),
    "get_contract": frozenset({"verify", "enroll"}),
    "get_generator": frozenset({"verify", "enroll"}),
    "list_pack": frozenset({"verify", "enroll"}),
    "get_pack_file": frozenset({"verify", "enroll"}),
}
"""Routes that take a token, by the name of their function, and of which action. No other does."""


class Sealed(BaseModel):
    """What travels as a sealed text, to come back once, in time."""

    model_config = ConfigDict(frozen=True)

    expires_at: datetime

    def sealed(self, keyring: MasterKeyring, purpose: str, bound_to: Sequence[str]) -> str:
        """Return it as base64url, without padding."""
        text = keyring.seal(self.model_dump_json().encode(), purpose=purpose, bound_to=bound_to)
        return base64.urlsafe_b64encode(text).rstrip(b"=").decode("ascii")

    def require_in_time(self) -> None:
        """Refuse what is late."""
        # Unrecorded: anybody who finds an old token could fill the audit log with it.
        if self.expires_at < datetime.now(UTC):
            raise Replayed("it has expired: ask for another one", recorded=True)


S = TypeVar("S", bound=Sealed)


def opened(
    kind: type[S], text: str, keyring: MasterKeyring, purpose: str, bound_to: Sequence[str]
) -> S | None:
    """Open what :meth:`Sealed.sealed` wrote, in time or not; None for any other text."""
    try:
        sealed = base64.b64decode(text + "=" * (-len(text) % 4), b"-_", validate=True)
        return kind.model_validate_json(keyring.open(sealed, purpose=purpose, bound_to=bound_to))
    except (SealError, binascii.Error, ValidationError, ValueError):
        return None


def ends_in(seconds: int) -> datetime:
    """Return the time in so many seconds, to the second."""
    return datetime.now(UTC).replace(microsecond=0) + timedelta(seconds=seconds)


class SubjectToken(Sealed):
    """What a token is good for: one action on one subject, at one level if it is a verification.

    ``token_id`` names it in logs and answers; nothing can be done with it alone.
    """

    subject: str
    action: Action
    level: str | None
    token_id: str
    key_prefix: str
    replace: bool = True

    @property
    def digest(self) -> str:
        """What the audit log keeps of its use."""
        return token_digest(self.key_prefix, self.token_id)

    def require(self, route: str, subject: str | None) -> None:
        """Refuse a call that the token is not for; `subject` is the one that the path names."""
        if self.action not in CALLS.get(route, ()):
            raise _another("call", f"this token is good to {self.action}, and not for this call")
        if subject is not None and unicodedata.normalize("NFC", subject) != self.subject:
            raise _another("subject", "this token is for another subject")

    def level_of(self, asked: str | None) -> str | None:
        """Return the level to decide at; a request for another one is ``forbidden``."""
        if asked not in (None, self.level):
            raise _another(
                "level", "this token is for another security level: ask for its own, or for none"
            )
        return self.level

    def precondition(self, asked: Precondition | None) -> Precondition | None:
        """Return what the subject must have for an enrollment."""
        if self.replace:
            return asked
        if asked is not None and asked.template_id is not None:
            raise _another("replace", "this token replaces no enrollment: send no If-Match with it")
        return Precondition(None)


def _another(what: str, message: str) -> ApiError:
    return ApiError("forbidden", message, {"token": what})


def new_token(
    keyring: MasterKeyring,
    *,
    key_id: str,
    key_prefix: str,
    subject: str,
    action: Action,
    level: str | None,
    lifetime_s: int,
    replace: bool = True,
) -> tuple[SubjectToken, str]:
    """Make a token; return it with its text, which is shown once.

    `key_id`, the row of the API key, is in the database alone: the master key makes no token.
    """
    token = SubjectToken(
        subject=subject,
        action=action,
        level=level,
        token_id=secrets.token_urlsafe(18),
        key_prefix=key_prefix,
        expires_at=ends_in(lifetime_s),
        replace=replace,
    )
    return token, f"vft_{key_prefix}_{token.sealed(keyring, _PURPOSE, [key_id])}"


def prefix_of(text: str) -> str | None:
    """Return the prefix of the API key that a token names; None for what is no token."""
    match = SUBJECT_TOKEN.fullmatch(text)
    return None if match is None else match[1]


def opened_token(keyring: MasterKeyring, text: str, *, key_id: str) -> SubjectToken | None:
    """Open a token that the API key of this row asked for, in time or not; None for any other."""
    match = SUBJECT_TOKEN.fullmatch(text)
    return None if match is None else opened(SubjectToken, match[2], keyring, _PURPOSE, [key_id])
