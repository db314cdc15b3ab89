"""Every call of the service as a value: what is sent, how the answer is read, when to send again.

Nothing here does I/O.
"""

import base64
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, Generic, Literal, TypeVar

import httpx

from veilface_client import results
from veilface_client.errors import UnexpectedAnswer
from veilface_client.holder_keys import holder_key_field
from veilface_client.results import parse

T = TypeVar("T")
Face = Literal["dominant", "largest", "single"]
Action = Literal["verify", "enroll"]

_SUBJECT = re.compile(r"[A-Za-z0-9._@:-]{1,128}")
_TEMPLATE_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")


class Resend(Enum):
    """When a call may be sent again."""

    WHEN_LOST = "also when the answer was lost: done twice is as done once"
    WHEN_NOT_DONE = "only when the service has certainly not done it"
    NEVER = "the first answer is the answer"


@dataclass(frozen=True, repr=False)
class Call(Generic[T]):
    """One call.

    Attributes
    ----------
    content
        Makes what httpx builds a request of (``json``, ``files``, ``params`` …), anew for each
        sending.
    read
        Reads a success.
    """

    method: str
    path: str
    read: Callable[[httpx.Response], T]
    content: Callable[[], Mapping[str, Any]] = dict
    resend: Resend = Resend.WHEN_LOST


def subject_path(subject: str, rest: str = "") -> str:
    """Return the path of a subject; a subject id needs no escapes in it."""
    if not _SUBJECT.fullmatch(subject) or subject in (".", ".."):
        raise ValueError("a subject id has 1 to 128 characters out of A-Z a-z 0-9 . _ @ : -")
    return f"/v1/subjects/{subject}{rest}"


def precondition(replace: bool | str) -> dict[str, str]:
    """Return the header that says what an enrollment may replace; none where it is anything."""
    if replace is True:
        return {}
    if replace is False:
        return {"If-None-Match": "*"}
    if not _TEMPLATE_ID.fullmatch(replace):
        raise ValueError("replace is True, False, or the template_id of an enrollment")
    return {"If-Match": f'"{replace}"'}


def _resend(replace: bool | str) -> Resend:
    """An enrollment that may replace only something would meet what its first sending wrote."""
    return Resend.WHEN_LOST if replace is True else Resend.WHEN_NOT_DONE


def enroll_photos(
    subject: str,
    photos: Sequence[bytes],
    *,
    attributes: Mapping[str, str] | None,
    face: Face | None,
    holder_key: bytes | None,
    replace: bool | str,
) -> Call[results.Enrollment]:
    """Enroll by photos."""
    fields = _fields(attributes=None if attributes is None else json.dumps(dict(attributes)))
    content = {
        "files": [("images", _file(photo)) for photo in photos],
        "data": {
            **fields,
            **_fields(face=face),
            **holder_key_field(holder_key),
        },
        "headers": precondition(replace),
    }
    return Call(
        "PUT",
        subject_path(subject, "/enrollment"),
        lambda answer: parse(results.Enrollment, answer),
        lambda: content,
        _resend(replace),
    )


def enroll_template(
    subject: str,
    template: bytes,
    *,
    holder_key: bytes | None,
    replace: bool | str,
) -> Call[results.Enrollment]:
    """Enroll by a private template."""
    body = {"template": base64.b64encode(template).decode("ascii")}
    content = {
        "json": {**body, **holder_key_field(holder_key)},
        "headers": precondition(replace),
    }
    return Call(
        "PUT",
        subject_path(subject, "/enrollment"),
        lambda answer: parse(results.Enrollment, answer),
        lambda: content,
        _resend(replace),
    )


def verify_photos(
    subject: str,
    photos: Sequence[bytes],
    *,
    level: str | None,
    face: Face | None,
    challenge_id: str | None,
    holder_key: bytes | None,
) -> Call[results.Decision]:
    """Verify photos of one person, or the frames that answer a challenge."""
    content = {
        "files": [("image", _file(photo)) for photo in photos],
        "data": {
            **_fields(level=level, face=face, challenge_id=challenge_id),
            **holder_key_field(holder_key),
        },
    }
    return Call(
        "POST",
        subject_path(subject, "/verify"),
        lambda answer: parse(results.Decision, answer),
        lambda: content,
        Resend.WHEN_NOT_DONE,
    )


def verify_template(
    subject: str,
    template: bytes,
    *,
    level: str | None,
    holder_key: bytes | None,
) -> Call[results.Decision]:
    """Verify a lifted probe."""
    body = {
        "template": base64.b64encode(template).decode("ascii"),
        **_fields(level=level),
        **holder_key_field(holder_key),
    }
    return Call(
        "POST",
        subject_path(subject, "/verify"),
        lambda answer: parse(results.Decision, answer),
        lambda: {"json": body},
        Resend.WHEN_NOT_DONE,
    )


