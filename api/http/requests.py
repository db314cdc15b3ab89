"""What the bodies of requests hold: one model for each form and each JSON object.

OpenAPI describes them as they stand here, and a body is read into one after authentication
(``api.http.bodies``). A name that a model does not have is refused. No message repeats a value.
"""

import base64
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    Json,
    PlainValidator,
    ValidationInfo,
    WithJsonSchema,
    model_validator,
)

from api.http.errors import ApiError
from enroll.enroller import MAX_PHOTOS
from models.selection import FacePolicy
from templates.errors import InvalidEmbedding, InvalidTemplate, SealError
from templates.keys.holder_key import PATTERN as HOLDER_KEY_PATTERN
from templates.keys.holder_key import decode_holder_key
from templates.store.identifiers import SUBJECT_ID_RULE, checked_subject_id
from verify import MAX_FRAMES, MAX_PROBE_PHOTOS, MIN_FRAMES

MAX_EMBEDDING = 4096
LONGEST_S = 120
"""Longest time that a token is good for."""


class Body(BaseModel):
    """A body: strict in names and types."""

    model_config = ConfigDict(extra="forbid", strict=True)

    def __repr__(self) -> str:
        """Name the model alone: it holds photos, embeddings and keys."""
        return f"{type(self).__name__}()"

    __str__ = __repr__


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("must be printable characters")
    return text


def _decoded(value: Any, info: ValidationInfo) -> bytes:
    if not isinstance(value, str):
        raise ValueError("must be a base64 string")
    try:
        return base64.b64decode(value, validate=True)
    except ValueError:
        raise InvalidTemplate(
            f"{info.field_name} is not base64 (standard alphabet, padded)"
        ) from None


def _holder_key(value: Any) -> bytearray:
    try:
        return decode_holder_key(value)
    except SealError as error:
        raise ValueError(f"is no holder key: {error}") from None


def how_to_send(photos: str) -> str:
    """Say how photos are sent, in a field of this name."""
    return f"send photos as files of the multipart field {photos} (curl: -F {photos}=@photo.jpg)"


def too_many_images(most: int) -> ApiError:
    """Refuse more photos than a call takes."""
    photos = "photo" if most == 1 else "photos"
    return ApiError("too_many_images", f"at most {most} {photos} in one request", {"limit": most})


Text = Annotated[str, Field(min_length=1, max_length=64), AfterValidator(_printable)]
SubjectId = Annotated[
    str,
    AfterValidator(checked_subject_id),
    Field(description=f"Has {SUBJECT_ID_RULE}.", examples=["alice"]),
]
Level = Annotated[
    Text,
    Field(
        description="Security level; default from the contract, or the lowest allowed.",
        examples=["fmr-1e-3"],
    ),
]
Base64 = Annotated[bytes, PlainValidator(_decoded), WithJsonSchema({"type": "string"})]
HolderKey = Annotated[
    bytearray,
    PlainValidator(_holder_key),
    WithJsonSchema(
        {
            "type": "string",
            "pattern": HOLDER_KEY_PATTERN,
            "description": "The holder's key: 32 random bytes, base64url.",
            "examples": ["AAECAwQFBgcICQoLDA0ODxAREhMUFRYXGBkaGxwdHh8"],
        }
    ),
]
Embedding = Annotated[list[float], Field(min_length=1, max_length=MAX_EMBEDDING)]
Embeddings = Annotated[list[Embedding], Field(min_length=1, max_length=MAX_PROBE_PHOTOS)]
Photos = Annotated[list[bytes], Field(min_length=1)]
Face = Annotated[
    FacePolicy,
    Field(
        strict=False,
        description="Which face counts when a photo shows several: the largest if it covers the "
        "middle of the picture and has twice the area of every other (`dominant`, the default); "
        "the largest wherever it is (`largest`), if it has 1.25 times the area; none (`single`). "
        "Otherwise the photo is refused as `multiple_faces`.",
    ),
]


class EnrollmentForm(Body):
    """Photos of one person."""

    images: Photos = Field(max_length=MAX_PHOTOS)
    attributes: Json[dict[Literal["gender", "race"], Text]] = Field(
        default_factory=dict,
        description="JSON object with `gender` and `race`; used for lifting only, never stored.",
        examples=['{"gender": "Female", "race": "Indian"}'],
    )
    face: Face = FacePolicy.DOMINANT
    holder_key: HolderKey | None = None


