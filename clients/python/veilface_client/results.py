"""What the service answers, and what a private client lifts, as frozen values.

Fields that this version does not know are ignored, so that it reads the answers of later ones.
"""

import os
from pathlib import Path
from typing import Any, Literal, Self

import httpx
from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, ValidationError

from veilface_client.errors import UnexpectedAnswer


class Value(BaseModel):
    """A frozen value."""

    model_config = ConfigDict(frozen=True)

    @classmethod
    def read(cls, response: httpx.Response) -> Self:
        """Read an answer.

        Raises
        ------
        UnexpectedAnswer
            It lacks a field, or has another type. The text names fields, and no value.
        """
        try:
            return cls.model_validate_json(response.content)
        except ValidationError as error:
            fields = sorted({".".join(map(str, each["loc"])) or "body" for each in error.errors()})
            raise UnexpectedAnswer(
                f"the answer does not fit {cls.__name__}: {', '.join(fields)}"
            ) from None


class Lift(Value):
    """What a client has lifted: no photo, and no embedding."""

    template: bytes
    contract_id: str

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {len(self.template)} bytes>"

    __str__ = __repr__


class Probe(Lift):
    """A lifted probe. Use it once for each attempt it is meant for."""


class Enrollable(Lift):
    """A template that enrolls, lifted and not yet (or perhaps) sent."""


class Answer(Value):
    """What every answer has."""

    request_id: str


class PhotoUsed(Value):
    """One photo of an enrollment: its position, and the measures of the quality gate."""

    index: int
    status: str
    quality: dict[str, float | None]


class Enrollment(Answer):
    """The subject is enrolled; ``images`` is empty for a template."""

    template_id: str
    contract_id: str
    replaced: bool
    holder_key: bool = False
    images: tuple[PhotoUsed, ...] = ()


class Imported(Enrollment):
    """The subject of an export is enrolled."""

    subject_id: str


class Decision(Answer):
    """Whether the probe shows the subject. It is true if, and only if, it was accepted."""

    decision: Literal["accept", "reject"]
    reason: str
    level: str
    fmr: float | None = None
    contract_id: str
    calibration_id: str
    distance: float | None = None
    distance_threshold: float | None = None
    liveness: str = "not_checked"  # as a service that checks none would say
    liveness_failure: str | None = None
    advice: str | None = None
    """What to change in another photo."""

    @property
    def accepted(self) -> bool:
        """Whether the decision is accept."""
        return self.decision == "accept"

    def __bool__(self) -> bool:
        # `if client.verify(…):` is what people write; an object that is always true lets all in.
        return self.accepted


class Challenge(Answer):
    """Movements to make, in their order, as the person sees them who makes them.

    ``min_frames`` to ``max_frames`` frames of the movements must reach the service before
    ``expires_at``, in one verification.
    """

    challenge_id: str
    movements: tuple[str, ...]
    min_frames: int
    max_frames: int
    expires_at: str


class Token(Answer):
    """A token for one call of one subject, which a browser may hold.

    ``token`` is for the page; ``token_id`` stays on your server, to ask what came of it.
    """

    token: str = Field(repr=False)
    token_id: str
    subject_id: str
    action: str
    level: str | None
    expires_at: AwareDatetime


class TokenOutcome(Answer):
    """What a token was used for; true if and only if it accepted the subject.

    ``outcome`` is ``accept``, ``reject``, ``locked_out``, ``created`` or ``replaced``, and None
    where the token was not used.
    """

    token_id: str
    used: bool
    outcome: str | None
    level: str | None
    used_at: AwareDatetime | None

    def __bool__(self) -> bool:
        return self.outcome == "accept"


class Subject(Value):
    """A subject, without its template."""

    subject_id: str
    template_id: str
    contract_id: str
    current: bool
    enrolled_by: str
    photos: int
    holder_key: bool = False
    created_at: AwareDatetime
    updated_at: AwareDatetime


class SubjectPage(Answer):
    """One page of subjects, in the order of their ids; no cursor on the last one."""

    subjects: tuple[Subject, ...]
    next_cursor: str | None


class Lockout(Answer):
    """Failed verifications of a subject."""

    consecutive_failures: int
    last_failed_at: AwareDatetime | None
    locked_until: AwareDatetime | None
    disabled_at: AwareDatetime | None


class Unlocked(Answer):
    """The lockout is reset; not ``lifted``: there was nothing to reset."""

    lifted: bool


class _Verbatim(Answer):
    raw: bytes = Field(default=b"", repr=False, exclude=True)

    @classmethod
    def read(cls, response: httpx.Response) -> Self:
        return super().read(response).model_copy(update={"raw": response.content})

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the answer to a file, byte for byte."""
        Path(path).write_bytes(self.raw)


class Receipt(_Verbatim):
    """The signed receipt of an erasure. ``claims`` is for reading; ``receipt`` is what is signed.

    ``raw`` is the answer as it came: ``veilface keys verify-receipt`` takes it. ``log_purged`` is
    False where SQLite's log still holds old pages, which a later purge removes.
    """

    receipt: dict[str, str]
    claims: dict[str, Any]
    log_purged: bool

    @property
    def held(self) -> bool:
        """Whether the subject was enrolled."""
        return self.claims.get("held") is True


class Contract(_Verbatim):
    """The contract in force. ``raw`` is the answer as it came, which ``veilface lift`` takes."""

    contract_id: str
    binding: dict[str, Any]
    calibrations: tuple[dict[str, Any], ...]
    default_level: str
    photos: bool
    generator: bool
    template_enrollment: bool = True  # a service that does not say takes them
    receipt_key: dict[str, str]


class Generator(Value):
    """The decoy generator, for clients that lift."""

    data: bytes = Field(repr=False)
    source_id: str

    @classmethod
    def read(cls, response: httpx.Response) -> Self:
        """Read the generator and the header that names it."""
        source_id = response.headers.get("X-Decoy-Source-ID")
        if source_id is None:
            raise UnexpectedAnswer("the answer has no header X-Decoy-Source-ID")
        return cls(data=response.content, source_id=source_id)


class Export(Answer):
    """One subject, encrypted: base64."""

    export: str = Field(repr=False)
    contract_id: str
    key_id: str


class Health(Answer):
    """The service can answer."""

    status: str
