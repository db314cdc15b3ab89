"""A benchmark of pairs, whatever file or folder it was read from."""

import hashlib
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from models.decoding import DEFAULT_LIMITS
from models.extraction import EncodedImage, MarkedPhoto
from verify.datasets import DatasetError
from verify.tenfold import FOLDS

Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]


class Picture(Protocol):
    """A photo of a set that can be read, once or more."""

    @property
    def name(self) -> str:
        """Path of the photo relative to its set, or its place in the file; unique in the set."""
        ...

    @property
    def source(self) -> Path | EncodedImage | MarkedPhoto:
        """The photo as bulk extraction takes it; a file is not read yet."""
        ...

    @property
    def keypoints(self) -> NDArray[np.float64] | None:
        """Five points of the face that the set offers, (5, 2); None where it offers none."""
        ...

    def read(self) -> bytes:
        """Return the encoded photo; of one that is too large, enough to tell."""
        ...


@dataclass(frozen=True)
class PictureFile:
    """A photo in a folder.

    Parameters
    ----------
    keypoints : (5, 2) float64, optional
        What the set offers, for packs without a detector.
    """

    name: str
    path: Path
    keypoints: NDArray[np.float64] | None = field(default=None, repr=False, compare=False)

    @property
    def source(self) -> Path | MarkedPhoto:
        """The file, with its points where it has them."""
        return self.path if self.keypoints is None else MarkedPhoto(self.path, self.keypoints)

    def read(self) -> bytes:
        """Read the file, and one byte more than the decoder accepts where it is larger."""
        with self.path.open("rb") as file:
            return file.read(DEFAULT_LIMITS.max_bytes + 1)


@dataclass(frozen=True)
class PictureBytes:
    """A photo inside a larger file."""

    name: str
    data: bytes = field(repr=False)

    @property
    def source(self) -> EncodedImage:
        """The bytes under the photo's name."""
        return EncodedImage(self.name, self.data)

    @property
    def keypoints(self) -> None:
        """None: it is an aligned crop."""
        return

    def read(self) -> bytes:
        """Return the bytes."""
        return self.data


@dataclass(frozen=True, eq=False, repr=False)
class VerificationSet:
    """Pairs of photos, in the order and the folds of their protocol.

    Parameters
    ----------
    name
        Short name for tables, such as ``lfw`` or ``cfp_fp``.
    kind
        What was read: ``bin``, ``lfw``, ``cfp``, ``agedb`` or ``pairs``.
    pictures
        The photos that pairs use, each once, in the order of their first use.
    first, second : (P,) int64
        Positions in ``pictures``.
    same : (P,) bool
        Whether a pair shows one person.
    folds : (P,) int64
        0 … 9.
    people
        Name of the person on each of ``pictures``, or None where the set does not tell.
    protocol_files
        Names and SHA-256 of the files that define the pairs, such as ``pairs.txt``.
    aligned
        True where the format promises aligned crops (``.bin``), else None: not known.
    """

    name: str
    kind: str
    pictures: tuple[Picture, ...]
    first: Indices
    second: Indices
    same: Flags
    folds: Indices
    people: tuple[str, ...] | None = None
    protocol_files: tuple[tuple[str, str], ...] = ()
    aligned: bool | None = None

    def __len__(self) -> int:
        return len(self.same)

    def __repr__(self) -> str:
        return f"VerificationSet({self.name}: {len(self)} pairs of {len(self.pictures)} photos)"

    @property
    def genuine(self) -> int:
        """Number of pairs that show one person."""
        return int(np.count_nonzero(self.same))

    @property
    def impostor(self) -> int:
        """Number of pairs that show two people."""
        return len(self) - self.genuine


def contiguous_folds(pairs: int) -> Indices:
    """Split ``pairs`` into ten runs in file order, the first ones longer by one where needed.

    This is scikit-learn's ``KFold(10, shuffle=False)``, which the literature's code uses.
    """
    return np.repeat(
        np.arange(FOLDS), [len(part) for part in np.array_split(np.arange(pairs), FOLDS)]
    ).astype(np.int64)


def require_both_classes(name: str, same: Flags, folds: Indices) -> None:
    """Check that every fold has pairs of one person and pairs of two.

    Raises
    ------
    DatasetError
        Naming the folds that lack either: most often the pairs are sorted by class, or cut off.
    """
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


def unequal_folds(same: Flags, folds: Indices) -> bool:
    """Whether folds differ in their numbers of genuine or impostor pairs."""
    counts = Counter(zip(folds.tolist(), same.tolist(), strict=True))
    return len(set(counts.values())) > 1


def digest_of(data: bytes) -> str:
    """SHA-256 in hex."""
    return hashlib.sha256(data).hexdigest()
