"""The exceptions of enrollment.

::

    VeilfaceError
    └── EnrollmentError
        ├── PhotoRejected         one photo has no usable face; ``cause`` says why
        └── InconsistentImages    the photos do not show one and the same person
"""

from collections.abc import Sequence

from templates.errors import VeilfaceError


class EnrollmentError(VeilfaceError):
    """An enrollment that cannot be made from what was sent."""


class PhotoRejected(EnrollmentError):
    """One photo of a set was refused by ``models``, and the set with it.

    Parameters
    ----------
    index
        Position of the photo in the request, from 0. Words count from 1.
    cause
        The error of ``models``, which has its own code and message.
    count
        Photos in the request.
    """

    def __init__(self, index: int, cause: Exception, *, count: int) -> None:
        self.place = f"photo {index + 1} of {count}"
        super().__init__(f"{self.place}: {cause}")
        self.index = index
        self.cause = cause


class InconsistentImages(EnrollmentError):
    """The photos of one enrollment do not all show the same person.

    Parameters
    ----------
    apart, others
        Positions from 0, ascending: the photos that differ from the others. Where both are as
        many, either may be the stranger's.
    """

    def __init__(self, apart: Sequence[int], others: Sequence[int]) -> None:
        self.apart = tuple(apart)
        self.others = tuple(others)
        super().__init__(self.sentence())

    @property
    def photos(self) -> tuple[int, ...]:
        """The photos that differ, ascending: all of them where either half may."""
        if len(self.apart) < len(self.others):
            return self.apart
        return tuple(sorted(self.apart + self.others))

    def sentence(self, names: Sequence[str] | None = None) -> str:
        """Say which photos differ: by their names, else by numbers from 1."""
        if len(self.apart) == len(self.others) == 1:
            differing = f"{_listed(self.photos, names)} do not look like the same person"
        else:
            verb = "does" if len(self.apart) == 1 else "do"
            differing = (
                f"{_listed(self.apart, names)} {verb} not look like the person on "
                f"{_listed(self.others, names)}"
            )
        return f"{differing}; send photos of one person only, or clearer ones"


def _listed(positions: Sequence[int], names: Sequence[str] | None) -> str:
    if names is not None:
        shown = [names[position] for position in positions]
    else:
        shown = [str(position + 1) for position in positions]
        shown[0] = f"{'photos' if len(shown) > 1 else 'photo'} {shown[0]}"
    return " and ".join([", ".join(shown[:-1]), shown[-1]] if len(shown) > 1 else shown)
