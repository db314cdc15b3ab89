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

_SUBJECT_ID_LENGTH = 128
_TENANT_NAME = re.compile(r"[A-Za-z0-9._-]{1,64}")
# The letters and marks of Default_Ignorable_Code_Point (Unicode's DerivedCoreProperties.txt).
_INVISIBLE = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u3164\ufe00-\ufe0f\uffa0\U000e0000-\U000e0fff]"
)

Clock = Callable[[], datetime]


class InvalidIdentifier(StoreError):
    """A subject id, tenant name or page cursor that breaks the rules."""


class UnknownTenant(StoreError):
    """No tenant of this name."""


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
    if 0 < len(text) <= 4 * _SUBJECT_ID_LENGTH:
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
    if not _TENANT_NAME.fullmatch(text):
        raise InvalidIdentifier("a tenant name has 1 to 64 characters out of A-Z a-z 0-9 . _ -")
    return text
