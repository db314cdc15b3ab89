"""The exceptions of decoding, model packs and faces.

::

    ModelError
    ├── ImageError(code)         bytes that are not a picture Veilface reads
    ├── PackError                a model pack that is broken, unknown or ambiguous
    ├── ProviderUnavailable      an accelerator was asked for and is not there
    ├── CacheError               an embedding cache that is not one
    ├── PhotoRejected            one of several photos was refused; ``cause`` says why
    └── FaceError(code)          a picture that was read, with no usable face in it
        ├── NoFace
        ├── MultipleFaces
        ├── FaceTooSmall
        └── LowQuality(details)

Messages name the cause and the remedy. They never hold a pixel or a number of an embedding.
"""

from collections.abc import Mapping
from typing import Literal

ImageCode = Literal["unsupported_image", "image_too_large"]


class ModelError(Exception):
    """Base of all errors that ``models`` raises on purpose."""


class ImageError(ModelError):
    """Bytes that are no picture Veilface reads, or a picture over a limit."""

    def __init__(self, code: ImageCode, message: str) -> None:
        super().__init__(message)
        self.code: ImageCode = code


class PackError(ModelError):
    """A model pack that is broken, unknown or ambiguous; the message names the file."""


class ProviderUnavailable(ModelError):
    """The requested accelerator is absent; the message names those that are there."""


class CacheError(ModelError):
    """An embedding cache whose opened content breaks its format."""


class FaceError(ModelError):
    """A picture that was decoded, in which no usable face was found.

    ``code`` is that of the REST contract; ``details`` has measured values and limits, by what was
    measured.
    """

    code = "no_face"

    def __init__(self, message: str, *, details: Mapping[str, object] | None = None) -> None:
        super().__init__(message)
        self.details: dict[str, object] = dict(details or {})


class NoFace(FaceError):
    """No face was found."""


class MultipleFaces(FaceError):
    """More than one face that could be meant was found."""

    code = "multiple_faces"


class FaceTooSmall(FaceError):
    """The face is too small in the photo."""

    code = "face_too_small"


class LowQuality(FaceError):
    """The face fails a limit; ``details`` are those of `models.quality.check`."""

    code = "low_quality"


class PhotoRejected(ModelError):
    """One photo of a set was refused, and the set with it.

    ``index`` counts from 0, words from 1; ``cause`` has a code and a message of its own.
    """

    def __init__(self, index: int, cause: ModelError, *, count: int) -> None:
        self.index = index
        self.cause = cause
        self._place = f"photo {index + 1} of {count}: " if count > 1 else ""
        super().__init__(self.placed(str(cause)))

    def placed(self, message: str) -> str:
        """Say which photo a message is about; of a single one there is no need to."""
        return self._place + message
