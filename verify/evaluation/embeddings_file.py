"""Descriptors that were computed elsewhere, and the photos of a set that they belong to."""

import hashlib
import math
import zipfile
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from verify.datasets import SUFFIXES, DatasetError, faults_in
from verify.evaluation.verification_set import VerificationSet

MAX_DESCRIPTOR_BYTES = 2**30
MAX_PATH_BYTES = 2**29
_MAX_HEADER = 10_000
_FLOATS = (np.dtype(np.float16), np.dtype(np.float32), np.dtype(np.float64))
_KEYS = "expected arrays paths (unicode) and descriptors (float16, float32 or float64)"

# Components at the end of a name that tell the photos of a kind apart, wherever they lie.
_TELLING = {"bin": 1, "lfw": 1, "agedb": 1, "cfp": 3}


@dataclass(frozen=True, eq=False, repr=False)
class EmbeddingsFile:
    """Descriptors with the paths of their photos.

    Parameters
    ----------
    paths
        As the file has them, all different.
    descriptors : (N, n) float32
        Unit rows.
    sha256
        Of the file.
    """

    paths: tuple[str, ...]
    descriptors: NDArray[np.float32]
    sha256: str

    def __len__(self) -> int:
        return len(self.paths)


def read_embeddings(file: Path) -> EmbeddingsFile:
    """Read an ``.npz`` with ``paths`` (N unicode strings) and ``descriptors`` (N, n).

    Rows are normalised, as many tools save what the network gave.

    Raises
    ------
    DatasetError
        The archive is broken or too large, an array has another type or shape, a row is zero or
        not finite, or a path occurs twice.
    """
    try:
        with file.open("rb") as stream:
            sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
            with zipfile.ZipFile(stream) as archive:
                paths = _array(file, archive, "paths", most=MAX_PATH_BYTES)
                rows = _array(file, archive, "descriptors", most=MAX_DESCRIPTOR_BYTES)
        names = [str(one) for one in paths.reshape(-1).tolist()]
        wide = rows.astype(np.float64)
    except DatasetError:
        raise
    except OSError as error:
        raise DatasetError(f"{file} cannot be read: {error.strerror or 'broken'}") from None
    except Exception as error:  # zipfile and NumPy raise whatever a broken archive causes
        raise DatasetError(
            f"{file} is no readable .npz archive ({type(error).__name__}); {_KEYS}"
        ) from None
    if paths.ndim != 1 or wide.ndim != 2 or len(paths) != len(wide) or 0 in wide.shape:
        raise DatasetError(
            f"{file} has paths of shape {paths.shape} and descriptors of shape {wide.shape}; "
            "expected (N,) and (N, n)"
        )
    faults = [f"{name!a} occurs twice" for name in _repeated(names)]
    lengths = np.sqrt(np.einsum("ij,ij->i", wide, wide))
    for place in np.flatnonzero(~(np.isfinite(lengths) & (lengths > 0))).tolist():
        state = "zero" if lengths[place] == 0 else "not finite"
        faults.append(f"the descriptor of {names[place]!a} is {state}")
    if faults:
        raise DatasetError(faults_in(file, "expected one descriptor per photo", faults))
    wide /= lengths[:, None]
    unit = np.ascontiguousarray(wide, dtype=np.float32)
    return EmbeddingsFile(tuple(names), unit, sha256)


