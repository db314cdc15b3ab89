"""Pairs of photos to verify, in the order of their protocol, whatever it was read from."""

import hashlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.extraction import Photo
from verify.datasets import DatasetError
from verify.tenfold import FOLDS

Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False, repr=False)
class VerificationSet:
    """Pairs of photos, or of templates of several photos each, as their protocol has them."""

    name: str
    kind: str  # bin, lfw, cfp, agedb or pairs
    pictures: tuple[Photo, ...]  # each once, in the order of their first use
    first: Indices  # (P,) positions in ``pictures``, or in ``templates`` where there are such
    second: Indices
    same: Flags  # (P,)
    folds: Indices | None  # 0 … 9; None where the protocol has none, and so no accuracy
    people: tuple[str, ...] | None = None  # on each of ``pictures`` (of ``templates``)
    protocol_files: tuple[tuple[str, str], ...] = ()  # names and SHA-256
    aligned: bool | None = None  # True where the format promises aligned crops
    templates: tuple[tuple[int, ...], ...] | None = None
    """Positions of the photos whose mean is compared, in protocols such as IJB-C's."""

    def __len__(self) -> int:
        return len(self.same)

    @property
    def genuine(self) -> int:
        """Number of pairs that show one person."""
        return int(np.count_nonzero(self.same))

    @property
    def impostor(self) -> int:
        """Number of pairs that show two people."""
        return len(self) - self.genuine

    @property
    def names(self) -> list[str]:
        """Name of each photo; of a template that of its first photo."""
        if self.templates is None:
            return [picture.name for picture in self.pictures]
        return [self.pictures[template[0]].name for template in self.templates]


def contiguous_folds(pairs: int) -> Indices:
    """Split ``pairs`` into ten runs in file order, the first ones longer by one where needed.

    This is scikit-learn's ``KFold(10, shuffle=False)``, which the literature's code uses.
    """
    return np.repeat(
        np.arange(FOLDS), [len(part) for part in np.array_split(np.arange(pairs), FOLDS)]
    ).astype(np.int64)


def require_both_classes(name: str, same: Flags, folds: Indices | None) -> None:
    """Check that there are pairs of one person and pairs of two; with folds, in every fold."""
    if folds is None:
        if same.all() or not same.any():
            people = "two people" if same.any() else "one person"
            raise DatasetError(f"{name} has no pair of {people}: error rates need both kinds")
        return
    faults = []
    for fold in range(FOLDS):
        inside = same[folds == fold]
        missing = [
            kind for kind, there in (("genuine", inside), ("impostor", ~inside)) if not there.any()
        ]
        if missing:
            faults.append(f"fold {fold + 1} has no {' and no '.join(missing)} pair")
    if faults:
        raise DatasetError(
            f"{name} is not in the order of a ten-fold protocol: {'; '.join(faults)}. Give the "
            "pairs fold by fold, both kinds in each"
        )


def digest_of(data: bytes) -> str:
    """SHA-256 in hex."""
    return hashlib.sha256(data).hexdigest()
