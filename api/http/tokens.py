"""Subject tokens: what a browser holds in place of an API key, for one call of one subject.

A token is sealed under the master key and bound to the row of the API key that asked for it, so
that any worker knows it and nothing is stored of it. It is used up with what it is for, in
the same transaction.
"""

import base64
import binascii
import json
import secrets
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Literal, get_args

from api.http.bodies import parse_json
from api.http.errors import ApiError
from api.http.values import in_time
from templates.errors import SealError
from templates.keys.api_token import SUBJECT_TOKEN
from templates.keys.sealing import MasterKeyring
from templates.store.audit_log import token_digest
from templates.store.lockout import Replayed
from templates.store.subjects import Precondition

Action = Literal["verify", "enroll"]
ACTIONS: tuple[Action, ...] = get_args(Action)
LONGEST_S = 120
_PURPOSE = "subject-token"

CALLS: dict[str, frozenset[Action]] = {
    "enroll": frozenset({"enroll"}),
    "verify": frozenset({"verify"}),
    "create_challenge": frozenset({"verify"}),
    "get_contract": frozenset(ACTIONS),
    "get_generator": frozenset(ACTIONS),
    "list_pack": frozenset(ACTIONS),
    "get_pack_file": frozenset(ACTIONS),
}
"""Routes that take a token, by the name of their function, and of which action. No other does."""
USES = frozenset(ACTIONS)
"""Those of them that use it up."""


@dataclass(frozen=True)
class SubjectToken:
    """What a token is good for.

    Attributes
    ----------
    subject, action
        The only subject, and the only thing that is done to it.
    level
        Security level of a verification; None for an enrollment.
    token_id
        Names it in logs and answers; nothing can be done with it alone.
    key_prefix, expires_at
        Of the API key that asked for it, and when it ends.
    replace
        Whether its enrollment may replace an earlier one.
    """

    subject: str
    action: Action
    level: str | None
    token_id: str
    key_prefix: str
    expires_at: datetime
    replace: bool = True

    @property
    def digest(self) -> str:
        """What the audit log keeps of its use."""
        return token_digest(self.key_prefix, self.token_id)

    @property
    def late(self) -> bool:
        """Whether its time is over, or has not come."""
        return not in_time(self.expires_at, timedelta(seconds=LONGEST_S))

    def require_in_time(self) -> None:
        """Refuse a token that is late.

        Raises
        ------
        Replayed
            Without a line in the audit log: whoever finds an old token could write there for ever.
        """
        if self.late:
            raise Replayed(
                "the token has expired, or the service's clock was set back: ask your server for "
                "another one",
                recorded=True,
            )

    def require(self, route: str, subject: str | None) -> None:
        """Refuse a call that the token is not for; `subject` is the one that the path names.

        Raises
        ------
        ApiError
            ``forbidden``.
        """
        if self.action not in CALLS.get(route, ()):
            raise _another("call", f"this token is good to {self.action}, and not for this call")
        self.require_subject(subject)

    def require_subject(self, subject: str | None) -> None:
        """Refuse another subject than the token's; None is none.

        Raises
        ------
        ApiError
            ``forbidden``.
        """
        if subject not in (None, self.subject):
            raise _another("subject", "this token is for another subject")

    def level_of(self, asked: str | None) -> str | None:
        """Return the level to decide at, where a request asks for one or for none.

        Raises
        ------
        ApiError
            ``forbidden``.
        """
        if asked not in (None, self.level):
            raise _another(
                "level", "this token is for another security level: ask for its own, or for none"
            )
        return self.level

    def precondition(self, asked: Precondition | None) -> Precondition | None:
        """Return what the subject must have for an enrollment, where a request asks for something.

        Raises
        ------
        ApiError
            ``forbidden``.
        """
        if self.replace:
            return asked
        if asked is not None and asked.template_id is not None:
            raise _another("replace", "this token replaces no enrollment: send no If-Match with it")
        return Precondition(None)


def _another(what: str, message: str) -> ApiError:
    return ApiError("forbidden", message, {"token": what})


@dataclass(frozen=True)
class NewToken:
    """A token that was just made; its text is shown once."""

    token: SubjectToken
    text: str = field(repr=False)


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
) -> NewToken:
    """Make a token.

    Parameters
    ----------
    key_id, key_prefix
        Row id and prefix of the API key that asks for it. The id is in the database alone, so that
        the master key does not suffice to make a token.
    lifetime_s
        1 to ``LONGEST_S``.
    """
    expires = datetime.now(UTC).replace(microsecond=0) + timedelta(seconds=lifetime_s)
    token = SubjectToken(
        subject, action, level, secrets.token_urlsafe(18), key_prefix, expires, replace
    )
    body = {
        "subject": subject,
        "action": action,
        "level": level,
        "replace": replace,
        "id": token.token_id,
        "expires": int(expires.timestamp()),
    }
    sealed = keyring.seal(json.dumps(body).encode(), purpose=_PURPOSE, bound_to=[key_id])
    text = base64.urlsafe_b64encode(sealed).rstrip(b"=").decode("ascii")
    return NewToken(token, f"vft_{key_prefix}_{text}")


def prefix_of(text: str) -> str | None:
    """Return the prefix of the API key that a token names; None for what is no token."""
    match = SUBJECT_TOKEN.fullmatch(text)
    return None if match is None else match[1]


def opened_token(keyring: MasterKeyring, text: str, *, key_id: str) -> SubjectToken | None:
    """Open a token that the API key of this row asked for, in time or not; None for any other."""
    match = SUBJECT_TOKEN.fullmatch(text)
    if match is None:
        return None
    try:
        sealed = base64.b64decode(match[2] + "=" * (-len(match[2]) % 4), b"-_", validate=True)
        body = parse_json(keyring.open(sealed, purpose=_PURPOSE, bound_to=[key_id]))
    except (SealError, binascii.Error, ValueError):
        return None
    return SubjectToken(
        subject=body["subject"],
        action=body["action"],
        level=body["level"],
        token_id=body["id"],
        key_prefix=match[1],
        expires_at=datetime.fromtimestamp(body["expires"], UTC),
        replace=body["replace"],
    )