def challenge(subject: str | None) -> Call[results.Challenge]:
    """Ask for a challenge; one that is lost harms nobody."""
    body = _fields(subject_id=subject)
    return Call(
        "POST",
        "/v1/challenges",
        lambda answer: parse(results.Challenge, answer),
        lambda: {"json": body},
    )


def create_token(
    subject: str,
    action: Action,
    *,
    level: str | None,
    lifetime_s: int | None,
    replace: bool,
) -> Call[results.Token]:
    """Ask for a token for a browser; one that is lost harms nobody."""
    subject_path(subject)
    body: dict[str, Any] = {"subject_id": subject, "action": action, **_fields(level=level)}
    if lifetime_s is not None:
        body["lifetime_s"] = lifetime_s
    if not replace:
        body["replace"] = False
    return Call(
        "POST",
        "/v1/tokens",
        lambda answer: parse(results.Token, answer),
        lambda: {"json": body},
    )


def token_outcome(subject: str, token_id: str) -> Call[results.TokenOutcome]:
    """What came of a token."""
    if not _TEMPLATE_ID.fullmatch(token_id):
        raise ValueError("a token_id has 1 to 64 characters out of A-Z a-z 0-9 _ -")
    return Call(
        "GET",
        subject_path(subject, f"/tokens/{token_id}"),
        lambda answer: parse(results.TokenOutcome, answer),
    )


def page(*, limit: int, cursor: str | None) -> Call[results.SubjectPage]:
    """One page of subjects."""
    params = {"limit": limit} | ({} if cursor is None else {"cursor": cursor})
    return Call(
        "GET",
        "/v1/subjects",
        lambda answer: parse(results.SubjectPage, answer),
        lambda: {"params": params},
    )


def describe(subject: str) -> Call[results.SubjectAnswer]:
    """One subject."""
    return Call("GET", subject_path(subject), lambda answer: parse(results.SubjectAnswer, answer))


def erase(subject: str) -> Call[results.Receipt]:
    """Erase a subject; sent again, it returns the same receipt."""
    return _erasing(subject_path(subject), results.Receipt)


def lockout(subject: str) -> Call[results.Lockout]:
    """Failed attempts on a subject."""
    path = subject_path(subject, "/lockout")
    return Call("GET", path, lambda answer: parse(results.Lockout, answer))


def reset_lockout(subject: str) -> Call[results.Unlocked]:
    """Forget them."""
    return _erasing(subject_path(subject, "/lockout"), results.Unlocked)


def contract() -> Call[results.Contract]:
    """The contract in force."""
    return Call("GET", "/v1/contract", lambda answer: parse(results.Contract, answer))


def generator() -> Call[results.Generator]:
    """The decoy generator."""

    def read(answer: httpx.Response) -> results.Generator:
        source_id = answer.headers.get("X-Decoy-Source-ID")
        if source_id is None:
            raise UnexpectedAnswer("the answer has no header X-Decoy-Source-ID")
        return results.Generator(data=answer.content, source_id=source_id)

    return Call("GET", "/v1/contract/generator", read)


def export(subject: str) -> Call[results.Export]:
    """Export a subject."""
    path = subject_path(subject, "/export")
    return Call("GET", path, lambda answer: parse(results.Export, answer))


def import_(exported: str | results.Export) -> Call[results.Imported]:
    """Import what was exported."""
    text = exported.export if isinstance(exported, results.Export) else exported
    return Call(
        "POST",
        "/v1/subjects/import",
        lambda answer: parse(results.Imported, answer),
        lambda: {"json": {"export": text}},
    )


def ready() -> Call[results.Health]:
    """Whether the service can answer; asked once, because no is an answer too."""
    return Call(
        "GET",
        "/health/ready",
        lambda answer: parse(results.Health, answer),
        resend=Resend.NEVER,
    )


_Parsed = TypeVar("_Parsed", bound=results.Answer)


def _erasing(path: str, model: type[_Parsed]) -> Call[_Parsed]:
    return Call("DELETE", path, lambda answer: parse(model, answer))


def _file(photo: bytes) -> tuple[str, bytes, str]:
    # A file name of the user's machine is nobody else's business.
    return ("photo", photo, "application/octet-stream")


def _fields(**values: str | None) -> dict[str, str]:
    return {name: value for name, value in values.items() if value is not None}