class EnrollmentJson(Body):
    """A private template that a client lifted."""

    template: Base64 = Field(description="Base64 of the wire bytes.")
    holder_key: HolderKey | None = None


class VerifyForm(Body):
    """Photos of one person, as `image` or as `images`."""

    image: Photos = Field([], max_length=MAX_FRAMES)
    images: Photos = Field([], max_length=MAX_FRAMES)
    challenge_id: Annotated[str, Field(min_length=1, max_length=1024)] | None = Field(
        None,
        description="`challenge_id` of POST /v1/challenges: the images are then the 5 to 12 frames "
        "that answer it.",
    )
    level: Level | None = None
    face: Face = FacePolicy.DOMINANT
    holder_key: HolderKey | None = None

    @property
    def kind(self) -> str:
        """What metrics call it."""
        return "photo" if self.challenge_id is None else "frames"

    @property
    def photos(self) -> list[bytes]:
        """Under whichever name they came."""
        return self.image or self.images

    @model_validator(mode="after")
    def _as_many_as_there_should_be(self) -> Self:
        if not self.photos:
            raise ValueError("send at least one photo")
        if self.image and self.images:
            raise ValueError("send image or images, not both")
        if self.challenge_id is None:
            if len(self.photos) > MAX_PROBE_PHOTOS:
                raise too_many_images(MAX_PROBE_PHOTOS)
        elif len(self.photos) < MIN_FRAMES:
            raise ValueError(f"a challenge is answered by {MIN_FRAMES} to {MAX_FRAMES} images")
        return self


class VerifyJson(Body):
    """A probe that is not a photo: exactly one of embedding, embeddings and template."""

    embedding: Embedding | None = Field(None, description="Unit-norm, of the contract's n.")
    embeddings: Embeddings | None = Field(
        None, description="Such embeddings of one person, which are averaged."
    )
    template: Base64 | None = Field(None, description="Base64 of a lifted probe's wire bytes.")
    level: Level | None = None
    holder_key: HolderKey | None = None
    challenge_id: ClassVar[None] = None

    @property
    def kind(self) -> str:
        """What metrics call it."""
        return "embedding" if self.template is None else "template"

    @property
    def rows(self) -> NDArray[np.float64]:
        """The embeddings, (k, n); the verifier checks their norms."""
        rows = self.embeddings or [self.embedding or []]
        if len({*map(len, rows)}) > 1:
            raise InvalidEmbedding("the embeddings differ in length")
        return np.array(rows)

    @model_validator(mode="after")
    def _one_probe(self) -> Self:
        probes = (self.embedding, self.embeddings, self.template)
        if sum(probe is not None for probe in probes) != 1:
            raise ValueError("send exactly one of embedding, embeddings and template, or photos")
        return self


class CompareForm(Body):
    """Two photos: the first stands for an enrollment, the second for the probe."""

    images: Annotated[list[bytes], Field(min_length=2, max_length=2)]
    level: Level | None = None
    face: Face = FacePolicy.DOMINANT


class PhotoCheckForm(Body):
    """One photo."""

    image: Photos = Field(max_length=1)
    face: Face = FacePolicy.DOMINANT


class ChallengeJson(Body):
    """For whom a challenge is."""

    subject_id: SubjectId | None = Field(
        None, description="The only subject that it may be answered for; left out: any."
    )


class TokenJson(Body):
    """What a token is for."""

    subject_id: SubjectId
    action: Literal["verify", "enroll"]
    level: Level | None = Field(None, description="For `verify`; left out, the one in force.")
    lifetime_s: int = Field(LONGEST_S, ge=1, le=LONGEST_S)
    replace: bool = Field(True, description="For `enroll`; false: as `If-None-Match: *`.")

    @model_validator(mode="after")
    def _of_the_action(self) -> Self:
        if self.action == "enroll" and self.level is not None:
            raise ValueError("a level is for the action verify only")
        if self.action == "verify" and "replace" in self.model_fields_set:
            raise ValueError("replace is for the action enroll only")
        return self


class ImportJson(Body):
    """An export."""

    export: Base64 = Field(description="`export` of an export call.")
