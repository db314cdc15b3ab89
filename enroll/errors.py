"""The exceptions of enrollment.

::

    VeilfaceError
    └── EnrollmentError
        ├── PhotoRejected         one photo has no usable face; ``cause`` says why
        └── InconsistentImages    the photos do not show one and the same person
"""

from templates.errors import VeilfaceError


class EnrollmentError(VeilfaceError):
    """An enrollment that cannot be made from what was sent."""


class PhotoRejected(EnrollmentError):
    """One photo of a set was refused by the models room, and the set with it.

    Parameters
    ----------
    index
        Position of the photo in the request, from 0.
    cause
        The error of the models room, which has its own code and message.
    """

    def __init__(self, index: int, cause: Exception) -> None:
        super().__init__(f"photo {index}: {cause}")
        self.index = index
        self.cause = cause


class InconsistentImages(EnrollmentError):
    """The photos of one enrollment do not all show the same person.

    Parameters
    ----------
    pairs
        The pairs of photos, by position from 0, that are less alike than the contract asks.
    """

    def __init__(self, pairs: list[tuple[int, int]]) -> None:
        named = ", ".join(f"{first} and {second}" for first, second in pairs)
        super().__init__(
            f"these photos do not look like the same person: {named} (counted from 0); "
            "send photos of one person only, or clearer ones"
        )
        self.pairs = tuple(pairs)

    @property
    def photos(self) -> tuple[int, ...]:
        """All photos that occur in a differing pair."""
        return tuple(sorted({index for pair in self.pairs for index in pair}))
