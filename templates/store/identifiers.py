"""The names that come from outside, and the rules they keep."""

import re
from collections.abc import Callable
from datetime import UTC, datetime

from templates.errors import StoreError

SUBJECT_ID_RULE = "1 to 128 characters out of A-Z a-z 0-9 . _ @ : -, and is not . or .."
TENANT_NAME_RULE = "1 to 64 characters out of A-Z a-z 0-9 . _ -"
OPAQUE_ID_RULE = "1 to 64 characters out of A-Z a-z 0-9 _ -"

# A client or proxy may rewrite "." and ".." as path steps, and so name another resource.
_SUBJECT_ID = re.compile(r"(?!\.{1,2}\Z)[A-Za-z0-9._@:-]{1,128}")
_SUBJECT_PREFIX = re.compile(r"[A-Za-z0-9._@:-]{1,128}")
_TENANT_NAME = re.compile(r"[A-Za-z0-9._-]{1,64}")
_OPAQUE_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")

Clock = Callable[[], datetime]


class InvalidIdentifier(StoreError):
    """A subject id, tenant name or page cursor that breaks the rules."""


class UnknownTenant(StoreError):
    """No tenant of this name."""

    @classmethod
    def of_name(cls, name: str) -> "UnknownTenant":
        """The error of a name that no tenant has."""
        return cls(f"there is no tenant {name!r}")


def utc_now() -> datetime:
    """Time of now, aware, in UTC."""
    return datetime.now(UTC)


def checked_subject_id(text: str) -> str:
    """Return `text`, or raise :class:`InvalidIdentifier` with the rule."""
    return _checked(text, _SUBJECT_ID, f"a subject id has {SUBJECT_ID_RULE}")


def checked_subject_prefix(text: str) -> str:
    """Return `text`, with which a subject id begins, or raise :class:`InvalidIdentifier`."""
    rule = SUBJECT_ID_RULE.partition(",")[0]
    return _checked(text, _SUBJECT_PREFIX, f"what a subject id begins with has {rule}")


def checked_tenant_name(text: str) -> str:
    """Return `text`, or raise :class:`InvalidIdentifier` with the rule."""
    return _checked(text, _TENANT_NAME, f"a tenant name has {TENANT_NAME_RULE}")


def checked_opaque_id(text: str, *, what: str) -> str:
    """Return `text` (a template, contract or key id), or raise :class:`InvalidIdentifier`."""
    return _checked(text, _OPAQUE_ID, f"a {what} has {OPAQUE_ID_RULE}")


def _checked(text: str, pattern: re.Pattern[str], message: str) -> str:
    if not isinstance(text, str) or pattern.fullmatch(text) is None:
        raise InvalidIdentifier(message)
    return text