def match(embeddings: EmbeddingsFile, benchmark: VerificationSet) -> NDArray[np.int64]:
    """Find the descriptor of every photo of a set.

    A photo takes the row of its exact name; else of its name without suffix; else the row that
    shares the longest end of its path: all of the shorter path, or as many components as tell
    photos of the set apart (``Name_0001`` in LFW, ``001/frontal/01`` in CFP). Photos of a
    ``.bin`` are ``00000``, ``00001`` … by place.

    Returns
    -------
    positions : (len(benchmark.pictures),) int64
        Rows of ``embeddings.descriptors``; −1 for photos without one, which are failures to
        acquire.

    Raises
    ------
    DatasetError
        Several rows fit a photo equally well, or one row fits several photos.
    """
    exact = {path: row for row, path in enumerate(embeddings.paths)}
    parts = [_components(path) for path in embeddings.paths]
    by_last: defaultdict[str, list[int]] = defaultdict(list)
    by_all: defaultdict[tuple[str, ...], list[int]] = defaultdict(list)
    for row, pieces in enumerate(parts):
        by_all[pieces].append(row)
        if pieces:
            by_last[pieces[-1]].append(row)
    telling = _TELLING.get(benchmark.kind)
    positions = np.full(len(benchmark.pictures), -1, dtype=np.int64)
    takers: dict[int, str] = {}
    faults: list[str] = []
    for place, picture in enumerate(benchmark.pictures):
        wanted = _components(picture.name)
        if picture.name in exact:
            rows = [exact[picture.name]]
        else:
            rows = by_all.get(wanted) or _longest(wanted, by_last, parts, telling)
        if len(rows) > 1:
            shown = " and ".join(f"{embeddings.paths[row]!a}" for row in rows[:3])
            faults.append(f"{picture.name} may be {shown}")
        elif rows and rows[0] in takers:
            path = embeddings.paths[rows[0]]
            faults.append(f"{path!a} fits both {takers[rows[0]]} and {picture.name}")
        elif rows:
            takers[rows[0]] = picture.name
            positions[place] = rows[0]
    if faults:
        raise DatasetError(
            faults_in(Path(benchmark.name), "expected one descriptor for each photo", faults)
        )
    return positions


def _longest(
    wanted: tuple[str, ...],
    by_last: dict[str, list[int]],
    parts: list[tuple[str, ...]],
    telling: int | None,
) -> list[int]:
    best: list[int] = []
    longest = 0
    for row in by_last.get(wanted[-1], []) if wanted else []:
        shared = 0
        for mine, theirs in zip(reversed(wanted), reversed(parts[row]), strict=False):
            if mine != theirs:
                break
            shared += 1
        whole = shared == min(len(wanted), len(parts[row]))
        if not whole and (telling is None or shared < telling):
            continue
        if shared > longest:
            best, longest = [row], shared
        elif shared == longest:
            best.append(row)
    return best


def _components(path: str) -> tuple[str, ...]:
    """Components without the suffix of a photo; drives, roots and ``.`` are dropped."""
    pieces = [piece for piece in path.replace("\\", "/").split("/") if piece not in ("", ".")]
    if pieces:
        dot = pieces[-1].rfind(".")
        if dot > 0 and pieces[-1][dot:].lower() in SUFFIXES:
            pieces[-1] = pieces[-1][:dot]
    return tuple(pieces)


def _repeated(names: list[str]) -> list[str]:
    seen: set[str] = set()
    return [name for name in names if name in seen or seen.add(name)]  # type: ignore[func-returns-value]


def _array(file: Path, archive: zipfile.ZipFile, name: str, *, most: int) -> NDArray[np.generic]:
    """Read one array, having checked what its header declares before reading on."""
    try:
        entry = archive.getinfo(f"{name}.npy")
    except KeyError:
        there = ", ".join(sorted(archive.namelist())[:5])
        raise DatasetError(f"{file} has no array {name}, only {there!a}; {_KEYS}") from None
    if entry.file_size > most:
        raise DatasetError(f"{file}: {name} unpacks to more than {most} bytes")
    with archive.open(entry) as stream:
        shape, fortran, dtype = _header(stream)
        if dtype.kind != "U" if name == "paths" else dtype.newbyteorder("=") not in _FLOATS:
            raise DatasetError(f"{file}: {name} is of type {dtype.kind}{dtype.itemsize}; {_KEYS}")
        count = math.prod(shape)
        if min(shape, default=0) < 0 or count * dtype.itemsize > most:
            raise DatasetError(f"{file}: {name} declares a shape beyond {most} bytes")
        data = stream.read(count * dtype.itemsize + 1)
    if len(data) != count * dtype.itemsize:
        raise DatasetError(f"{file}: {name} is not as long as its shape {shape} says")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[np.generic]]:
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        return np.lib.format.read_array_header_1_0(stream, max_header_size=_MAX_HEADER)
    return np.lib.format.read_array_header_2_0(stream, max_header_size=_MAX_HEADER)
