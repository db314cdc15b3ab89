"""What every reader of a benchmark is made of.

A reader is a module of this package with a ``READER``: how a data set looks, how it is recognised,
and a function from its path to verification sets. Modules are found by being there.
"""

import re
import resource
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import TypeVar

import numpy as np

from models.extraction import Photo
from verify.datasets import (
    MAX_PAIRS_BYTES,
    SUFFIXES,
    DatasetError,
    decoded,
    is_photo,
    read_whole,
)
from verify.evaluation.verification_set import (
    VerificationSet,
    digest_of,
    require_both_classes,
)

T = TypeVar("T")
MEMORY_BYTES = 8 * 2**30
"""Four times the largest file that is read, beyond what the libraries of the process take."""

# Of a set: it stands in tables, figures and on the terminal.
_NAME = re.compile(r"\w[\w .()-]{0,99}")


@dataclass(frozen=True)
class Reader:
    """How one kind of data set is read."""

    layout: str  # in the message that says what is understood
    recognises: Callable[[Path], bool]
    # The second argument says whether the photos must be there.
    read: Callable[[Path, bool], list[VerificationSet]]


@dataclass(frozen=True)
class Trial:
    """One comparison of a protocol; photos by a key that is unique in the set."""

    first: str
    second: str
    same: bool
    fold: int | None = None


@dataclass(frozen=True)
class ProtocolText:
    """Text of a file with its name relative to the set, and the SHA-256 of its bytes."""

    name: str
    sha256: str
    text: str

    @property
    def fingerprint(self) -> tuple[str, str]:
        """Name and SHA-256, as ``VerificationSet.protocol_files`` lists them."""
        return self.name, self.sha256


def read_text(file: Path, *, root: Path) -> ProtocolText:
    """Read UTF-8 text, with or without a byte-order mark."""
    data = read_whole(file, most=MAX_PAIRS_BYTES)
    name = file.relative_to(root).as_posix()
    return ProtocolText(name, digest_of(data), decoded(data, file=file))


def isolated(read: Callable[[Path], T], file: Path) -> T:
    """Read a file of a format that can ask for any memory, in a process that gets little."""
    with ProcessPoolExecutor(
        1, get_context("spawn"), initializer=_limit_memory, initargs=(MEMORY_BYTES,)
    ) as child:
        try:
            return child.submit(read, file).result()
        except (BrokenProcessPool, MemoryError):
            raise DatasetError(
                f"{file} is not readable: its reader crashed, or needed more than "
                f"{MEMORY_BYTES // 2**20} MiB of memory"
            ) from None


def _limit_memory(most: int) -> None:
    pages = Path("/proc/self/statm")
    if pages.exists():
        taken = int(pages.read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + most, resource.RLIM_INFINITY))


def keys_of(trials: Iterable[Trial]) -> list[str]:
    """Keys of the photos, each once, in the order of their first use."""
    return list(dict.fromkeys(key for trial in trials for key in (trial.first, trial.second)))


def photos_named(base: Path, keys: Sequence[str], *, protocol: str) -> dict[str, Path]:
    """Find the one photo of each key, which is its path below ``base`` without the suffix."""
    listed: dict[Path, dict[str, list[Path]]] = {}
    photos: dict[str, Path] = {}
    for key in keys:
        folder, stem = (base / key).parent, Path(key).name
        if folder not in listed:
            listed[folder] = {}
            for file in sorted(folder.iterdir()) if folder.is_dir() else ():
                if is_photo(file):
                    listed[folder].setdefault(file.stem, []).append(file)
        match listed[folder].get(stem, []):
            case [photo]:
                photos[key] = photo
            case []:
                raise DatasetError(
                    f"{base}: the photo {key} of {protocol} is not there; a photo ends in "
                    f"{', '.join(sorted(SUFFIXES))}"
                )
            case several:
                raise DatasetError(
                    f"{base}: the photo {key} of {protocol} is there {len(several)} times, with "
                    "different suffixes"
                )
    return photos


def require_plain_names(file: Path, names: Iterable[str]) -> None:
    """Refuse names that lead out of the folder of the photos."""
    for name in names:
        if not name.isprintable() or "/" in name or "\\" in name or name in (".", ".."):
            raise DatasetError(f"{file}: {name!a} is no plain name of a photo")


def assemble(
    name: str,
    kind: str,
    trials: Sequence[Trial],
    *,
    pictures: Mapping[str, Photo] | Callable[[str], Photo],
    person: Callable[[str], str] | None,
    protocol_files: Iterable[tuple[str, str]],
    aligned: bool | None = None,
    templates: Mapping[str, Sequence[Photo]] | None = None,
) -> VerificationSet:
    """Number the photos of ``trials``; check each pair, and that a fold has both kinds of them."""
    if not _NAME.fullmatch(name):
        raise DatasetError(
            f"the set {name[:100]!a} has a name of more than 100 characters, or of others than "
            "letters, digits, spaces and _ . ( ) -; rename the file"
        )
    for trial in trials:
        pair = f"{name}: the pair of {trial.first} and {trial.second}"
        # A published .bin cannot be mended, and holds no files.
        if trial.first == trial.second and kind != "bin":
            raise DatasetError(f"{pair} compares a photo with itself; remove it")
        if person is not None and (person(trial.first) == person(trial.second)) != trial.same:
            people = "one person" if trial.same else "two people"
            raise DatasetError(f"{pair} is labelled as {people}, which its names contradict")
    keys = keys_of(trials)
    position = {key: place for place, key in enumerate(keys)}
    same = np.array([trial.same for trial in trials], dtype=np.bool_)
    folds = None
    if trials and trials[0].fold is not None:
        folds = np.array([trial.fold for trial in trials], dtype=np.int64)
    require_both_classes(name, same, folds)
    of_key = pictures if callable(pictures) else pictures.__getitem__
    photos: list[Photo] = []
    members: list[tuple[int, ...]] = []
    for key in keys:
        own = (templates or {}).get(key) or [of_key(key)]
        members.append(tuple(range(len(photos), len(photos) + len(own))))
        photos += own
    return VerificationSet(
        name=name,
        kind=kind,
        pictures=tuple(photos),
        first=np.array([position[trial.first] for trial in trials], dtype=np.int64),
        second=np.array([position[trial.second] for trial in trials], dtype=np.int64),
        same=same,
        folds=folds,
        people=None if person is None else tuple(person(key) for key in keys),
        protocol_files=tuple(protocol_files),
        aligned=aligned,
        templates=tuple(members) if templates else None,
    )
