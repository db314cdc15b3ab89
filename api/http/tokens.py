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

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from api.http.errors import ApiError
from templates.errors import SealError
from templates.keys.sealing import MasterKeyring
from templates.store.audit_log import token_digest
from templates.store.lockout import Replayed
from templates.store.subjects import Precondition

Action = Literal["verify", "enroll"]
TOKEN_PURPOSE = "subject-token"  # noqa: S105 - a label, not a secret

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
    key_prefix: str
    replace: bool = True
    token_id: str = Field(default_factory=lambda: secrets.token_urlsafe(18))

    def text(self, keyring: MasterKeyring, *, key_id: str) -> str:
        """Return the token as a browser sends it.

        `key_id`, the row of the API key, is in the database alone: the master key makes no token.
        """
        return f"vft_{self.key_prefix}_{self.sealed(keyring, TOKEN_PURPOSE, [key_id])}"

    @property
    def digest(self) -> str:
        """What the audit log keeps of its use."""
        return token_digest(self.key_prefix, self.token_id)

    def require(self, route: str, subject: str | None) -> None:
        """Refuse a call that the token is not for; `subject` is the one that the path names."""
        if self.action not in CALLS.get(route, ()):
            raise _for_another("call", f"it is good to {self.action}, and not for this call")
        if subject is not None and unicodedata.normalize("NFC", subject) != self.subject:
            raise _for_another("subject", "it is for another subject")

    def level_of(self, asked: str | None) -> str | None:
        """Return the level to decide at; a request for another one is ``forbidden``."""
        if asked not in (None, self.level):
            raise _for_another("level", "it is for another security level: ask for none")
        return self.level

    def precondition(self, asked: Precondition | None) -> Precondition | None:
        """Return what the subject must have for an enrollment."""
        if self.replace:
            return asked
        if asked is not None and asked.template_id is not None:
            raise _for_another("replace", "it replaces no enrollment: send no If-Match with it")
        return Precondition(None)


def _for_another(what: str, message: str) -> ApiError:
    return ApiError("forbidden", f"this token: {message}", {"token": what})
