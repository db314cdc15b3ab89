"""Embeddings that were computed elsewhere, and the photos of a set that they belong to."""

import hashlib
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from verify.datasets import SUFFIXES, DatasetError
from verify.evaluation.readers.reader import isolated
from verify.evaluation.verification_set import VerificationSet

_NAMES = ("paths", "descriptors")
_FLOATS = (np.dtype(np.float16), np.dtype(np.float32), np.dtype(np.float64))
_KEYS = "expected arrays paths (unicode) and descriptors (float16, float32 or float64)"

# Components at the end of a name that tell the photos of a kind apart; all where it is absent.
_TELLING = {"bin": 1, "lfw": 1, "agedb": 1, "cfp": 3}


@dataclass(frozen=True, eq=False, repr=False)
class EmbeddingsFile:
    """Embeddings with the paths of their photos."""

    paths: tuple[str, ...]  # as the file has them, all different
    embeddings: NDArray[np.float32]  # (N, n) unit rows
    sha256: str

    def __len__(self) -> int:
        return len(self.paths)


def read_embeddings(file: Path) -> EmbeddingsFile:
    """Read an ``.npz`` with ``paths`` (N unicode strings) and ``descriptors`` (N, n).

    Rows are normalised, as many tools save what the network gave.
    """
    return isolated(read_content, file)


def read_content(file: Path) -> EmbeddingsFile:
    """Read as :func:`read_embeddings` does, in this process."""
    try:
        with file.open("rb") as stream:
            sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
            stream.seek(0)
            with np.load(stream, allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in _NAMES if name in archive.files}
                there = archive.files
    except OSError as error:
        raise DatasetError(f"{file} cannot be read: {error.strerror or 'broken'}") from None
    except MemoryError:
        raise
    except Exception as error:  # zipfile and NumPy raise whatever a broken archive causes
        raise DatasetError(
            f"{file} is not a readable .npz archive ({type(error).__name__}); {_KEYS}"
        ) from None
    for name in _NAMES:
        if name not in arrays:
            raise DatasetError(f"{file} has no array {name}, only {', '.join(there)!a}; {_KEYS}")
    paths, rows = (np.asarray(arrays[name]) for name in _NAMES)
    if paths.dtype.kind != "U" or rows.dtype.newbyteorder("=") not in _FLOATS:
        raise DatasetError(
            f"{file}: paths are of type {paths.dtype}, descriptors of type {rows.dtype}; {_KEYS}"
        )
    if paths.ndim != 1 or rows.ndim != 2 or len(paths) != len(rows) or 0 in rows.shape:
        raise DatasetError(
            f"{file} has paths of shape {paths.shape} and descriptors of shape {rows.shape}; "
            "expected (N,) and (N, n)"
        )
    names = [str(name) for name in paths.tolist()]
    if repeated := next((name for name, times in Counter(names).items() if times > 1), None):
        raise DatasetError(f"{file}: {repeated!a} occurs twice")
    lengths = np.sqrt(np.einsum("ij,ij->i", rows, rows, dtype=np.float64))
    wrong = np.flatnonzero(~(np.isfinite(lengths) & (lengths > 0)))
    if wrong.size:
        state = "zero" if lengths[wrong[0]] == 0 else "not finite"
        raise DatasetError(f"{file}: the embedding of {names[wrong[0]]!a} is {state}")
    unit = np.ascontiguousarray(rows / lengths[:, None], dtype=np.float32)
    return EmbeddingsFile(tuple(names), unit, sha256)


def match(file: EmbeddingsFile, benchmark: VerificationSet) -> NDArray[np.int64]:
    """Find the embedding of every photo of a set.

    A photo takes the row of its exact name; else the row whose path ends, suffixes aside, in as
    many components of its own as tell photos of the set apart (``Name_0001`` in LFW,
    ``001/frontal/01`` in CFP, all of them in a pair CSV). Photos of a ``.bin`` are ``00000``,
    ``00001`` … by place. -1 stands for a photo without one, which failed to be acquired.
    """
    exact = {path: [row] for row, path in enumerate(file.paths)}
    ends: defaultdict[tuple[str, ...], list[int]] = defaultdict(list)
    for row, path in enumerate(file.paths):
        pieces = _components(path)
        for start in range(len(pieces)):
            ends[pieces[start:]].append(row)
    telling = _TELLING.get(benchmark.kind)
    taken: dict[int, str] = {}
    positions = np.full(len(benchmark.pictures), -1, dtype=np.int64)
    for place, picture in enumerate(benchmark.pictures):
        pieces = _components(picture.name)
        rows = exact.get(picture.name) or ends[pieces if telling is None else pieces[-telling:]]
        if len(rows) > 1:
            raise DatasetError(
                f"{benchmark.name}: the embedding of {picture.name} may be "
                f"{file.paths[rows[0]]!a} or {file.paths[rows[1]]!a}"
            )
        if rows and taken.setdefault(rows[0], picture.name) != picture.name:
            raise DatasetError(
                f"{benchmark.name}: {file.paths[rows[0]]!a} fits {taken[rows[0]]} and "
                f"{picture.name}"
            )
        if rows:
            positions[place] = rows[0]
    return positions


def _components(path: str) -> tuple[str, ...]:
    """Components without the suffix of a photo; drives, roots and ``.`` are dropped."""
    pieces = [piece for piece in path.replace("\\", "/").split("/") if piece not in ("", ".")]
    if pieces:
        dot = pieces[-1].rfind(".")
        if dot > 0 and pieces[-1][dot:].lower() in SUFFIXES:
            pieces[-1] = pieces[-1][:dot]
    return tuple(pieces)
