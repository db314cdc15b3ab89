"""The names that come from outside, and the rules they keep."""

import re
import unicodedata
from collections.abc import Callable
from datetime import UTC, datetime

from templates.errors import StoreError

SUBJECT_ID_RULE = (
    "1 to 128 characters: letters, marks and digits of any script, and . _ @ : - (stored in NFC); "
    "not `.` and not `..`"
)
TENANT_NAME_RULE = "1 to 64 characters out of A-Z a-z 0-9 . _ -"
OPAQUE_ID_RULE = "1 to 64 characters out of A-Z a-z 0-9 _ -"

_SUBJECT_ID_LENGTH = 128
_TENANT_NAME = re.compile(r"[A-Za-z0-9._-]{1,64}")
_OPAQUE_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")
# The letters and marks of Default_Ignorable_Code_Point (Unicode's DerivedCoreProperties.txt).
_INVISIBLE = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u3164\ufe00-\ufe0f\uffa0\U000e0000-\U000e0fff]"
)

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
    """Return a subject id in NFC: two spellings that look alike to everybody are one subject.

    Letters that only look alike, such as Latin and Cyrillic a, stay apart, and so do capitals.
    Spaces, controls and invisible characters, which nobody can tell from their absence, are an
    :class:`InvalidIdentifier`.
    """
    # A client or proxy may rewrite "." and ".." as path steps, and so name another resource.
    if text in (".", ".."):
        raise InvalidIdentifier(f"a subject id has {SUBJECT_ID_RULE}")
    return _checked_subject_text(text, "a subject id")


def checked_subject_prefix(text: str) -> str:
    """Return, in NFC, what a subject id begins with, or raise :class:`InvalidIdentifier`."""
    return _checked_subject_text(text, "what a subject id begins with")


def _checked_subject_text(text: str, what: str) -> str:
    # Before it is normalised, which takes long for long texts.
    if isinstance(text, str) and 0 < len(text) <= 4 * _SUBJECT_ID_LENGTH:
        normal = unicodedata.normalize("NFC", text)
        if len(normal) <= _SUBJECT_ID_LENGTH and all(map(_is_of_subject_id, normal)):
            return normal
    raise InvalidIdentifier(f"{what} has {SUBJECT_ID_RULE}")


def _is_of_subject_id(character: str) -> bool:
    if character in "._@:-":
        return True
    category = unicodedata.category(character)
    return (category[0] in "LM" or category == "Nd") and not _INVISIBLE.match(character)


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
